"""Measures of calibration."""

import numpy as np
import pytest
import uncertainty_toolbox as uct
from scipy.stats import chi2, multivariate_normal
from sklearn.metrics import roc_auc_score

from delo_jax.errors import DeloError
from delo_jax.metrics.calibration import auroc, block_interval, coverage, nees, negative_log_likelihood, sparsification_error


def gaussian(seed, n=400, k=6):
    """Errors drawn from covariances of many sizes."""
    rng = np.random.default_rng(seed)
    halves = rng.normal(size=(n, k, k)) * np.exp(rng.normal(size=(n, 1, 1)))
    covariances = halves @ halves.transpose(0, 2, 1) + 1e-3 * np.eye(k)
    errors = np.array([rng.multivariate_normal(np.zeros(k), C) for C in covariances])
    return errors, covariances


@pytest.mark.parametrize("seed", range(3))
def test_likelihood_is_that_of_scipy(seed):
    """Oracle: scipy.stats.multivariate_normal, one by one."""
    errors, covariances = gaussian(seed, n=50)
    expected = [-multivariate_normal(np.zeros(6), C).logpdf(e) for e, C in zip(errors, covariances, strict=True)]
    np.testing.assert_allclose(negative_log_likelihood(errors, covariances), expected, rtol=1e-6)


def test_consistency_of_what_is_consistent():
    """Oracle: the chi-squared distribution that the squares follow by construction."""
    squares = nees(*gaussian(0, n=4000))
    assert np.mean(squares) == pytest.approx(6.0, rel=0.05)
    for level in (0.5, 0.95):
        assert np.mean(squares <= chi2(6).ppf(level)) == pytest.approx(level, abs=0.02)
    errors, covariances = gaussian(0, n=10)
    np.testing.assert_allclose(nees(errors, 4.0 * covariances), nees(errors, covariances) / 4.0)


@pytest.mark.parametrize("level", [0.5, 0.68, 0.95])
def test_coverage_and_likelihood_are_those_of_uncertainty_toolbox(level):
    """Oracle: uncertainty-toolbox, on errors whose sigma is a fifth too small."""
    errors, covariances = gaussian(1, k=1)
    errors, sigmas = 1.25 * errors, np.sqrt(covariances[:, :, 0])
    nothing = np.zeros(len(errors))
    expected = uct.metrics_calibration.get_proportion_in_interval(nothing, sigmas[:, 0], errors[:, 0], level)
    assert coverage(errors, sigmas, level)[0] == pytest.approx(expected, abs=1e-12)
    likelihood = uct.metrics_scoring_rule.nll_gaussian(nothing, sigmas[:, 0], errors[:, 0])
    assert np.mean(negative_log_likelihood(errors, covariances)) == pytest.approx(likelihood, rel=1e-9)


def test_sparsification_of_an_oracle_of_noise_and_of_nothing():
    """Oracle: the definition at its ends: sigmas in the order of the errors, in the opposite order, and none at all."""
    errors = np.random.default_rng(0).normal(size=2000)
    assert sparsification_error(errors, np.abs(errors)) == pytest.approx(0.0, abs=1e-12)
    constant = sparsification_error(errors, np.ones(2000))
    shuffled = sparsification_error(errors, np.random.default_rng(1).random(2000))
    assert shuffled == pytest.approx(constant, abs=0.05)
    assert sparsification_error(errors, -np.abs(errors)) > 1.5 * constant
    # of half-normal errors the oracle keeps, at a share p, the root mean square below its quantile; integrated numerically
    shares = (np.arange(100_000) + 0.5) / 100_000
    squares = np.cumsum(chi2(1).ppf(shares)) / np.arange(1, 100_001)
    assert constant == pytest.approx(1.0 - np.mean(np.sqrt(squares)), abs=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_detection_is_that_of_scikit_learn(seed):
    """Oracle: sklearn.metrics.roc_auc_score, with ties."""
    rng = np.random.default_rng(seed)
    positive = rng.random(200) < 0.3
    scores = np.round(rng.normal(size=200) + positive, 1)
    assert auroc(scores, positive) == pytest.approx(roc_auc_score(positive, scores), abs=1e-12)
    assert np.isnan(auroc(scores, np.zeros(200, bool)))


@pytest.mark.parametrize("length", [1, 10])
def test_interval_of_a_mean_of_rows_that_come_in_blocks(length):
    """Oracle: the standard error of the mean of independent draws, each of which stands `length` times in a row."""
    rng = np.random.default_rng(length)
    draws = rng.normal(size=(400, 2)) * np.array([1.0, 3.0])
    low, high = block_interval(np.repeat(draws, length, axis=0), np.repeat(np.arange(400), length))
    half = 1.96 * draws.std(axis=0) / np.sqrt(400)
    np.testing.assert_allclose(low, draws.mean(axis=0) - half, atol=0.2 * half.min())
    np.testing.assert_allclose(high, draws.mean(axis=0) + half, atol=0.2 * half.min())


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda e, C: nees(e, C[:5]), "covariances: expected shape"),
        (lambda e, C: nees(e, 0.0 * C), "covariances: expected positive definite"),
        (lambda e, C: nees(np.full_like(e, np.nan), C), "errors: expected finite numbers"),
        (lambda e, C: coverage(e, np.zeros_like(e), 0.5), "sigmas: expected values above 0"),
        (lambda e, C: coverage(e, np.ones((3, 6)), 0.5), "sigmas: expected the shape of errors"),
        (lambda e, C: sparsification_error(e[:, 0], np.ones(3)), "sigmas: expected as many as errors"),
        (lambda e, C: block_interval(e, np.zeros(3, int)), "blocks: expected a number for each of the 10 rows"),
    ],
)
def test_what_cannot_be_measured_is_said(call, message):
    """Oracle: the documented sentence."""
    with pytest.raises(DeloError, match=message):
        call(*gaussian(0, n=10))
