"""Closed-form alignment."""

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from delo_jax.geometry.procrustes import is_determined, nearest_rotation, planar_procrustes, weighted_procrustes
from tests.oracles.agreement import assert_gradient_is_the_slope, assert_transforms_agree


def problem(seed, n=12, yaw_only=False):
    rng = np.random.default_rng(seed)
    source, weights = 20 * rng.normal(size=(n, 3)), rng.uniform(size=n)
    angles = [0, 0, rng.uniform(-3, 3)] if yaw_only else rng.uniform(-1, 1, size=3)
    R = Rotation.from_rotvec(angles).as_matrix()
    return source, source @ R.T + rng.normal(size=3) + 0.3 * rng.normal(size=(n, 3)), weights


def as_float32(*arrays):
    return [jnp.asarray(array, jnp.float32) for array in arrays]


@pytest.mark.parametrize("seed", range(3))
def test_rigid_alignment_of_noisy_matches(seed):
    """Oracle: scipy Rotation.align_vectors on centred points; float32 at 20 m keeps 1e-5 m."""
    source, target, weights = problem(seed)
    means = [np.average(cloud, axis=0, weights=weights) for cloud in (source, target)]
    R = Rotation.align_vectors(target - means[1], source - means[0], weights=weights)[0].as_matrix()
    T = weighted_procrustes(*as_float32(source, target, weights))
    np.testing.assert_allclose(T[:3, :3], R, atol=2e-6)
    np.testing.assert_allclose(T[:3, 3], means[1] - R @ means[0], atol=3e-5)


@pytest.mark.parametrize("seed", range(3))
def test_planar_alignment_of_noisy_matches(seed):
    """Oracle: scalar minimisation over yaw (scipy), the translation eliminated."""
    source, target, weights = problem(seed, yaw_only=True)
    centred = [cloud - np.average(cloud, axis=0, weights=weights) for cloud in (source, target)]

    def cost(yaw):
        R = Rotation.from_rotvec([0, 0, yaw]).as_matrix()
        return np.sum(weights[:, None] * (centred[0] @ R.T - centred[1]) ** 2)

    start = min(np.linspace(-np.pi, np.pi, 100), key=cost)
    yaw = minimize_scalar(cost, bracket=(start - 0.1, start + 0.1), tol=1e-12).x
    T = planar_procrustes(*as_float32(source, target, weights))
    np.testing.assert_allclose(T[:3, :3], Rotation.from_rotvec([0, 0, yaw]).as_matrix(), atol=2e-6)
    moved = source @ np.asarray(T)[:3, :3].T + np.asarray(T)[:3, 3]
    np.testing.assert_allclose(np.average(moved - target, axis=0, weights=weights), 0, atol=3e-5)


def test_mirrored_cloud_gives_a_rotation():
    """Oracle: exhaustive, since no rotation maps a mirrored cloud exactly; det is +1 and no sampled rotation is better."""
    source = np.random.default_rng(0).normal(size=(10, 3))
    M = (source * [1, 1, -1]).T @ source
    R = np.asarray(nearest_rotation(jnp.asarray(M, jnp.float32)))
    assert np.linalg.det(R) == pytest.approx(1, abs=1e-5)
    others = Rotation.random(2000, rng=np.random.default_rng(1)).as_matrix()
    assert np.trace(R.T @ M) >= np.einsum("nij,ij->n", others, M).max()


@pytest.mark.parametrize("align", [weighted_procrustes, planar_procrustes])
def test_gradient_matches_central_differences_on_a_symmetric_cloud(align):
    """Oracle: central differences in x64, on the cloud where autodiff through svd is NaN."""
    octahedron = np.vstack([np.eye(3), -np.eye(3)])
    with jax.enable_x64(True):
        probe = jnp.arange(16.0).reshape(4, 4)

        def loss(source, target, weights):
            return jnp.sum(probe * align(source, target, weights))

        assert_gradient_is_the_slope(loss, [octahedron, octahedron, np.ones(6)], rtol=1e-7)
        assert_gradient_is_the_slope(loss, problem(0), rtol=1e-6)


@pytest.mark.parametrize("align", [weighted_procrustes, planar_procrustes])
def test_alignment_under_jit_and_vmap(align):
    """Oracle: the same function, one problem at a time, not compiled."""
    assert_transforms_agree(align, *as_float32(*(np.stack(x) for x in zip(*map(problem, range(3)), strict=True))), atol=2e-5)


translation_gradients = {  # compiled once for all cases
    align: jax.jit(jax.grad(lambda *x, align=align: jnp.sum(align(*x)[:, 3]), argnums=(0, 1, 2)))
    for align in (weighted_procrustes, planar_procrustes)
}


shapes = {
    "zero weights": ([20, 20, 20], False),
    "one point": ([20, 20, 20], False),
    "one place": ([0, 0, 0], False),
    "a line": ([20, 0, 0], False),
    "a line far out": ([20, 0, 0], False),
    "a mirrored needle": ([20, 1, 1], False),
    "a plane": ([20, 5, 0], True),
    "a mirrored plank": ([20, 5, 1], True),
    "a street": ([50, 5, 1], True),
}


def degenerate(case, seed=0):
    """Matches of a cloud of the given shape in a random pose, up to 2 cm, and whether they fix a rotation."""
    rng = np.random.default_rng(seed)
    spreads, determined = shapes[case]
    source = np.vstack([np.eye(3), -np.eye(3)]) * spreads if "needle" in case else rng.normal(size=(12, 3)) * spreads
    target = source * [1, 1, -1] if "mirrored" in case else source
    Rs = Rotation.random(2, rng=rng).as_matrix()
    weights = rng.uniform(0.5, 1, size=len(source))
    if case == "zero weights":
        weights[:] = 0
    elif case == "one point":
        weights[1:] = 0
    elif "needle" in case:
        weights[:] = 1
    offset = 70 * rng.normal(size=3) if case == "a line far out" else rng.normal(size=3)
    return source @ Rs[0].T + offset, target @ Rs[1].T + rng.normal(size=3), weights, determined


@pytest.mark.parametrize("align", [weighted_procrustes, planar_procrustes])
@pytest.mark.parametrize("case", shapes)
def test_degenerate_matches(align, case):
    """Oracle: the answer that needs no information: a rotation, the means matched, finite gradients; the flag, by construction."""
    *matches, determined = degenerate(case)
    source, target, weights = as_float32(*matches)
    assert bool(is_determined(source, target, weights)) == determined
    T = np.asarray(align(source, target, weights))
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-5)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1, abs=1e-5)
    if case == "zero weights":
        np.testing.assert_array_equal(T, np.eye(4))
    else:
        moved = np.asarray(source) @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(np.average(moved - target, axis=0, weights=weights), 0, atol=1e-4)
    gradients = translation_gradients[align](source, target, weights)
    assert all(np.all(np.isfinite(gradient)) for gradient in gradients)


@pytest.mark.parametrize("case", [case for case, (_, determined) in shapes.items() if determined])
@pytest.mark.parametrize("seed", range(3))
def test_planar_and_mirrored_clouds(case, seed):
    """Oracle: scipy Rotation.align_vectors in float64, without a reflection; its conditioning bounds the float32 error."""
    source, target, weights, _ = degenerate(case, seed)
    means = [np.average(cloud, axis=0, weights=weights) for cloud in (source, target)]
    R = Rotation.align_vectors(target - means[1], source - means[0], weights=weights)[0].as_matrix()
    T = weighted_procrustes(*as_float32(source, target, weights))
    np.testing.assert_allclose(T[:3, :3], R, atol=3e-5)


@pytest.mark.parametrize("seed", range(30))
def test_lines_and_places_are_never_determined(seed):
    """Oracle: by construction, for any length, direction, offset up to 70 m and scale of the weights, in float32."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 300))
    direction = rng.normal(size=3) * (seed % 3 > 0)
    source = rng.uniform(-40, 40, size=3) + 10 ** rng.uniform(-1, 1.5) * rng.uniform(-1, 1, size=(n, 1)) * direction
    target = source @ Rotation.random(rng=rng).as_matrix().T + rng.normal(size=3)
    weights = 10 ** rng.uniform(-10, 3) * rng.uniform(size=n)
    assert not is_determined(*as_float32(source, target, weights))


@pytest.mark.parametrize("seed", range(10))
def test_one_point_beside_the_line_determines(seed):
    """Oracle: by construction; a line of 30 m and one of its points moved 2 m away from it, up to 70 m from the sensor."""
    rng = np.random.default_rng(seed)
    direction, aside = Rotation.random(rng=rng).as_matrix()[:2]
    source = rng.uniform(-40, 40, size=3) + rng.uniform(-15, 15, size=(50, 1)) * direction
    source[7] += 2 * aside
    target = source @ Rotation.random(rng=rng).as_matrix().T + rng.normal(size=3)
    assert is_determined(*as_float32(source, target, np.ones(50)))


def test_what_is_not_finite_is_not_determined():
    """Oracle: the documented answer."""
    source, target, weights = as_float32(*problem(0))
    assert is_determined(source, target, weights)
    assert not is_determined(source.at[2, 1].set(jnp.nan), target, weights)
    assert not is_determined(source, target.at[0, 0].set(jnp.inf), weights)


def test_flag_under_jit_and_vmap_and_in_a_gradient():
    """Oracle: the same function, one problem at a time, not compiled; a derivative through the flag is zero, not NaN."""
    cases = [degenerate(case)[:3] for case in ("zero weights", "a line", "a plane", "a street")]
    assert_transforms_agree(is_determined, *as_float32(*(np.stack(x) for x in zip(*cases, strict=True))))
    flagged = jax.grad(lambda *x: jnp.where(is_determined(*x), 1.0, 0.0) + jnp.sum(x[0]), argnums=(0, 1))
    for case in cases:
        found = flagged(*as_float32(*case))
        np.testing.assert_array_equal(found[0], np.ones((12, 3)))
        np.testing.assert_array_equal(found[1], np.zeros((12, 3)))


def random_pose(rng):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(rng=rng).as_matrix(), 10 * rng.normal(size=3)
    return T


def moved_by(T, points):
    return points @ T[:3, :3].T + T[:3, 3]


aligned = jax.jit(weighted_procrustes)


def align_in_x64(*arguments):
    with jax.enable_x64(True):
        return np.asarray(aligned(*map(jnp.asarray, arguments)))


@hypothesis.given(seed=st.integers(0, 2**32 - 1))
def test_pose_follows_rigid_motions(seed):
    """Oracle: equivariance under SE(3); moving the target by G gives G T, the source T G^-1, both ways gives the inverse."""
    source, target, weights = problem(seed)
    T, G = align_in_x64(source, target, weights), random_pose(np.random.default_rng(seed))
    np.testing.assert_allclose(align_in_x64(source, moved_by(G, target), weights), G @ T, atol=1e-9)
    np.testing.assert_allclose(align_in_x64(moved_by(G, source), target, weights), T @ np.linalg.inv(G), atol=1e-9)
    np.testing.assert_allclose(align_in_x64(source, moved_by(G, source), weights), G, atol=1e-9)
    np.testing.assert_allclose(align_in_x64(target, source, weights), np.linalg.inv(T), atol=1e-9)


@hypothesis.given(seed=st.integers(0, 2**32 - 1))
def test_order_scale_and_padding_do_not_matter(seed):
    """Oracle: symmetry; rows of zero weight may hold anything finite."""
    rng = np.random.default_rng(seed)
    source, target, weights = problem(seed)
    T, order = align_in_x64(source, target, weights), rng.permutation(12)
    np.testing.assert_allclose(align_in_x64(source[order], target[order], weights[order]), T, atol=1e-9)
    np.testing.assert_allclose(align_in_x64(source, target, 10 ** rng.uniform(-6, 6) * weights), T, atol=1e-9)
    rows = rng.permutation(20)[:12]
    padded = 1e4 * rng.normal(size=(20, 3)), 1e4 * rng.normal(size=(20, 3)), np.zeros(20)
    for wide, array in zip(padded, (source, target, weights), strict=True):
        wide[rows] = array
    np.testing.assert_allclose(align_in_x64(*padded), T, atol=1e-9)
    with jax.enable_x64(True):
        assert is_determined(*map(jnp.asarray, padded))
