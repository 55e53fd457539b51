"""From evidence to a covariance."""

import numpy as np
import pytest
import scipy.stats

from delo_jax.config import StatusConfig
from delo_jax.uncertainty.covariance import from_evidence, unknown, widen
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
