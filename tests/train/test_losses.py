"""Losses of matching, pose and evidence."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from scipy.linalg import expm
from scipy.special import log_softmax

from delo_jax.config import StatusConfig
from delo_jax.ops.evidence import NIG
from delo_jax.train.losses import evidence_loss, matching_loss, pose_loss, success_loss, true_matches
from tests.oracles.registration import hat
from tests.oracles.street import pose

LIMITS = StatusConfig(lost_translation_m=0.5, lost_rotation_deg=2.0)


def key_points(seed):
    """Two scans of the same place: points, normals and masks of each, and T_target_source."""
    rng = np.random.default_rng(seed)
    T = pose(1.0, -0.5, 0.1, yaw_deg=15.0, pitch_deg=1.0)
    source = rng.uniform(-6, 6, size=(20, 3))
    target = np.vstack([source[:12] @ T[:3, :3].T + T[:3, 3] + 0.4 * rng.normal(size=(12, 3)), rng.uniform(-6, 6, size=(6, 3))])
    normals = [n / np.linalg.norm(n, axis=1, keepdims=True) for n in (rng.normal(size=(20, 3)), rng.normal(size=(18, 3)))]
    normals[1][:8] = normals[0][:8] @ T[:3, :3].T
    return source, target, *normals, np.arange(20) < 17, np.arange(18) < 16, T


def as_float32(arrays):
    return [jnp.asarray(a) if a.dtype == bool else jnp.asarray(a, jnp.float32) for a in arrays]


@pytest.mark.parametrize("seed", range(3))
def test_true_matches_are_near_and_alike(seed):
    """Oracle: a double loop in float64; Gaussian of 0.7 m, cut at 1.5 m, normals within 60 deg."""
    source, target, source_normals, target_normals, source_mask, target_mask, T = data = key_points(seed)
    expected = np.zeros((20, 18))
    for i in range(17):
        for j in range(16):
            distance = np.linalg.norm(T[:3, :3] @ source[i] + T[:3, 3] - target[j])
            if distance < 1.5 and np.dot(T[:3, :3] @ source_normals[i], target_normals[j]) > 0.5:
                expected[i, j] = np.exp(-0.5 * (distance / 0.7) ** 2)
    assert np.count_nonzero(expected) >= 5
    np.testing.assert_allclose(true_matches(*as_float32(data)), expected, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_matching_loss_is_a_cross_entropy(seed):
    """Oracle: scipy's log_softmax over the valid rows and columns, averaged over those that have a true match."""
    rng = np.random.default_rng(seed)
    rows, columns = np.arange(9) < 7, np.arange(8) < 6
    scores, matches = 4 * rng.normal(size=(9, 8)), rng.uniform(size=(9, 8)) * (rng.uniform(size=(9, 8)) < 0.3)
    matches[:, 4] = matches[2] = 0.0
    matches = matches * rows[:, None] * columns
    valid_scores, valid = scores[:7, :6], matches[:7, :6]
    expected = 0.0
    for axis in (0, 1):
        mass = valid.sum(axis=axis, keepdims=True)
        entropy = -np.sum(valid / np.where(mass > 0, mass, 1) * log_softmax(valid_scores, axis=axis), axis=axis)
        expected += 0.5 * entropy[mass.squeeze(axis) > 0].mean()
    np.testing.assert_allclose(matching_loss(*as_float32((scores, matches, rows, columns))), expected, rtol=1e-5)


@pytest.mark.parametrize("valid", [(0, 0), (5, 0), (0, 5), (5, 5)])
def test_matching_loss_without_a_match_is_zero(valid):
    """Oracle: nothing to learn from; zero, with a gradient of zeros."""
    masks = [jnp.arange(5) < count for count in valid]
    scores = jnp.asarray(np.random.default_rng(0).normal(size=(5, 5)), jnp.float32)
    value, gradient = jax.value_and_grad(lambda s: matching_loss(s, jnp.zeros((5, 5)), *masks))(scores)
    assert value == 0.0
    np.testing.assert_array_equal(gradient, np.zeros((5, 5)))


@pytest.mark.parametrize(("num_iters", "weights"), [(1, [1]), (2, [0.8, 1]), (4, [0.3, 0.5, 0.8, 1])])
def test_pose_loss_weighs_the_later_iterations_more(num_iters, weights):
    """Oracle: the formula in float64, on errors of known length and angle."""
    T_true = pose(3.0, 1.0, 0.2, yaw_deg=30.0)
    lengths, angles = np.array([0.5, 0.1, 0.02, 0.003])[-num_iters:], np.array([0.05, 0.01, 1e-3, 3e-4])[-num_iters:]
    axis, direction = np.array([0.6, 0.0, 0.8]), np.array([0.0, 1.0, 0.0])
    rotations = [expm(hat(np.r_[angle * axis, np.zeros(3)])) for angle in angles]
    poses = []
    for rotation, length in zip(rotations, lengths, strict=True):
        error = rotation.copy()
        error[:3, 3] = length * direction
        poses.append(T_true @ np.linalg.inv(error))
    expected = np.average(np.log(1 + lengths / 0.01) + np.log(1 + angles / 0.001), weights=weights)
    np.testing.assert_allclose(pose_loss(*as_float32((np.array(poses), T_true))), expected, rtol=2e-3)


def test_pose_loss_is_nothing_at_the_truth_and_has_a_gradient():
    """Oracle: zero up to the floor of 1e-5 m under the square root; finite slopes exactly there and next to it."""
    T = jnp.asarray(pose(3.0, 1.0, 0.2, yaw_deg=30.0), jnp.float32)
    for poses in (jnp.stack([T, T]), jnp.stack([T.at[0, 3].add(1e-3), T])):
        value, gradient = jax.value_and_grad(lambda p: pose_loss(p, T))(poses)
        assert np.isfinite(gradient).all()
    assert pose_loss(jnp.stack([T, T]), T) < 3e-3


def random_nig(rng):
    return NIG(*(rng.normal(size=6), 10 ** rng.uniform(-1, 1, 6), 1.1 + 10 ** rng.uniform(-1, 1, 6), 10 ** rng.uniform(-1, 2, 6)))


@pytest.mark.parametrize("seed", range(3))
def test_evidence_loss_is_a_student_t_and_its_regulariser(seed):
    """Oracle: scipy.stats.t.logpdf of the error in its units, and |error - gamma| (2 nu + alpha), a lost pair's error cut at 10."""
    rng = np.random.default_rng(seed)
    units = np.repeat([1e-3, 1e-2], 3)
    scaled, error = random_nig(rng), 5 * rng.normal(size=6)
    error[0] = 80.0
    nig = NIG(scaled.gamma * units, scaled.nu, scaled.alpha, scaled.beta * units**2)
    scale = np.sqrt(scaled.beta * (1 + scaled.nu) / (scaled.nu * scaled.alpha))
    likelihood = -scipy.stats.t(df=2 * scaled.alpha, loc=scaled.gamma, scale=scale).logpdf(error)
    penalty = np.abs(np.clip(error, -10, 10) - scaled.gamma) * (2 * scaled.nu + scaled.alpha)
    observed, units = as_float32((error * units, units))
    found = evidence_loss(NIG(*as_float32(nig)), observed, units, 0.03)
    np.testing.assert_allclose(found, np.mean(likelihood + 0.03 * penalty), rtol=1e-4)


@pytest.mark.parametrize(("length_m", "angle_deg"), [(0.49, 1.9), (0.51, 0.0), (0.0, 2.1), (3.0, 30.0)])
@pytest.mark.parametrize("logit", [-40.0, -1.0, 0.0, 2.0, 40.0])
def test_success_loss_is_a_cross_entropy(length_m, angle_deg, logit):
    """Oracle: minus the log of the logistic distribution, scipy's; a pair is lost beyond 0.5 m or 2 deg in any direction."""
    observed = np.r_[np.radians(angle_deg) * np.array([0.6, 0.0, 0.8]), length_m * np.array([0.0, 0.8, -0.6])]
    lost = length_m > 0.5 or angle_deg > 2.0
    expected = -(scipy.stats.logistic.logsf(logit) if lost else scipy.stats.logistic.logcdf(logit))
    found = success_loss(jnp.asarray(logit), jnp.asarray(observed, jnp.float32), LIMITS)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-12)
