"""Transport with a dustbin, unbalanced transport, and what is left of their marginals."""

import jax
import jax.numpy as jnp
import numpy as np
import ot
import pytest
from scipy.optimize import minimize
from scipy.special import logsumexp

from delo_jax.ops.transport import dustbin_transport, marginal_excess, unbalanced_transport

dustbin = jax.jit(dustbin_transport, static_argnames="num_iters")
unbalanced = jax.jit(unbalanced_transport, static_argnames="num_iters")


def in_x64(function, *arguments, **keywords):
    with jax.enable_x64(True):
        return np.asarray(function(*map(jnp.asarray, arguments), **keywords))


def dustbin_problem(seed, n=8, m=11):
    rng = np.random.default_rng(seed)
    return 3 * rng.normal(size=(n, m)), rng.normal(), rng.uniform(0.1, 1, size=n), rng.uniform(0.1, 1, size=m)


@pytest.mark.parametrize("num_iters", [1, 2, 5, 100])
@pytest.mark.parametrize("method", ["sinkhorn", "sinkhorn_log"])
def test_dustbin_follows_pot_on_the_augmented_problem(num_iters, method):
    """Oracle: ot.sinkhorn with one more row and column, iterate by iterate; both methods end on the rows, as we do."""
    for seed in range(5):
        scores, score, a, b = dustbin_problem(seed)
        augmented = np.pad(scores, ((0, 1), (0, 1)), constant_values=score)
        mu, nu = np.r_[a, b.sum()], np.r_[b, a.sum()]
        expected = ot.sinkhorn(mu, nu, -augmented, 1.0, method=method, numItermax=num_iters, stopThr=0, warn=False)
        plan = in_x64(dustbin, scores, score, a, b, num_iters=num_iters)
        np.testing.assert_allclose(plan, expected[:-1, :-1], rtol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_dustbin_is_the_layer_of_superglue(seed):
    """Oracle: the released layer of SuperGlue transcribed to NumPy: unit masses, norm -log(n + m), u before v, 200 rounds."""
    scores, score, _, _ = dustbin_problem(seed, 8, 11)
    n, m = scores.shape
    Z = np.pad(scores, ((0, 1), (0, 1)), constant_values=score)
    norm = -np.log(n + m)
    log_mu, log_nu = np.r_[np.full(n, norm), np.log(m) + norm], np.r_[np.full(m, norm), np.log(n) + norm]
    u, v = np.zeros(n + 1), np.zeros(m + 1)
    for _ in range(200):
        u = log_mu - logsumexp(Z + v[None], axis=1)
        v = log_nu - logsumexp(Z + u[:, None], axis=0)
    expected = np.exp(Z + u[:, None] + v[None] - norm)[:n, :m]  # one unit a point
    np.testing.assert_allclose(in_x64(dustbin, scores, score, np.ones(n), np.ones(m), num_iters=100), expected, rtol=1e-6)
    plan = in_x64(dustbin, scores, score, np.full(n, 1 / n), np.full(m, 1 / n), num_iters=100)
    np.testing.assert_allclose(n * plan, expected, rtol=1e-6)


@pytest.mark.parametrize("num_iters", [1, 5])
def test_dustbin_never_takes_more_than_a_row_has(num_iters):
    """Oracle: the documented bound, in float32 and before convergence."""
    for seed in range(5):
        scores, score, a, b = (np.float32(x) for x in dustbin_problem(seed))
        plan = np.asarray(dustbin(*map(jnp.asarray, (10 * scores, score, a, b)), num_iters=num_iters))
        assert np.all(plan.sum(axis=1) <= a * (1 + 1e-5))


@pytest.mark.parametrize(("score", "moved"), [(-40.0, 1.0), (40.0, 0.0)])
def test_dustbin_score_is_what_a_match_must_beat(score, moved):
    """Oracle: limits; a bin that nobody wants leaves balanced transport (ot.sinkhorn), one that all want takes all.

    The two bins then have only each other, and Sinkhorn's error falls like 1 / rounds: 5e-4 after a thousand.
    """
    scores, _, _, _ = dustbin_problem(0, 9, 9)
    share = np.full(9, 1 / 9)
    plan = in_x64(dustbin, scores, score, share, share, num_iters=1000)
    assert plan.sum() == pytest.approx(moved, abs=1e-3)
    if moved:
        np.testing.assert_allclose(plan, ot.sinkhorn(share, share, -scores, 1.0, numItermax=5000, stopThr=1e-14), atol=1e-3 / 9)


def unbalanced_problem(seed, n=7, m=10):
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(0.1, 1, size=n), rng.uniform(0.1, 2, size=m)
    return rng.uniform(size=(n, m)), 10 ** rng.uniform(-1.5, 0), a, b, 10 ** rng.uniform(-1, 1)


@pytest.mark.parametrize("num_iters", [1, 2, 5, 60])
def test_unbalanced_follows_pot(num_iters):
    """Oracle: ot.unbalanced.sinkhorn_unbalanced of the transposed problem (POT starts on the rows), regulariser KL(P | a b^T)."""
    for seed in range(6):
        cost, epsilon, a, b, weight = unbalanced_problem(seed)
        expected = ot.unbalanced.sinkhorn_unbalanced(b, a, cost.T, epsilon, weight, reg_type="kl", numItermax=num_iters, stopThr=0).T
        with jax.enable_x64(True):
            plan = unbalanced(*map(jnp.asarray, (cost, epsilon, a, b)), marginal_weight=jnp.asarray(weight), num_iters=num_iters)
            np.testing.assert_allclose(plan, expected, rtol=1e-9)


def test_unbalanced_minimises_its_objective():
    """Oracle: scipy minimize of the documented sum of divergences over the log of a small plan."""
    cost, _, a, b, _ = unbalanced_problem(0, 3, 4)
    epsilon, weight = 0.3, 0.7

    def divergence(x, y):
        return np.sum(x * np.log(x / y) - x + y)

    def objective(log_plan):
        plan = np.exp(log_plan.reshape(3, 4))
        marginals = divergence(plan.sum(axis=1), a) + divergence(plan.sum(axis=0), b)
        return np.sum(plan * cost) + epsilon * divergence(plan, np.outer(a, b)) + weight * marginals

    best = minimize(objective, np.log(np.outer(a, b) / a.sum()).ravel(), method="BFGS", options={"gtol": 1e-6})
    with jax.enable_x64(True):
        plan = unbalanced(*map(jnp.asarray, (cost, epsilon, a, b)), marginal_weight=jnp.asarray(weight), num_iters=200)
        np.testing.assert_allclose(plan, np.exp(best.x).reshape(3, 4), rtol=1e-4)


@pytest.mark.parametrize(
    ("plan", "expected"),
    [
        ([[0.1, 0.2], [0.2, 0.1]], 0.0),
        ([[0.5, 0.1], [0.0, 0.0]], 0.2),
        ([[0.0, 0.3], [0.0, 0.4]], 0.75),
        ([[0.0, 0.0], [0.0, 0.0]], 0.0),
    ],
)
def test_marginal_excess(plan, expected):
    """Oracle: by hand, caps 0.5 for rows and 0.6, 0.4 for columns."""
    found = marginal_excess(jnp.array(plan), jnp.array([0.5, 0.5]), jnp.array([0.6, 0.4]))
    assert float(found) == pytest.approx(expected, abs=1e-6)


def test_marginal_excess_of_padding():
    """Oracle: the documented answers; an empty cap is kept by zero only."""
    a, b = jnp.array([1.0, 0.0]), jnp.array([1.0, 0.0])
    assert float(marginal_excess(jnp.zeros((2, 2)), a, b)) == 0
    assert float(marginal_excess(jnp.zeros((2, 2)).at[1, 0].set(0.1), a, b)) == np.inf
    assert float(marginal_excess(jnp.zeros((2, 2)), 0 * a, 0 * b)) == 0
