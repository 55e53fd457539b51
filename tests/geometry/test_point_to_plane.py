"""The point-to-plane step."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from delo_jax.geometry.point_to_plane import point_to_plane_step, robust_point_to_plane, robust_sweep_to_plane
from tests.oracles.agreement import assert_gradient_is_the_slope, assert_transforms_agree
from tests.oracles.registration import hat, numeric_jacobian, point_to_plane_minimum, point_to_plane_residuals


def problem(seed, n=40, spread=20.0, offset=30.0, motion=0.02):
    """Points off their planes by a small motion and 1 cm of noise, far from the origin."""
    rng = np.random.default_rng(seed)
    targets = spread * rng.normal(size=(n, 3)) + [offset, 0, 0]
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    T = expm(hat(motion * rng.normal(size=6)))
    points = targets @ T[:3, :3].T + T[:3, 3] + 0.01 * rng.normal(size=(n, 3))
    return points, targets, normals, rng.uniform(0.5, 1, size=n), rng.uniform(0, 0.1, size=n)


undamped = jax.jit(lambda *x: point_to_plane_step(*x, damping=0.0))


def as_float32(arrays):
    return [jnp.asarray(array, None if np.asarray(array).dtype == bool else jnp.float32) for array in arrays]


@pytest.mark.parametrize("seed", range(2))
def test_iterated_steps_reach_the_minimum(seed):
    """Oracle: scipy least_squares on the same objective; float32 coordinates at 50 m keep 1e-5 m."""
    points, *rest = problem(seed)
    expected = point_to_plane_minimum(points, *rest)
    step = jax.jit(lambda *x: point_to_plane_step(*x, damping=1e-5).T_delta)
    T = np.eye(4)
    for _ in range(4):
        moved = points @ T[:3, :3].T + T[:3, 3]
        T = np.asarray(step(*as_float32([moved, *rest])), np.float64) @ T
    np.testing.assert_allclose(T[:3, :3], expected[:3, :3], atol=2e-6)
    np.testing.assert_allclose(T[:3, 3], expected[:3, 3], atol=1e-4)


def test_information_is_the_gauss_newton_matrix_about_the_origin():
    """Oracle: J^T J with J by central differences of the residuals, left twist [omega, v] through scipy's expm."""
    data = problem(0)
    J = numeric_jacobian(lambda x: point_to_plane_residuals(x, *data), np.zeros(6))
    information = jax.jit(lambda *x: point_to_plane_step(*x, damping=0.1).information)(*as_float32(data))  # damping does not enter
    scale = np.sqrt(np.outer(np.diag(J.T @ J), np.diag(J.T @ J)))
    np.testing.assert_allclose(information / scale, J.T @ J / scale, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_step_is_equivariant(seed):
    """Oracle: symmetry; the same scene in another frame gives the same correction, conjugated."""
    with jax.enable_x64(True):
        points, targets, normals, weights, tangential = problem(seed)
        G = expm(hat(np.random.default_rng(seed).normal(size=6)))
        R, t = G[:3, :3], G[:3, 3]
        step = jax.jit(lambda *x: point_to_plane_step(*map(jnp.asarray, x), damping=1e-3).T_delta)
        here = step(points, targets, normals, weights, tangential)
        there = step(points @ R.T + t, targets @ R.T + t, normals @ R.T, weights, tangential)
        rotation_here = np.asarray(here)[:3, :3]
        np.testing.assert_allclose(there[:3, :3], R @ rotation_here @ R.T, atol=1e-4)  # the damping is not isotropic
        np.testing.assert_allclose(there, G @ np.asarray(here) @ np.linalg.inv(G), atol=1e-2)


def test_gradient_is_the_slope():
    """Oracle: central differences in x64."""
    with jax.enable_x64(True):
        probe = jnp.arange(16.0).reshape(4, 4)

        def loss(*data):
            step = point_to_plane_step(*data, damping=1e-3)
            return jnp.sum(probe * step.T_delta) + 1e-4 * jnp.sum(step.information)

        assert_gradient_is_the_slope(loss, problem(0), rtol=1e-5)


def test_step_under_jit_and_vmap():
    """Oracle: the same function, one problem at a time, not compiled."""
    batches = as_float32([np.stack(x) for x in zip(*map(problem, range(3)), strict=True)])
    assert_transforms_agree(lambda *x: point_to_plane_step(*x, damping=1e-4), *batches, rtol=1e-4, atol=1e-2)


def test_zero_weights_give_the_identity():
    """Oracle: no information, no motion; gradients stay finite."""
    points, targets, normals, weights, _ = as_float32(problem(0))
    zero = jnp.zeros_like(weights)
    step = undamped(points, targets, normals, zero, zero)
    np.testing.assert_array_equal(step.T_delta, np.eye(4))
    np.testing.assert_array_equal(step.information, np.zeros((6, 6)))
    gradients = jax.jit(jax.grad(lambda *w: jnp.sum(undamped(points, targets, normals, *w).T_delta), (0, 1)))
    assert np.all(np.isfinite(gradients(zero, zero)))


@pytest.mark.parametrize("scene", ["one plane", "corridor", "one point", "two walls at 45 deg"])
def test_free_directions_stay_put(scene):
    """Oracle: the geometry; 10 cm off along every axis comes back only where a plane says so, without undamped noise."""
    rng = np.random.default_rng(0)
    n = 1 if scene == "one point" else 200
    targets = 30 * rng.uniform(-1, 1, size=(n, 3))
    choices = {
        "one plane": [[0, 0, 1]],
        "corridor": [[0, 0, 1], [0, 1, 0]],
        "one point": [[0, 1, 0]],
        "two walls at 45 deg": [[0, np.sqrt(0.5), np.sqrt(0.5)], [0, np.sqrt(0.5), -np.sqrt(0.5)]],
    }[scene]
    normals = np.array(choices)[np.arange(n) % len(choices)]
    data = as_float32([targets + 0.1, targets, normals, np.ones(n), np.zeros(n)])
    T = np.asarray(undamped(*data).T_delta)
    assert np.all(np.isfinite(T))
    assert np.abs(T[0, 3]) < 1e-3
    moved = np.asarray(data[0]) @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(np.sum(normals * (moved - targets), axis=1), 0, atol=2e-3)


def outlier_problem(seed, n=400, share=0.3):
    """Points a small motion off their planes, and a share of matches whose planes are a metre away; the motion back."""
    points, targets, normals, _, _ = problem(seed, n=n, offset=0.0, motion=0.01)
    rng = np.random.default_rng(seed)
    wrong = rng.random(n) < share
    targets = np.where(wrong[:, None], targets + rng.choice([-1, 1], n)[:, None] * normals * rng.uniform(0.4, 1.0, n)[:, None], targets)
    return points, normals, np.ones(n, bool), targets, normals, wrong


robust = functools.partial(jax.jit(robust_point_to_plane, static_argnames=("scale_m", "reach_m", "num_steps")), scale_m=0.1, reach_m=5.0)


@pytest.mark.parametrize("seed", range(3))
def test_robust_steps_find_the_fit_of_the_good_matches(seed):
    """Oracle: scipy least_squares on the good matches alone; what is left of a match 0.4 m off, at 0.1 m scale, weighs 0.3 %."""
    points, source_normals, mask, targets, normals, wrong = outlier_problem(seed)
    good = ~wrong
    ones, zeros = np.ones(good.sum()), np.zeros(good.sum())
    expected = point_to_plane_minimum(points[good], targets[good], normals[good], ones, zeros)
    found = robust(*as_float32([points, source_normals, mask, targets, normals, np.eye(4)]), num_steps=15)
    np.testing.assert_allclose(found.T_target_source[:3, :3], expected[:3, :3], atol=3e-4)
    np.testing.assert_allclose(found.T_target_source[:3, 3], expected[:3, 3], atol=3e-3)
    assert float(found.score) == pytest.approx(good.mean(), abs=0.05)  # 1 cm of noise costs 2 %
    assert float(found.rms_m) == pytest.approx(0.01, abs=0.006)


def test_robust_fit_ignores_what_is_no_match():
    """Oracle: the same fit without those rows; masked, out of reach, normals apart."""
    points, source_normals, mask, targets, normals, _ = outlier_problem(1, n=120, share=0.0)
    mask[:10] = False
    targets[10:20] += 7.0
    source_normals = np.where((np.arange(120) // 10 == 2)[:, None], -normals, source_normals)
    found = robust(*as_float32([points, source_normals, mask, targets, normals, np.eye(4)]), num_steps=3)
    kept = slice(30, None)
    alone = robust(*as_float32([points[kept], normals[kept], mask[kept], targets[kept], normals[kept], np.eye(4)]), num_steps=3)
    np.testing.assert_allclose(found.T_target_source, alone.T_target_source, atol=1e-5)
    np.testing.assert_allclose(found.information, alone.information, rtol=1e-3, atol=1e-3)
    assert float(found.score) == pytest.approx(float(alone.score) * 90 / 110, rel=1e-3)


def test_robust_information_is_that_of_a_right_perturbation():
    """Oracle: J^T J with J by central differences of the plane distances under T exp(xi), all weights near one."""
    points, source_normals, mask, targets, normals, _ = outlier_problem(2, share=0.0)
    found = robust(*as_float32([points, source_normals, mask, targets, normals, np.eye(4)]), num_steps=8)
    T = np.asarray(found.T_target_source, np.float64)

    def distances(xi):
        moved = points @ (T @ expm(hat(xi)))[:3, :3].T + (T @ expm(hat(xi)))[:3, 3]
        return np.sum((moved - targets) * normals, axis=1)

    J = numeric_jacobian(distances, np.zeros(6))
    expected = J.T @ J / len(points)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found.information / scale, expected / scale, atol=0.02)


def test_robust_fit_without_a_match():
    """Oracle: the start, and a score of zero; nothing that is not finite."""
    points, source_normals, mask, targets, normals, _ = outlier_problem(0, n=50)
    found = robust(*as_float32([points, source_normals, mask, targets + 100.0, normals, np.eye(4)]), num_steps=2)
    np.testing.assert_allclose(found.T_target_source, np.eye(4), atol=1e-6)
    assert float(found.score) < 1e-6
    assert all(np.isfinite(array).all() for array in found)


SWEEP_OPTIONS = {"scale_m": 0.5, "reach_m": 5.0, "sigma_velocity": (0.5, 2.0), "sigma_m": 1e-3}
sweep = functools.partial(
    jax.jit(robust_sweep_to_plane, static_argnames=("scale_m", "reach_m", "num_steps", "sigma_velocity", "sigma_m")), **SWEEP_OPTIONS
)


def moving_sweep(seed, velocity, normals=None, n=600):
    """Points on planes around a sensor that moves, each in its frame at its own time; the pose at the stamp is the identity."""
    rng = np.random.default_rng(seed)
    targets = 20 * rng.uniform(-1, 1, (n, 3))
    if normals is None:
        normals = rng.normal(size=(n, 3))
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    times = -np.arctan2(targets[:, 1], targets[:, 0]) / (2 * np.pi) * 0.1
    Ts = expm(np.array([hat(-t * velocity) for t in times]))  # from the frame at the stamp to that at t
    points = np.einsum("nij,nj->ni", Ts[:, :3, :3], targets) + Ts[:, :3, 3]
    return points, normals, np.ones(n, bool), times, targets, normals


@pytest.mark.parametrize("seed", range(3))
def test_sweep_fit_finds_pose_and_velocity(seed):
    """Oracle: closed form; the sensor turns at 20 deg/s and drives 3 m/s, its pose is 10 cm and 0.6 deg off at the start."""
    velocity = np.array([0.1, -0.2, 0.35, 3.0, 0.4, -0.2])
    data = as_float32(moving_sweep(seed, velocity))
    start = expm(hat([0.006, -0.004, 0.008, 0.06, -0.05, 0.06]))
    found = sweep(*data, *as_float32([start, np.zeros(6)]), num_steps=12)
    np.testing.assert_allclose(found.velocity, velocity, atol=0.03)  # first order: 0.35 rad/s * 3 m/s * 0.05 s / 2
    np.testing.assert_allclose(found.T_target_source, np.eye(4), atol=2e-3)
    assert float(found.rms_m) < 5e-3
    assert float(found.score) > 0.99


def test_velocity_that_no_plane_holds_is_the_expected_one():
    """Oracle: the prior; in a corridor nothing moves when the sensor does, along it."""
    rng = np.random.default_rng(0)
    normals = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])[rng.integers(0, 2, 600)]
    data = as_float32(moving_sweep(1, np.array([0.0, 0.0, 0.2, 5.0, 0.0, 0.0]), normals))
    expected = np.array([0.0, 0.0, 0.0, 4.0, 0.0, 0.0])
    found = sweep(*data, *as_float32([np.eye(4), expected]), num_steps=8)
    assert float(found.velocity[3]) == pytest.approx(4.0, abs=0.1)
    assert float(found.velocity[2]) == pytest.approx(0.2, abs=0.02)


def test_sweep_of_one_instant_is_a_scan():
    """Oracle: the robust fit of a pose alone; all points measured at the stamp."""
    points, source_normals, mask, targets, normals, _ = outlier_problem(0)
    still = sweep(
        *as_float32([points, source_normals, mask, np.zeros(len(points)), targets, normals, np.eye(4), np.zeros(6)]), num_steps=20
    )
    pose = robust(*as_float32([points, source_normals, mask, targets, normals, np.eye(4)]), scale_m=0.5, num_steps=20)
    np.testing.assert_allclose(still.T_target_source, pose.T_target_source, atol=2e-4)
    np.testing.assert_allclose(still.velocity, np.zeros(6), atol=1e-6)
    np.testing.assert_allclose(float(still.score), float(pose.score), atol=1e-4)
    scale = np.sqrt(np.outer(np.diag(pose.information), np.diag(pose.information)))
    np.testing.assert_allclose(still.information / scale, pose.information / scale, atol=1e-3)


def test_sweep_information_has_the_velocity_free():
    """Oracle: central differences of the plane distances in float64, and the pose's block of the inverse of the whole matrix."""
    velocity = np.array([0.05, -0.1, 0.2, 2.0, 0.3, -0.1])
    points, source_normals, mask, times, targets, normals = moving_sweep(2, velocity)
    found = sweep(*as_float32([points, source_normals, mask, times, targets, normals, np.eye(4), velocity]), num_steps=8)

    def distances(x):
        Ts = np.array([expm(hat(x[:6])) @ expm(hat(t * (velocity + x[6:]))) for t in times])
        return np.sum((np.einsum("nij,nj->ni", Ts[:, :3, :3], points) + Ts[:, :3, 3] - targets) * normals, axis=1)

    J = numeric_jacobian(distances, np.zeros(12))
    prior = np.repeat([(1e-3 / 0.5) ** 2, (1e-3 / 2.0) ** 2], 3)
    whole = J.T @ J / len(points) + np.diag(np.r_[np.zeros(6), prior])
    expected = np.linalg.inv(np.linalg.inv(whole)[:6, :6])
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found.information / scale, expected / scale, atol=0.02)


def test_sweep_fit_without_a_match():
    """Oracle: the start, and a score of zero; nothing that is not finite."""
    points, source_normals, mask, times, targets, normals = as_float32(moving_sweep(0, np.zeros(6), n=50))
    found = sweep(points, source_normals, mask, times, targets + 100.0, normals, *as_float32([np.eye(4), np.zeros(6)]), num_steps=2)
    np.testing.assert_allclose(found.T_target_source, np.eye(4), atol=1e-5)
    assert float(found.score) < 1e-6
    assert all(np.isfinite(array).all() for array in found)
