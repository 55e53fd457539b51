"""The warp: slopes, base changes, poses."""

import jax.numpy as jnp
import numpy as np
import pytest

from delo_jax.sim.motion import make_motion, pose_at
from delo_jax.sim.warp import draw_warp, evaluate, flat_warp, jacobian, max_curvature, rebase, warp_poses


def random_warp(seed):
    rng = np.random.default_rng(seed)
    return draw_warp(rng, max_slope=0.09, max_bend=0.35, banks=True, verge=(4.0, 5.0))


def random_points(seed, count=200):
    return np.random.default_rng(seed).uniform([-100.0, -40.0], [300.0, 40.0], (count, 2)).T


@pytest.mark.parametrize("seed", range(5))
def test_slopes(seed):
    """Oracle: central differences in float64."""
    warp, (x, y), step = random_warp(seed), random_points(seed), 1e-5
    terms = evaluate(warp, x, y)
    along = [evaluate(warp, x + h, y) for h in (step, -step)]
    across = [evaluate(warp, x, y + h) for h in (step, -step)]
    np.testing.assert_allclose(terms.bend_x, (along[0].bend - along[1].bend) / (2 * step), atol=1e-8)
    np.testing.assert_allclose(terms.height_x, (along[0].height - along[1].height) / (2 * step), atol=1e-8)
    np.testing.assert_allclose(terms.height_y, (across[0].height - across[1].height) / (2 * step), atol=1e-8)
    assert np.abs(terms.bend_x).max() <= 0.36
    bend_slopes = evaluate(warp, np.linspace(0.0, 900.0, 9001), np.zeros(9001)).bend_x
    assert np.abs(np.gradient(bend_slopes, 0.1)).max() <= max_curvature(warp) * 1.001


@pytest.mark.parametrize("seed", range(3))
def test_base_change_and_float32(seed):
    """Oracle: the same warp in float64 from the original base, far along the road."""
    warp, (x, y) = random_warp(seed), random_points(seed)
    base = 5000.0, 3.0
    expected = evaluate(warp, x + base[0], y + base[1])
    for got, want in zip(evaluate(rebase(warp, *base), x, y), expected, strict=True):
        np.testing.assert_allclose(got, want, atol=1e-9)
    local = type(warp)(*(jnp.asarray(rows, jnp.float32) for rows in rebase(warp, *base)))
    on_device = evaluate(local, jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32))
    for got, want in zip(on_device, expected, strict=True):
        np.testing.assert_allclose(got, want, atol=3e-4)


@pytest.mark.parametrize("seed", range(4))
def test_poses_are_rigid_and_follow_the_warped_path(seed):
    """Oracle: orthonormality; forward is the central difference of the warped path; up is the road's normal."""
    warp, motion = random_warp(seed), make_motion(seed, 3.0, turning=True)
    times = np.linspace(0.1, 2.9, 50)
    flat = pose_at(motion._replace(roll=0.0 * motion.roll, pitch=0.0 * motion.pitch), times)
    poses = warp_poses(warp, flat)
    R = poses[:, :3, :3]
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)
    shift = np.zeros((50, 4, 4))
    shift[:, :3, 3] = 1e-5 * flat[:, :3, 0]
    tangent = (warp_poses(warp, flat + shift) - warp_poses(warp, flat - shift))[:, :3, 3]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    np.testing.assert_allclose(R[:, :, 0], tangent, atol=1e-7)
    J = jacobian(evaluate(warp, flat[:, 0, 3], flat[:, 1, 3]))
    normal = np.linalg.solve(J.swapaxes(1, 2), np.array([0.0, 0.0, 1.0])[None, :, None])[..., 0]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    np.testing.assert_allclose(R[:, :, 2], normal, atol=1e-12)


def test_flat_warp_is_the_identity():
    """Oracle: the definition."""
    x, y = random_points(0)
    assert not any(np.any(term) for term in evaluate(flat_warp(), x, y))
