"""Closed-form alignment."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from delo_jax.geometry.procrustes import nearest_rotation, planar_procrustes, weighted_procrustes
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


@pytest.mark.parametrize("align", [weighted_procrustes, planar_procrustes])
@pytest.mark.parametrize("case", ["zero weights", "one point", "one place", "a line"])
def test_degenerate_matches(align, case):
    """Oracle: the answer that needs no information: a rotation, the means matched, finite gradients."""
    source, target, weights = as_float32(*problem(0))
    if case == "zero weights":
        weights = jnp.zeros_like(weights)
    elif case == "one point":
        weights = jnp.zeros_like(weights).at[3].set(2.0)
    elif case == "one place":
        source, target = jnp.ones_like(source), 2 * jnp.ones_like(source)
    else:
        source = source * jnp.asarray([[1.0, 0.0, 0.0]])
        target = source + 1.0
    T = np.asarray(align(source, target, weights))
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-5)
    if case == "zero weights":
        np.testing.assert_array_equal(T, np.eye(4))
    else:
        moved = np.asarray(source) @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(np.average(moved - target, axis=0, weights=weights), 0, atol=3e-5)
    gradients = translation_gradients[align](source, target, weights)
    assert all(np.all(np.isfinite(gradient)) for gradient in gradients)
