"""From evidence to a covariance."""

import numpy as np
import pytest
import scipy.stats

from delo_jax.config import StatusConfig
from delo_jax.uncertainty.covariance import Uncertainty, from_evidence, unknown, widen

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


def test_widening_raises_what_is_too_small_and_nothing_else():
    """Oracle: by hand, axis by axis; the noise of the data stays, the doubt fills up."""
    aleatoric = np.array([1e-6, 1e-6, 1.0, 1.0, 3.0, 5.0])
    epistemic = np.array([1e-6, 1.0, 1e-6, 1.0, 3.0, 0.5])
    found = widen(Uncertainty(aleatoric, epistemic, np.diag(aleatoric + epistemic)), CFG)
    small = np.radians(10.0) ** 2
    np.testing.assert_allclose(np.diag(found.covariance), [small, 1.0 + 1e-6, 1.0 + 1e-6, 4.0, 6.0, 5.5])
    np.testing.assert_array_equal(found.aleatoric, aleatoric)
    np.testing.assert_allclose(found.epistemic, np.diag(found.covariance) - aleatoric)
