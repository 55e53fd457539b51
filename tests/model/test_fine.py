"""Fine stage: matches, their geometry, and point-to-plane registration with confidences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from delo_jax import inference
from delo_jax.config import PreprocessConfig
from delo_jax.model import delo, fine
from delo_jax.preprocess import preprocess
from tests.fixtures import TINY, T_street, errors, simulated_clip, street_points, street_scan, tiny_model
from tests.oracles import street

NUM = 40


def random_match(seed, num=NUM):
    """Points, normals, targets, their normals and a mask."""
    rng = np.random.default_rng(seed)
    points, targets = (20 * rng.normal(size=(num, 3)) for _ in range(2))
    normals, target_normals = (n / np.linalg.norm(n, axis=1, keepdims=True) for n in rng.normal(size=(2, num, 3)))
    targets[::2] = points[::2] + 0.1 * rng.normal(size=points[::2].shape)
    return points, normals, targets, target_normals, np.arange(num) < 0.7 * num


def as_float32(arrays):
    return [jnp.asarray(a, jnp.float32) if a.dtype == float else jnp.asarray(a) for a in arrays]


def test_geometry_is_what_it_says():
    """Oracle: the formulas row by row in float64 NumPy."""
    points, normals, targets, target_normals, mask = random_match(0)
    columns, along, agreement = fine.match_geometry(*as_float32((points, normals, targets, target_normals, mask)))
    rows = []
    for p, n, q, m in zip(points, normals, targets, target_normals, strict=True):
        d, on_target, on_source = np.linalg.norm(p - q), np.dot(p - q, m), np.dot(p - q, n)
        squashed = [np.tanh(on_target / 0.1), np.tanh(on_source / 0.1), np.tanh(on_target / 0.5)]
        logs = [np.log(d + 0.01), np.log(abs(on_target) + 0.01)]
        rows.append([*np.clip([on_target, on_source], -2, 2), *squashed, min(d, 4), *logs, np.clip((p - q)[2], -2, 2), np.dot(n, m)])
        rows[-1] += [0.5 * np.log(np.dot(p, p) + 1) - 2.7, abs(m[2])]
    table = np.array(rows)
    means = table[mask][:, [6, 7, 9]].mean(axis=0)  # over the valid rows
    np.testing.assert_allclose(columns, np.hstack([table, np.tile(means, (NUM, 1))]), atol=1e-3)
    np.testing.assert_allclose(along, np.sum((points - targets) * target_normals, axis=1), atol=1e-4)
    np.testing.assert_allclose(agreement, table[:, 9], atol=1e-5)


@pytest.mark.parametrize("linear", ["yaw", "mirror"])
def test_geometry_does_not_change_with_the_heading(linear):
    """Oracle: symmetry; both clouds turned about z, or mirrored left to right."""
    matrix = street.pose(yaw_deg=77.0)[:3, :3] if linear == "yaw" else np.diag([1.0, -1.0, 1.0])
    *vectors, mask = random_match(1)
    here = fine.match_geometry(*as_float32((*vectors, mask)))[0]
    there = fine.match_geometry(*as_float32([v @ matrix.T for v in vectors] + [mask]))[0]
    np.testing.assert_allclose(there, here, atol=1e-3)  # log of a plane distance near zero, from coordinates at 50 m


def test_padded_rows_do_not_enter_the_means():
    """Oracle: symmetry; garbage in the padding leaves the bytes of the valid rows."""
    *vectors, mask = random_match(2)
    filled = [np.where(mask[:, None], v, 99.0) for v in vectors]
    here, there = (np.asarray(fine.match_geometry(*as_float32((*v, mask)))[0]) for v in (vectors, filled))
    assert here[mask].tobytes() == there[mask].tobytes()


def even(source, target, geometry):
    """One half for every match."""
    return jnp.zeros((len(geometry), 2))


def sensible(source, target, geometry):
    """A confidence by hand, in place of the network: near its plane, normals agree; hardly any tangential term."""
    plane_distance, agreement = geometry[:, 0], geometry[:, 9]
    logit = jnp.clip(6.0 - 60.0 * (1.0 - agreement) - 20.0 * jnp.abs(plane_distance), -10.0, 6.0)
    return jnp.stack([logit, jnp.full(len(geometry), -30.0)], axis=1)


def cloud(scan):
    embedding = jnp.zeros((len(scan.mask), 4))
    return fine.Cloud(jnp.asarray(scan.points), jnp.asarray(scan.normals), embedding, jnp.asarray(scan.mask))


@functools.cache
def perfect_clouds():
    """The street without noise, both scans."""
    poses = street.pose(), street.pose(0.5, 0.05, 1.73, yaw_deg=1.0, pitch_deg=0.3, roll_deg=-0.2)
    scans = [preprocess(street.scan(T).points, TINY.preprocess) for T in poses]
    return cloud(scans[0]), cloud(scans[1]), np.linalg.inv(poses[1]) @ poses[0]


def test_each_point_meets_its_nearest_target():
    """Oracle: scipy's cKDTree, by distance; the packed arg-min counts distances within 0.1 % as ties."""
    source, target, T = perfect_clouds()
    T = jnp.asarray(T, jnp.float32)
    target = target._replace(mask=target.mask.at[100:200].set(False))
    matches = jax.jit(functools.partial(fine.match, even))(source, target, T)
    expected, _ = cKDTree(np.asarray(target.points)[np.asarray(target.mask)]).query(np.asarray(matches.points))
    found = np.linalg.norm(np.asarray(matches.points) - np.asarray(matches.targets), axis=1)
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-5)
    np.testing.assert_allclose(matches.weights, np.where(source.mask, 0.5, 0.0), atol=1e-6)


def test_perfect_planes_give_the_motion():
    """Oracle: the poses the analytic street was seen from, no noise; voxels that reach across an edge leave some millimetres."""
    source, target, T_true = perfect_clouds()
    refine = jax.jit(functools.partial(fine.refine, sensible, num_iters=10, cfg=TINY.fine))
    poses = refine(source, target, jnp.eye(4))
    assert poses.shape == (10, 4, 4)
    before, after = errors(np.eye(4), T_true), errors(poses[-1], T_true)
    assert before[0] > 0.5
    assert after[0] < 0.01
    assert after[1] < 0.02


@pytest.mark.parametrize(("pair", "bound_m"), [("street", 0.1), ("simulated", 0.15)])
def test_untrained_network_already_registers(pair, bound_m):
    """Oracle: analytic street and simulator truth. Random confidences still weigh right planes: a decimetre, 16 beams a little more."""
    if pair == "street":
        clouds, T_true = [street_points(0), street_points(1)], T_street()
    else:
        clip = simulated_clip()
        clouds, T_true = [scan.points for scan in clip[:2]], np.linalg.inv(clip[1].T_world_lidar) @ clip[0].T_world_lidar
    scans = [preprocess(points, PreprocessConfig()) for points in clouds]
    clouds = [inference.encode(tiny_model(), scan).cloud for scan in scans]
    T = jnp.eye(4)
    for _ in range(4):
        T = refine_tiny(tiny_model(), *clouds, T)[-1]
    assert errors(np.eye(4), T_true)[0] > 0.3
    translation, rotation = errors(T, T_true)
    assert translation < bound_m
    assert rotation < 0.5


refine_tiny = jax.jit(functools.partial(delo.refine_pose, num_iters=6))


def test_gradient_is_finite_where_nothing_is_valid():
    """Oracle: zero; without points the start is the answer and no weight of the network matters."""

    def loss(variables, source_scan, target_scan):
        model = delo.Model(variables, TINY)
        source, target = (delo.encode(model, scan).cloud for scan in (source_scan, target_scan))
        return jnp.sum(delo.refine_pose(model, source, target, jnp.eye(4), num_iters=2)[:, :3])

    slope = jax.jit(jax.value_and_grad(loss))
    full, empty = street_scan(0), preprocess(street_points(0)[:0], TINY.preprocess)
    for scans in ((empty, empty), (empty, full), (full, empty), (full, full)):
        value, gradients = slope(tiny_model().variables, *scans)
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(gradients)]
        assert all(np.isfinite(leaf).all() for leaf in leaves)
        if not scans[0].mask.any():
            assert value == 6.0  # two identities, their upper three rows
            assert all(np.all(leaf == 0) for leaf in leaves)
