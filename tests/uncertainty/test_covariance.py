"""From evidence to a covariance."""

import gtsam
import numpy as np
import pytest
import scipy.stats
from scipy.spatial.transform import Rotation

from delo_jax.config import StatusConfig
from delo_jax.uncertainty.covariance import from_evidence, from_pose6_evidence, unknown, widen
from delo_jax.uncertainty.observability import observability
from tests.uncertainty.planes import CORRIDOR, FIELD, ROOM, information

CFG = StatusConfig(unknown_rotation_deg=10.0, unknown_translation_m=2.0)
NONE = np.zeros(6)


@pytest.mark.parametrize("seed", range(3))
def test_variances_add_up_to_that_of_the_prediction(seed):
    """Oracle: scipy. The prediction is a Student-t of 2 alpha degrees of freedom; given the variance, its noise is inverse gamma."""
    rng = np.random.default_rng(seed)
    nu, alpha, beta = 10 ** rng.uniform(-2, 2, 6), 1.05 + 10 ** rng.uniform(-1, 1, 6), 10 ** rng.uniform(-8, 1, 6)
    found = from_evidence(NONE, nu, alpha, beta)
    total = scipy.stats.t(df=2 * alpha, scale=np.sqrt(beta * (1 + nu) / (nu * alpha))).var()
    noise = scipy.stats.invgamma(alpha, scale=beta).mean()
    np.testing.assert_allclose(found.covariance, np.diag(total), rtol=1e-12)
    np.testing.assert_allclose(found.aleatoric, noise, rtol=1e-12)
    np.testing.assert_allclose(found.epistemic, total - noise, rtol=1e-9)


def test_expected_error_counts_since_the_pose_is_not_moved_by_it():
    """Oracle: Monte Carlo. Second moments about zero of 400,000 errors drawn around gamma; four standard errors are 1 % of the scale."""
    rng = np.random.default_rng(0)
    gamma = np.array([1e-3, -2e-3, 0.0, 0.05, -0.02, 0.01])
    alpha, beta, nu = np.full(6, 6.0), np.square([1e-3, 1e-3, 2e-3, 0.03, 0.02, 0.01]), np.full(6, 2.0)
    found = from_evidence(gamma, nu, alpha, beta)
    variance = scipy.stats.invgamma(alpha, scale=beta).rvs((400_000, 6), random_state=rng)
    errors = gamma + rng.normal(size=(400_000, 6)) * np.sqrt(variance * (1 + 1 / nu))
    scale = np.sqrt(np.outer(np.diag(found.covariance), np.diag(found.covariance)))
    np.testing.assert_allclose(errors.T @ errors / len(errors) / scale, found.covariance / scale, atol=0.01)


def pose6_and_matrix():
    """A pose of large angles, a yaw near pi so that predictions lie across the cut, written both ways by scipy."""
    pose, T = np.array([0.4, -0.7, np.pi - 1e-3, 3.0, -2.0, 1.0]), np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("XYZ", pose[:3]).as_matrix(), pose[3:]
    return pose, T


def second_moment(T, poses):
    """Mean outer product of the right perturbations that take T to each of `poses`."""
    R = T[:3, :3].T @ Rotation.from_euler("XYZ", poses[:, :3]).as_matrix()
    twists = np.stack(
        [gtsam.Pose3.Logmap(gtsam.Pose3(gtsam.Rot3(Ri), ti)) for Ri, ti in zip(R, (poses[:, 3:] - T[:3, 3]) @ T[:3, :3], strict=True)]
    )
    return twists.T @ twists / len(twists)


@pytest.mark.parametrize("turns", [0, -1, 2])
def test_evidence_of_pose6_is_that_of_a_right_perturbation(turns):
    """Oracle: Monte Carlo by scipy and gtsam. Second moments about T of 100,000 true poses; four standard errors are 2.5 % of the scale.

    Standard deviations of a few mrad and mm, so that the first order is all there is.
    """
    rng = np.random.default_rng(0)
    pose, T = pose6_and_matrix()
    error = np.array([1e-3, -2e-3, 3e-3, 0.005, -0.002, 0.001])  # the yaw crosses pi
    alpha, beta, nu = np.full(6, 6.0), np.square([1e-3, 2e-3, 4e-3, 0.006, 0.004, 0.002]), np.full(6, 2.0)
    gamma = pose + error
    gamma[:3] += 2 * np.pi * turns
    found = from_pose6_evidence(T, gamma, nu, alpha, beta)

    normal = rng.normal(size=(2, 100_000, 6))
    sigma = np.sqrt(scipy.stats.invgamma(alpha, scale=beta).rvs((100_000, 6), random_state=rng))
    noise, doubt = normal[0] * sigma, normal[1] * sigma / np.sqrt(nu)
    scale = np.sqrt(np.outer(np.diag(found.covariance), np.diag(found.covariance)))
    np.testing.assert_allclose(second_moment(T, pose + error + noise + doubt) / scale, found.covariance / scale, atol=0.025)
    np.testing.assert_allclose(np.diag(second_moment(T, pose + noise)), found.aleatoric, rtol=0.025)
    np.testing.assert_allclose(np.diag(second_moment(T, pose + doubt)), found.epistemic, rtol=0.025)


def test_evidence_of_pose6_at_the_identity():
    """Oracle: at the identity pose6 is the twist to first order, so it is `from_evidence`, whatever the dtype."""
    rng = np.random.default_rng(0)
    evidence = [
        values.astype(np.float32) for values in (0.01 * rng.normal(size=6), np.full(6, 2.0), np.full(6, 3.0), rng.uniform(1e-6, 1e-3, 6))
    ]
    for found, expected in zip(from_pose6_evidence(np.eye(4, dtype=np.float32), *evidence), from_evidence(*evidence), strict=True):
        assert found.dtype == np.float64
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-12)


def test_unknown_is_what_the_config_says():
    """Oracle: by hand; (10 deg)^2 three times, (2 m)^2 three times, all of it doubt."""
    found = unknown(CFG)
    expected = [np.radians(10.0) ** 2] * 3 + [4.0] * 3
    np.testing.assert_allclose(found.covariance, np.diag(expected))
    np.testing.assert_allclose(found.epistemic, expected)
    np.testing.assert_array_equal(found.aleatoric, np.zeros(6))


@pytest.mark.parametrize(
    ("scene", "variances"),
    [
        (FIELD, [0, 0, (2.0 / 15) ** 2, 4.0, 4.0, 0]),
        (CORRIDOR, [0, 0, 0, 4.0, 0, 0]),
        (ROOM, [0, 0, 0, 0, 0, 0]),
    ],
)
def test_every_unheld_direction_is_widened(scene, variances):
    """Oracle: by hand; 2 m along every axis that no plane holds, at an arm of 15 m for a rotation, and nothing elsewhere."""
    rng = np.random.default_rng(0)
    known = from_evidence(rng.normal(size=6), np.ones(6), np.full(6, 2.0), rng.uniform(1e-6, 1e-3, 6))
    found = widen(known, observability(information(scene)), CFG)
    np.testing.assert_allclose(found.covariance - known.covariance, np.diag(variances), atol=1e-9)
    np.testing.assert_allclose(found.epistemic - known.epistemic, variances, atol=1e-9)
    np.testing.assert_array_equal(found.aleatoric, known.aleatoric)
