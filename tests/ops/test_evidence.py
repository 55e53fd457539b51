"""The Normal-Inverse-Gamma head."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from delo_jax.ops.evidence import NIG, constrain, moments, negative_log_likelihood, regulariser
from tests.oracles.agreement import assert_gradient_is_the_slope, assert_transforms_agree


def random_nig(seed, shape=(20, 6)):
    """Parameters over the decades a pose head meets."""
    rng = np.random.default_rng(seed)
    return NIG(
        gamma=rng.normal(size=shape),
        nu=10 ** rng.uniform(-2, 2, size=shape),
        alpha=1 + 10 ** rng.uniform(-2, 1.5, size=shape),
        beta=10 ** rng.uniform(-8, 1, size=shape),
    )


def student_t(nig, loc):
    return scipy.stats.t(df=2 * nig.alpha, loc=loc, scale=np.sqrt(nig.beta * (1 + nig.nu) / (nig.nu * nig.alpha)))


@pytest.mark.parametrize("x64", [True, False])
def test_likelihood_is_a_student_t(x64):
    """Oracle: scipy.stats.t.logpdf of the same rounded numbers; in float32 the log-gammas keep 1e-4."""
    rng = np.random.default_rng(1)
    nig = random_nig(0)
    observation = nig.gamma + rng.normal(size=nig.gamma.shape) * 10 ** rng.uniform(-4, 1, size=nig.gamma.shape)
    with jax.enable_x64(x64):
        nig, observation = jax.tree.map(jnp.asarray, (nig, observation))
        found = negative_log_likelihood(nig, observation)
        nig, observation = jax.tree.map(lambda x: np.asarray(x, np.float64), (nig, observation))
        expected = -student_t(nig, nig.gamma).logpdf(observation)
        np.testing.assert_allclose(found, expected, **({"rtol": 1e-9} if x64 else {"rtol": 1e-5, "atol": 1e-4}))


def test_moments_are_those_of_the_distribution():
    """Oracle: a million draws of (mu, sigma^2) from the NIG with scipy; three standard errors are below 1 %."""
    nig = NIG(*(np.full(6, value) for value in (0.3, 2.0, 4.0, 0.5)))
    variance = scipy.stats.invgamma(4.0, scale=0.5).rvs(size=10**6, random_state=0)
    mean = scipy.stats.norm(0.3, np.sqrt(variance / 2.0)).rvs(random_state=1)
    found = moments(jax.tree.map(jnp.asarray, nig))
    np.testing.assert_allclose(found.aleatoric, variance.mean(), rtol=0.01)
    np.testing.assert_allclose(found.epistemic, mean.var(), rtol=0.01)


def test_regulariser():
    """Oracle: the formula by hand: |2 - 0.5| (2 * 3 + 4) = 15."""
    nig = NIG(*(jnp.full(6, value) for value in (0.5, 3.0, 4.0, 1.0)))
    np.testing.assert_allclose(regulariser(nig, jnp.full(6, 2.0)), np.full(6, 15.0))


@functools.partial(jax.jit, static_argnames="log_beta")
def check_up(raw, log_beta):
    """Distribution, a scalar that uses everything, and its gradient."""

    def loss(raw):
        nig = constrain(raw, log_beta=log_beta)
        variances = moments(nig)
        return jnp.sum(negative_log_likelihood(nig, nig.gamma + 1e-3)) + 1e-9 * jnp.sum(variances.aleatoric + variances.epistemic)

    return constrain(raw, log_beta=log_beta), *jax.value_and_grad(loss)(raw)


@pytest.mark.parametrize("raw", [-1e4, -30.0, 0.0, 30.0, 1e4])
@pytest.mark.parametrize("log_beta", [True, False])
def test_any_raw_number_is_a_valid_distribution(raw, log_beta):
    """Oracle: the ranges of the distribution, finite moments, likelihood and gradient in float32."""
    nig, value, gradient = check_up(jnp.full((2, 24), raw), log_beta)
    assert nig.beta.shape == (2, 6)
    assert all(np.all(field > bound) for field, bound in ((nig.nu, 0), (nig.alpha, 1), (nig.beta, 0)))
    assert np.isfinite(value)
    assert np.all(np.isfinite(gradient))


def test_raw_numbers_keep_their_order():
    """Oracle: four groups of six, told apart by value."""
    nig = constrain(jnp.repeat(jnp.array([1.0, 2.0, 3.0, 4.0]), 6))
    np.testing.assert_allclose(nig.gamma, np.ones(6))
    np.testing.assert_allclose(nig.nu, np.full(6, np.log1p(np.exp(2.0)) + 1e-3), rtol=1e-5)
    np.testing.assert_allclose(nig.alpha, np.full(6, 1 + np.log1p(np.exp(3.0)) + 1e-3), rtol=1e-5)
    np.testing.assert_allclose(nig.beta, np.full(6, np.exp(4.0)), rtol=1e-5)


@pytest.mark.parametrize("log_beta", [True, False])
def test_constraints_follow_their_formulas(log_beta):
    """Oracle: NumPy, log1p(exp) for nu and alpha, exp or log1p(exp) for beta, with the floors."""
    raw = np.random.default_rng(0).uniform(-20, 8, size=(5, 24))
    gamma, nu, alpha, beta = np.split(raw, 4, axis=1)
    expected = NIG(
        gamma=gamma,
        nu=np.log1p(np.exp(nu)) + 1e-3,
        alpha=np.log1p(np.exp(alpha)) + 1 + 1e-3,
        beta=np.exp(beta) if log_beta else np.log1p(np.exp(beta)) + 1e-6,
    )
    with jax.enable_x64(True):
        found = constrain(jnp.asarray(raw), log_beta=log_beta)
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-9), found, expected)


def test_softplus_beta_has_a_floor():
    """Oracle: softplus(-200) is zero in float32; the floor keeps the log of beta and both variances finite and positive."""
    nig = constrain(jnp.full(24, -200.0), log_beta=False)
    np.testing.assert_allclose(nig.beta, np.full(6, 1e-6), rtol=1e-6)
    np.testing.assert_allclose(moments(nig).aleatoric, np.full(6, 1e-3), rtol=1e-3)
    assert np.all(np.isfinite(negative_log_likelihood(nig, nig.gamma)))


@pytest.mark.parametrize(("nu", "alpha", "beta"), [(2.0, 4.0, 0.5), (0.1, 1.5, 3.0)])
def test_density_integrates_to_one(nu, alpha, beta):
    """Oracle: scipy quad; exp(-negative log likelihood) is a density over the observation."""
    with jax.enable_x64(True):
        nig = NIG(*(jnp.full(6, value) for value in (0.3, nu, alpha, beta)))
        density = jax.jit(lambda y: jnp.exp(-negative_log_likelihood(nig, jnp.full(6, y))[0]))
        assert scipy.integrate.quad(lambda y: float(density(y)), -np.inf, np.inf)[0] == pytest.approx(1, abs=1e-6)


def test_regulariser_weighs_nu_twice():
    """Oracle: slopes by hand; twice as steep in nu as in alpha (the paper prints it the other way round)."""
    nig = NIG(*(jnp.full(6, value) for value in (0.5, 3.0, 4.0, 1.0)))
    slopes = jax.grad(lambda nig: jnp.sum(regulariser(nig, jnp.full(6, 2.5))))(nig)
    np.testing.assert_allclose(slopes.nu, np.full(6, 4.0))
    np.testing.assert_allclose(slopes.alpha, np.full(6, 2.0))


@pytest.mark.parametrize("log_beta", [True, False])
def test_gradients_are_the_slopes(log_beta):
    """Oracle: central differences in x64."""
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):

        def loss(raw, observation):
            nig = constrain(raw, log_beta=log_beta)
            likelihood = negative_log_likelihood(nig, observation) + 0.1 * regulariser(nig, observation)
            return jnp.sum(likelihood) + jnp.sum(sum(moments(nig)))

        assert_gradient_is_the_slope(loss, [rng.normal(size=24), rng.normal(size=6)])


def test_evidence_under_jit_and_vmap():
    """Oracle: the same functions, one prediction at a time, not compiled."""
    rng = np.random.default_rng(0)
    raw, observation = (jnp.asarray(rng.normal(size=(3, width)), jnp.float32) for width in (24, 6))

    def everything(raw, y):
        nig = constrain(raw)
        return constrain(raw, log_beta=False), nig, moments(nig), negative_log_likelihood(nig, y), regulariser(nig, y)

    assert_transforms_agree(everything, raw, observation)
