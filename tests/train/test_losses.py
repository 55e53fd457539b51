"""Losses of matching, pose and evidence."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.special import log_softmax

from delo_jax.config import StatusConfig
from delo_jax.ops.evidence import NIG
from delo_jax.ops.matching import barycentric_projection
from delo_jax.train.losses import (
    auxiliary_loss,
    evidence_loss,
    matching_loss,
    matrix_loss,
    plan_loss,
    point_loss,
    pose_loss,
    success_loss,
    true_matches,
)
from delo_jax.train.presets import PRESETS
from tests.oracles.agreement import assert_gradient_is_the_slope
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


def student_t(nig, observed):
    """Minus scipy's log density of each component, and |observed - gamma| (2 nu + alpha)."""
    scale = np.sqrt(nig.beta * (1 + nig.nu) / (nig.nu * nig.alpha))
    likelihood = -scipy.stats.t(df=2 * nig.alpha, loc=nig.gamma, scale=scale).logpdf(observed)
    return likelihood, np.abs(observed - nig.gamma) * (2 * nig.nu + nig.alpha)


@pytest.mark.parametrize("seed", range(3))
def test_evidence_loss_is_a_student_t_and_its_regulariser(seed):
    """Oracle: scipy.stats.t.logpdf and |error - gamma| (2 nu + alpha), each axis with its own weight, a lost pair's error cut at 10."""
    rng = np.random.default_rng(seed)
    nig, error, weights = random_nig(rng), 5 * rng.normal(size=6), np.repeat([0.03, 0.5], 3)
    error[0] = 80.0
    likelihood, _ = student_t(nig, error)
    _, penalty = student_t(nig, np.clip(error, -10, 10))
    observed, lambdas = as_float32((error, weights))
    found = evidence_loss(NIG(*as_float32(nig)), observed, lambdas, 10.0)
    np.testing.assert_allclose(found, np.mean(likelihood + weights * penalty), rtol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_released_evidence_loss_is_ours_in_other_weights(seed):
    """Oracle: the released code's sum, transcribed: 1e-4 (mean of three angles + mean of three translations, 0.2 and 0.02)."""
    rng = np.random.default_rng(seed)
    nig, truth, cfg = random_nig(rng), rng.normal(size=6), PRESETS["official"]
    likelihood, penalty = student_t(nig, truth)
    released = 1e-4 * (likelihood[:3].mean() + 0.2 * penalty[:3].mean() + likelihood[3:].mean() + 0.02 * penalty[3:].mean())
    weights = np.repeat([cfg.rotation_regulariser, cfg.translation_regulariser], 3)
    ours = cfg.evidence_weight * evidence_loss(NIG(*as_float32(nig)), *as_float32((truth, weights)))
    np.testing.assert_allclose(ours, released, rtol=1e-4)


def moved_cloud(seed):
    """Two poses, points of which the last are padding, and the mask."""
    rng = np.random.default_rng(seed)
    poses = [pose(*rng.uniform(-2, 2, 3), yaw_deg=rng.uniform(-20, 20), roll_deg=rng.uniform(-5, 5)) for _ in range(2)]
    return *poses, rng.uniform(-30, 30, size=(20, 3)), np.arange(20) < 17


def rigid(T, points):
    return Rotation.from_matrix(T[:3, :3]).apply(points) + T[:3, 3]


@pytest.mark.parametrize("seed", range(3))
def test_point_loss_is_the_l1_of_the_moved_points(seed):
    """Oracle: scipy's Rotation in float64; the mean over valid points of the sum, of which the code's mean over coordinates is a third."""
    T, T_true, points, mask = data = moved_cloud(seed)
    difference = np.abs(rigid(T, points[:17]) - rigid(T_true, points[:17]))
    found = point_loss(*as_float32(data))
    np.testing.assert_allclose(found, difference.sum(axis=1).mean(), rtol=1e-5)
    np.testing.assert_allclose(found / 3, difference.mean(), rtol=1e-5)
    filled = points.copy()
    filled[17:] = 1e4
    assert point_loss(*as_float32((T, T_true, filled, mask))) == found


@pytest.mark.parametrize("seed", range(3))
def test_matrix_loss_is_that_of_the_released_code(seed):
    """Oracle: two mean squared errors in float64: of R^T R_true against the identity, five times, and of the translations."""
    T, T_true, *_ = moved_cloud(seed)
    expected = 5 * np.mean((T[:3, :3].T @ T_true[:3, :3] - np.eye(3)) ** 2) + np.mean((T[:3, 3] - T_true[:3, 3]) ** 2)
    np.testing.assert_allclose(matrix_loss(*as_float32((T, T_true))), expected, rtol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_auxiliary_loss_is_the_l1_of_the_matches(seed):
    """Oracle: NumPy in float64, row by row; rows without mass do not count. The code's weight is that of a mean over coordinates."""
    _, T_true, points, _ = moved_cloud(seed)
    rng = np.random.default_rng(seed)
    plan, target = rng.uniform(size=(20, 15)) ** 6, rng.uniform(-30, 30, size=(15, 3))
    plan[[3, 19]] = 0.0
    rows = [np.abs(plan[i] @ target / plan[i].sum() - rigid(T_true, points[i])) for i in range(20) if i not in (3, 19)]
    matched, weights = barycentric_projection(*as_float32((plan, target)))
    found = auxiliary_loss(matched, weights, *as_float32((T_true, points)))
    np.testing.assert_allclose(found, np.mean([row.sum() for row in rows]), rtol=1e-5)
    np.testing.assert_allclose(PRESETS["official"].aux_weight * found, 0.05 * np.mean(rows), rtol=1e-5)
    assert PRESETS["paper"].aux_weight == 0.05


@pytest.mark.parametrize("seed", range(3))
def test_plan_loss_is_a_cross_entropy(seed):
    """Oracle: minus the sum of p log q in float64, plan and matches as distributions over pairs; their scale is of no account."""
    rng = np.random.default_rng(seed)
    plan, matches = rng.uniform(size=(9, 8)), rng.uniform(size=(9, 8)) * (rng.uniform(size=(9, 8)) < 0.3)
    expected = -np.sum(matches / matches.sum() * np.log(plan / plan.sum()))
    np.testing.assert_allclose(plan_loss(*as_float32((plan, matches))), expected, rtol=1e-5)
    np.testing.assert_allclose(plan_loss(*as_float32((0.1 * plan, 7 * matches))), expected, rtol=1e-5)
    elsewhere = plan + 5 * (matches == 0)  # mass where there is no match
    assert plan_loss(*as_float32((elsewhere, matches))) > expected


def auxiliary(plan, target, T_true, points):
    """The loss of a plan."""
    matched, weights = barycentric_projection(plan, target)
    return auxiliary_loss(matched, weights, T_true, points)


def test_losses_have_the_slopes_of_their_values():
    """Oracle: central differences in x64."""
    T, T_true, points, mask = moved_cloud(0)
    rng = np.random.default_rng(1)
    plan, target, matches = rng.uniform(0.1, 1, size=(20, 15)), rng.uniform(-30, 30, size=(15, 3)), rng.uniform(size=(20, 15))
    nig, regularisers, truth = random_nig(rng), np.repeat([0.2, 0.02], 3), rng.normal(size=6)
    with jax.enable_x64(True):
        mask = jnp.asarray(mask)
        T_to, at, true, lambdas = (jnp.asarray(array) for array in (T_true, points, matches, regularisers))
        assert_gradient_is_the_slope(lambda T: point_loss(T, T_to, at, mask), [T], rtol=1e-5)
        assert_gradient_is_the_slope(lambda T: matrix_loss(T, T_to), [T], rtol=1e-5)
        assert_gradient_is_the_slope(lambda p, t: auxiliary(p, t, T_to, at), [plan, target], rtol=1e-5)
        assert_gradient_is_the_slope(lambda p: plan_loss(p, true), [plan], rtol=1e-5)
        assert_gradient_is_the_slope(lambda *n: evidence_loss(NIG(*n[:4]), n[4], lambdas), [*nig, truth], rtol=1e-5)


@pytest.mark.parametrize("case", ["at the truth", "no point", "no mass", "no match"])
def test_losses_of_nothing_are_finite(case):
    """Oracle: nothing to learn from is zero (or -log of a plan of zeros), and every gradient is a number."""
    T, T_true, points, mask = as_float32(moved_cloud(0))
    plan, target = jnp.full((20, 15), 1e-3), jnp.ones((15, 3))
    matches = jnp.ones((20, 15))
    if case == "at the truth":
        T = T_true
    elif case == "no point":
        mask, plan, matches = jnp.zeros(20, bool), jnp.zeros((20, 15)), jnp.zeros((20, 15))
    elif case == "no mass":
        plan = jnp.zeros((20, 15))
    else:
        matches = jnp.zeros((20, 15))

    values = {
        "point": jax.value_and_grad(lambda T: point_loss(T, T_true, points, mask))(T),
        "matrix": jax.value_and_grad(lambda T: matrix_loss(T, T_true))(T),
        "aux": jax.value_and_grad(lambda p: auxiliary(p, target, T_true, points))(plan),
        "plan": jax.value_and_grad(lambda p: plan_loss(p, matches))(plan),
    }
    zero = {
        "at the truth": {"point", "matrix"},
        "no point": {"point", "aux", "plan"},
        "no mass": {"aux"},
        "no match": {"plan"},
    }
    for name, (value, gradient) in values.items():
        assert np.isfinite(value)
        assert np.isfinite(gradient).all()
        if name in zero[case]:
            np.testing.assert_allclose(value, 0.0, atol=1e-6)
        else:
            assert value > 0


@pytest.mark.parametrize(("length_m", "angle_deg"), [(0.49, 1.9), (0.51, 0.0), (0.0, 2.1), (3.0, 30.0)])
@pytest.mark.parametrize("logit", [-40.0, -1.0, 0.0, 2.0, 40.0])
def test_success_loss_is_a_cross_entropy(length_m, angle_deg, logit):
    """Oracle: minus the log of the logistic distribution, scipy's; a pair is lost beyond 0.5 m or 2 deg in any direction."""
    observed = np.r_[np.radians(angle_deg) * np.array([0.6, 0.0, 0.8]), length_m * np.array([0.0, 0.8, -0.6])]
    lost = length_m > 0.5 or angle_deg > 2.0
    expected = -(scipy.stats.logistic.logsf(logit) if lost else scipy.stats.logistic.logcdf(logit))
    found = success_loss(jnp.asarray(logit), jnp.asarray(observed, jnp.float32), LIMITS)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-12)
