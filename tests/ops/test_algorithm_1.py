"""The paper's Algorithm 1 and its released loop, against float64 transcriptions in the linear domain."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import ot
import pytest
import scipy.special

from delo_jax.ops.transport import algorithm_1, partial_transport

run = jax.jit(algorithm_1, static_argnames=("num_iters", "scale_first"))


def transcription(cost, epsilon, a, b, mass, num_iters, scale_first):
    """Algorithm 1 line by line, K in the place of K-tilde in its denominator; the released code scales K before the loop."""
    K = np.exp(-cost / epsilon)
    if scale_first:
        K = K * mass / np.sum(K)
    for _ in range(num_iters):
        K = np.diag(np.minimum(a / K.sum(axis=1), 1)) @ K
        K = K @ np.diag(np.minimum(b / K.sum(axis=0), 1))
        K = K * mass / np.sum(K)
    return K


@pytest.mark.parametrize("scale_first", [False, True])
@pytest.mark.parametrize("num_iters", [0, 1, 2, 5, 50])
def test_plan_follows_the_transcription(num_iters, scale_first):
    """Oracle: the algorithm in float64 NumPy, linear domain, dense matrices; many random problems."""
    differs_from_dykstra = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        n, m = 9, 12
        a, b = rng.uniform(0.1, 1, size=n), rng.uniform(0.1, 1, size=m)
        epsilon, mass = 10 ** rng.uniform(-1.5, 0), rng.uniform(0.05, 0.99) * min(a.sum(), b.sum())
        cost = rng.uniform(size=(n, m)) + 2 * epsilon * (rng.normal(size=(n, 1)) + rng.normal(size=(1, m)))
        with jax.enable_x64(True):
            arguments = tuple(map(jnp.asarray, (cost, epsilon, a, b)))
            plan = run(*arguments, mass=jnp.asarray(mass), num_iters=num_iters, scale_first=scale_first)
            expected = transcription(cost, epsilon, a, b, mass, num_iters, scale_first)
            np.testing.assert_allclose(plan, expected, rtol=1e-9)
        optimum = ot.partial.entropic_partial_wasserstein(a, b, cost, epsilon, mass, "sinkhorn_log", numItermax=50, stopThr=-1.0)
        differs_from_dykstra += np.abs(expected - optimum).sum() > 1e-2 * mass
    assert differs_from_dykstra >= 3  # the corrections matter in these problems


@functools.cache
def half_matched(seed):
    """Scores of 64 points, the first half of which have a true match; the paper's cost, marginals and mass."""
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(2, 64, 32))
    target[:32] = source[:32] + 0.5 * rng.normal(size=(32, 32))
    scores = 2 * source @ target.T / np.sqrt(32)
    return -scipy.special.log_softmax(scores, axis=1), np.full(64, 1 / 64)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("num_iters", [5, 100])
def test_printed_loop_makes_row_weights_flat(seed, num_iters):
    """Oracle: POT's optimum selects the rows that have a match, the transcription does not, nor do more rounds help.

    Weights of matched and noise rows 1.19 / 0.81 as printed, 1.93 / 0.07 at the optimum (mean 1).
    """
    cost, share = half_matched(seed)

    def selection(plan):
        weights = np.asarray(plan).sum(axis=1)
        return weights[:32].mean() / weights[32:].mean()

    optimum = ot.partial.entropic_partial_wasserstein(share, share, cost, 0.3, 0.1, "sinkhorn_log", numItermax=500)
    printed = transcription(cost, 0.3, share, share, 0.1, num_iters, scale_first=False)
    assert selection(printed) < 2
    assert selection(optimum) > 8
    with jax.enable_x64(True):
        arguments = (jnp.asarray(cost), 0.3, jnp.asarray(share), jnp.asarray(share))
        keywords = {"mass": 0.1, "num_iters": num_iters}
        assert selection(run(*arguments, **keywords)) == pytest.approx(selection(printed), rel=1e-9)
        ours = jax.jit(functools.partial(partial_transport, **keywords))(*arguments)
        assert selection(ours) == pytest.approx(selection(optimum), rel=1e-2)
        assert selection(run(*arguments, **keywords, scale_first=True)) > 8
