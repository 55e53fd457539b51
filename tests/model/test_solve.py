"""The solve of a pair: two hypotheses, padding, symmetry, statistics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag, expm

from delo_jax import inference
from delo_jax.model import delo, fine
from delo_jax.model.statistics import NUM_STATISTICS
from delo_jax.ops import evidence
from delo_jax.preprocess import preprocess
from tests.fixtures import TINY, T_street, dirty, errors, street_points, street_poses, street_scan, thinned, tiny_model
from tests.oracles.registration import hat, numeric_jacobian
from tests.oracles.street import pose


def fingerprints(points_world, seed=0):
    """Descriptors by hand: random Fourier features of the position in the world, alike within about 2 m."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(size=(3, 64)) / 1.5, rng.uniform(0, 2 * np.pi, 64)
    features = np.cos(points_world @ waves + phases)
    return jnp.asarray(features / np.linalg.norm(features, axis=1, keepdims=True), jnp.float32)


def encoded(frame, descriptors="world"):
    """Encoding of a street scan whose key points know where they are in the world, or say something random."""
    encoding = jax.device_get(inference.encode(tiny_model(), street_scan(frame)))
    T = street_poses()[frame]
    world = encoding.keypoints @ T[:3, :3].T + T[:3, 3]
    if descriptors == "random":
        world = 1e3 * np.random.default_rng(frame).normal(size=world.shape)
    return encoding._replace(descriptors=fingerprints(world) * encoding.keypoint_mask[:, None])


def solve(source, target, T_init=None):
    return jax.device_get(inference.solve(tiny_model(), source, target, jnp.asarray(np.eye(4) if T_init is None else T_init, jnp.float32)))


def test_good_start_survives_a_hopeless_coarse_stage():
    """Oracle: the poses of the street; descriptors are random, the start is the truth, off by the untrained fine stage at most."""
    found = solve(encoded(0, "random"), encoded(1, "random"), T_street())
    assert not found.used_coarse
    assert errors(found.T_target_source, T_street())[0] < 0.25
    assert found.finite


def test_good_coarse_stage_survives_a_hopeless_start():
    """Oracle: the poses of the street; descriptors know the world, the start is 9 m and 40 deg off."""
    found = solve(encoded(0), encoded(1), pose(8.0, -4.0, 0.0, yaw_deg=40.0))
    assert found.used_coarse
    assert errors(found.T_target_source, T_street())[0] < 0.25


def test_padding_changes_nothing():
    """Oracle: symmetry; 200 valid rows of 256 that are solved for, garbage in the others, the same bytes in every output."""
    scans = [thinned(street_scan(frame), 200, 40) for frame in (0, 1)]
    clean, filled = (solve(*(inference.encode(tiny_model(), s) for s in pair)) for pair in (scans, [dirty(s) for s in scans]))
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(clean)]
    leaves = zip(paths, jax.tree.leaves(clean), jax.tree.leaves(filled), strict=True)
    assert [path for path, a, b in leaves if not np.array_equal(a, b)] == []


def test_order_of_the_points_does_not_matter():
    """Oracle: symmetry, up to near ties of the nearest neighbour and the order of sums: millimetres."""
    source, target = encoded(0), encoded(1)
    order = np.random.default_rng(0).permutation(len(target.cloud.mask))
    head = np.random.default_rng(1).permutation(TINY.fine.num_points // 2)  # the two rounds see the first half, then all
    shuffled = jax.tree.map(lambda a: a[order], target.cloud)
    mixed = jax.tree.map(lambda a: np.concatenate([a[head], a[len(head) :]]), source.cloud)
    here, there = solve(source, target), solve(source._replace(cloud=mixed), target._replace(cloud=shuffled))
    np.testing.assert_allclose(there.T_target_source, here.T_target_source, atol=5e-3)


@pytest.mark.parametrize("yaw_deg", [40.0, -160.0])
def test_pose_turns_with_both_scans(yaw_deg):
    """Oracle: symmetry; the pose of a turned pair is conjugated, what the solver knows of it stays."""
    G = pose(z=0.0, yaw_deg=yaw_deg)
    R = G[:3, :3].astype(np.float32)

    def turned(encoding):
        cloud = encoding.cloud._replace(points=encoding.cloud.points @ R.T, normals=encoding.cloud.normals @ R.T)
        return encoding._replace(cloud=cloud, keypoints=encoding.keypoints @ R.T, keypoint_normals=encoding.keypoint_normals @ R.T)

    here, there = solve(encoded(0), encoded(1)), solve(turned(encoded(0)), turned(encoded(1)))
    np.testing.assert_allclose(there.T_target_source, G @ here.T_target_source @ np.linalg.inv(G), atol=5e-3)
    np.testing.assert_allclose(there.statistics, here.statistics, atol=0.2)  # in standard deviations
    turn = block_diag(R, R)  # a right perturbation of G T G^-1 is that of T, turned
    np.testing.assert_allclose(there.information, turn @ here.information @ turn.T, atol=0.02 * np.abs(here.information).max())


def test_one_pair_at_a_time_or_several():
    """Oracle: the same function in a loop; float32 sums in another order, through eight iterations."""
    pairs = [(encoded(0), encoded(1), np.eye(4)), (encoded(1), encoded(0), np.linalg.inv(T_street()))]
    stacked = [jax.tree.map(lambda *leaves: jnp.stack(leaves), *column) for column in zip(*pairs, strict=True)]
    stacked[2] = stacked[2].astype(jnp.float32)
    batch = jax.jit(jax.vmap(delo.solve, in_axes=(None, 0, 0, 0)))(tiny_model(), *stacked)
    for k, pair in enumerate(pairs):
        one = solve(*pair)
        np.testing.assert_allclose(batch.T_target_source[k], one.T_target_source, atol=2e-3)
        np.testing.assert_allclose(batch.statistics[k], one.statistics, atol=0.2)  # in standard deviations
        np.testing.assert_allclose(batch.confidence[k], one.confidence, atol=1e-3)
        assert batch.used_coarse[k] == one.used_coarse


@pytest.mark.parametrize("empty", [(True, False), (False, True), (True, True)])
def test_empty_scans_give_finite_numbers(empty):
    """Oracle: nothing to see, nothing to move; the start comes back where there is no source."""
    nothing = preprocess(street_points(0)[:0], TINY.preprocess)
    scans = [nothing if gone else street_scan(frame) for frame, gone in enumerate(empty)]
    T_init = T_street()
    source, target = (inference.encode(tiny_model(), scan) for scan in scans)
    found = solve(source, target, T_init)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    if empty[0]:
        np.testing.assert_array_equal(found.information, np.zeros((6, 6)))
        np.testing.assert_allclose(found.T_target_source, T_init, atol=1e-6)


def test_evidence_is_in_the_units_of_the_config():
    """Oracle: the same raw numbers, constrained, times 1 mrad and 1 cm; their squares for the variance."""
    statistics = jnp.linspace(-1, 1, NUM_STATISTICS)
    raw, expected_logit = tiny_model().apply("evidence", statistics)
    raw = evidence.constrain(raw)
    nig, logit = delo.evidence_of_statistics(tiny_model(), statistics)
    assert logit == expected_logit
    unit = np.array([1e-3] * 3 + [1e-2] * 3)
    np.testing.assert_allclose(nig.gamma, raw.gamma * unit, rtol=1e-6)
    np.testing.assert_allclose(nig.beta, raw.beta * unit**2, rtol=1e-6)
    np.testing.assert_array_equal(nig.nu, raw.nu)
    np.testing.assert_array_equal(nig.alpha, raw.alpha)


def test_information_is_symmetric_and_positive():
    """Oracle: the definition; a sum of outer products."""
    information = np.asarray(solve(encoded(0), encoded(1)).information, np.float64)
    np.testing.assert_allclose(information, information.T, rtol=1e-3, atol=1e-3 * np.abs(information).max())
    assert np.linalg.eigvalsh(information).min() > 0


def test_information_is_that_of_the_planes_for_a_right_perturbation():
    """Oracle: Gauss-Newton in float64; central differences of the plane distances of T exp(xi), weighted, per unit of weight.

    Tolerance: float32 sums over arms of 30 m, and a near tie of the nearest neighbour here and there.
    """
    source, target = encoded(0), encoded(1)
    found = solve(source, target)
    cloud, T = jax.tree.map(lambda array: jnp.asarray(array[: TINY.fine.num_points]), source.cloud), jnp.asarray(found.T_target_source)
    matches = fine.match(tiny_model().confidence, cloud, jax.tree.map(jnp.asarray, target.cloud), T)
    targets, normals, weights = (np.asarray(array, np.float64) for array in (matches.targets, matches.normals, matches.weights))
    points = np.c_[np.asarray(cloud.points, np.float64), np.ones(len(cloud.points))]

    def distances(xi):
        moved = points @ (found.T_target_source.astype(np.float64) @ expm(hat(xi))).T
        return np.sum(normals * (moved[:, :3] - targets), axis=1)

    rows = numeric_jacobian(distances, np.zeros(6))
    expected = rows.T @ (weights[:, None] * rows) / weights.sum()
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found.information / scale, expected / scale, atol=5e-3)
