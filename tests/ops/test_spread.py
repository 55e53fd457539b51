"""The full covariance of a pose error."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.distance import mahalanobis
from scipy.stats import multivariate_normal, multivariate_t

from delo_jax.ops import spread
from delo_jax.ops.evidence import NIG, moments
from tests.oracles.agreement import assert_transforms_agree
from tests.oracles.registration import hat

UNITS = jnp.repeat(jnp.array([1e-3, 1e-2]), 3)


def problem(seed, num_inputs=5, width=4):
    """Weights of any size, inputs, a pose and an error of it."""
    rng = np.random.default_rng(seed)
    weights = spread.init(num_inputs, width, jax.random.key(seed))
    weights = {name: array + 0.3 * jnp.asarray(rng.normal(size=array.shape), jnp.float32) for name, array in weights.items()}
    weights["deviation"] = jnp.abs(weights["deviation"]) + 0.5
    T = expm(hat(rng.normal(size=6) * np.repeat([0.1, 2.0], 3)))
    error = rng.normal(size=6) * np.asarray(UNITS)
    return weights, *(jnp.asarray(array, jnp.float32) for array in (rng.normal(size=num_inputs), T, error))


@pytest.mark.parametrize("seed", range(3))
def test_likelihood_is_that_of_the_covariance(seed):
    """Oracle: scipy.stats.multivariate_normal with H H^T; the constant is that of the units and of 2 pi."""
    weights, said, T, error = problem(seed)
    H = np.asarray(spread.half(weights, said, T, UNITS), np.float64)
    expected = -multivariate_normal(np.zeros(6), H @ H.T).logpdf(np.asarray(error))
    constant = 3 * np.log(2 * np.pi) + np.log(np.asarray(UNITS, np.float64)).sum()
    assert float(spread.negative_log_likelihood(weights, said, T, error, UNITS)) + constant == pytest.approx(expected, rel=1e-4, abs=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_likelihood_of_heavy_tails(seed):
    """Oracle: scipy.stats.multivariate_t with the shape H H^T and the degrees of freedom."""
    weights, said, T, error = problem(seed)
    weights["freedom"] = jnp.array(0.5 * seed)
    H = np.asarray(spread.half(weights, said, T, UNITS), np.float64)
    assert float(spread.freedom(weights)) == pytest.approx(2.0 + np.exp(0.5 * seed), rel=1e-6)
    expected = -multivariate_t(np.zeros(6), H @ H.T, df=2.0 + np.exp(0.5 * seed)).logpdf(np.asarray(error))
    constant = 3 * np.log(np.pi) + 3 * np.log(2.0) + np.log(np.asarray(UNITS, np.float64)).sum()
    found = float(spread.student_negative_log_likelihood(weights, said, T, error, UNITS))
    assert found + constant == pytest.approx(expected, rel=1e-4, abs=1e-3)


@pytest.mark.parametrize("yaw", [0.3, -2.0, np.pi])
def test_covariance_turns_with_the_sensor(yaw):
    """Oracle: symmetry. A source sensor that is mounted turned by a yaw sees the same error in its own axes."""
    weights, said, T, _ = problem(0)
    G = expm(hat(np.array([0.0, 0.0, yaw, 0.0, 0.0, 0.0])))
    Ad = np.kron(np.eye(2), G[:3, :3])
    here, there = (np.asarray(spread.half(weights, said, jnp.asarray(pose, jnp.float32), UNITS)) for pose in (T, np.asarray(T) @ G))
    scale = np.outer(UNITS, UNITS)
    np.testing.assert_allclose(there @ there.T / scale, Ad.T @ (here @ here.T) @ Ad / scale, rtol=1e-3, atol=1e-3)


def test_a_fresh_head_says_one_unit_whatever_goes_in():
    """Oracle: the documented start, also of a pair that does not move."""
    weights = spread.init(5, 4, jax.random.key(0))
    H = spread.half(weights, jnp.full(5, 1e6), jnp.eye(4), UNITS)
    np.testing.assert_allclose(H, np.diag(UNITS), rtol=1e-6)


def test_inputs_are_finite_at_the_ends_of_the_odds():
    """Oracle: the standard deviations of the evidence in units; a certain success and a certain failure are numbers too."""
    nig = NIG(jnp.zeros(6), jnp.full(6, 2.0), jnp.full(6, 3.0), 4.0 * UNITS**2)
    for confidence in (0.0, 0.5, 1.0):
        found = spread.inputs(jnp.arange(3.0), nig, jnp.array(confidence), UNITS)
        np.testing.assert_allclose(found[3:9], 0.5 * np.log(3.0), rtol=1e-5)
        np.testing.assert_allclose(sum(moments(nig)) / UNITS**2, 3.0, rtol=1e-5)
        assert np.isfinite(found).all()
        assert np.sign(float(found[9])) == np.sign(confidence - 0.5)


def test_head_under_jit_and_vmap():
    """Oracle: one at a time, not compiled."""
    weights = problem(0)[0]
    rows = [problem(seed)[1:3] for seed in range(3)]
    batches = [jnp.stack(arrays) for arrays in zip(*rows, strict=True)]
    assert_transforms_agree(lambda said, T: spread.half(weights, said, T, UNITS) / UNITS[:, None], *batches, rtol=1e-4, atol=1e-4)


def test_doubt_is_the_distance_from_the_pairs_of_the_fit():
    """Oracle: scipy's Mahalanobis distance with the sample covariance; over the sample its mean square is one a number."""
    rng = np.random.default_rng(0)
    said = rng.normal(size=(4000, 5)) @ rng.normal(size=(5, 5)) + 3.0
    weights = spread.init(5, 3, jax.random.key(0)) | {
        "mean": jnp.asarray(said.mean(axis=0)),
        "whitener": spread.whitener(jnp.asarray(said)),
    }
    found = np.asarray(jax.vmap(spread.doubt, in_axes=(None, 0))(weights, jnp.asarray(said)), np.float64)
    squared = found / (1.0 - found)
    precision = np.linalg.inv(np.cov(said.T))
    expected = [mahalanobis(row, said.mean(axis=0), precision) ** 2 / 5 for row in said[:50]]
    np.testing.assert_allclose(squared[:50], expected, rtol=0.05)
    assert np.mean(squared) == pytest.approx(1.0, abs=0.05)
    assert float(spread.doubt(weights, jnp.asarray(said.mean(axis=0) + 100.0 * said.std(axis=0)))) > 0.99


def test_whitener_of_numbers_that_never_vary_is_finite():
    """Oracle: finite, and such a number far away is doubted."""
    W = spread.whitener(jnp.zeros((50, 3)))
    assert np.isfinite(W).all()
