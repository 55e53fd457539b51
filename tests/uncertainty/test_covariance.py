"""From evidence to a covariance."""

import numpy as np
import pytest
import scipy.stats

from delo_jax.config import StatusConfig
from delo_jax.uncertainty.covariance import from_evidence, unknown, widen_along

CFG = StatusConfig(unknown_rotation_deg=10.0, unknown_translation_m=2.0)


@pytest.mark.parametrize("seed", range(3))
def test_variances_add_up_to_that_of_the_prediction(seed):
    """Oracle: scipy. The prediction is a Student-t of 2 alpha degrees of freedom; given the variance, its noise is inverse gamma."""
    rng = np.random.default_rng(seed)
    nu, alpha, beta = 10 ** rng.uniform(-2, 2, 6), 1.05 + 10 ** rng.uniform(-1, 1, 6), 10 ** rng.uniform(-8, 1, 6)
    found = from_evidence(nu, alpha, beta)
    total = scipy.stats.t(df=2 * alpha, scale=np.sqrt(beta * (1 + nu) / (nu * alpha))).var()
    noise = scipy.stats.invgamma(alpha, scale=beta).mean()
    np.testing.assert_allclose(found.covariance, np.diag(total), rtol=1e-12)
    np.testing.assert_allclose(found.aleatoric, noise, rtol=1e-12)
    np.testing.assert_allclose(found.epistemic, total - noise, rtol=1e-9)


def test_unknown_is_what_the_config_says():
    """Oracle: by hand; (10 deg)^2 three times, (2 m)^2 three times, all of it doubt."""
    found = unknown(CFG)
    expected = [np.radians(10.0) ** 2] * 3 + [4.0] * 3
    np.testing.assert_allclose(found.covariance, np.diag(expected))
    np.testing.assert_allclose(found.epistemic, expected)
    np.testing.assert_array_equal(found.aleatoric, np.zeros(6))


def test_widening_adds_doubt_along_one_direction():
    """Oracle: quadratic forms; along the direction 4 m^2 more, across it and in rotation nothing."""
    rng = np.random.default_rng(0)
    known = from_evidence(np.ones(6), np.full(6, 2.0), rng.uniform(1e-6, 1e-3, 6))
    direction, across, _ = np.linalg.qr(rng.normal(size=(3, 3)))[0].T
    found = widen_along(known, direction, CFG)
    added = (found.covariance - known.covariance)[3:, 3:]
    np.testing.assert_allclose([direction @ added @ direction, across @ added @ across], [4.0, 0.0], atol=1e-12)
    np.testing.assert_array_equal(found.covariance[:3], known.covariance[:3])
    np.testing.assert_allclose(found.aleatoric + found.epistemic, np.diag(found.covariance))
