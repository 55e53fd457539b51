"""Partial transport, dense and over candidates, against POT, linear programming and closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import ot
import pytest
import scipy.special
from scipy.optimize import linprog

from delo_jax.ops.matching import matching_cost, softmax_plan
from delo_jax.ops.transport import partial_transport, sparse_partial_transport

NUM_ITERS = (0, 1, 2, 5, 50)
dense = jax.jit(partial_transport, static_argnames="num_iters")
sparse = jax.jit(sparse_partial_transport, static_argnames="num_iters")


def problem(seed, shape=None):
    """Random size, marginals of different totals, mass and epsilon; every row and column with its own bias of a few epsilon."""
    rng = np.random.default_rng(seed)
    n, m = shape or rng.integers(2, 20, size=2).tolist()
    a, b = rng.uniform(0.1, 1, size=n), rng.uniform(0.1, 1, size=m)
    b *= rng.uniform(0.5, 2) * a.sum() / b.sum()
    epsilon = 10 ** rng.uniform(-1.5, 0)
    bias = 3 * epsilon * rng.normal(size=(n, 1)), 3 * epsilon * rng.normal(size=(1, m))
    mass = rng.uniform(0.1, 0.999) * min(a.sum(), b.sum())
    return rng.uniform(size=(n, m)) + bias[0] + bias[1], epsilon, a, b, mass


def pot(cost, epsilon, a, b, mass, num_iters, method="sinkhorn_log"):
    """POT's Dykstra loop with full matrices, stopped after as many rounds; its linear loop divides by underflows."""
    solve = functools.partial(ot.partial.entropic_partial_wasserstein, a, b, cost, reg=epsilon, m=mass, method=method)
    return solve(numItermax=num_iters, stopThr=-1.0)  # never earlier


def solve(cost, epsilon, a, b, mass, num_iters):
    """Our plan in float64, padded with NaN to one size, so that it is compiled once for all sizes."""
    n, m = cost.shape
    with jax.enable_x64(True):
        cost = np.pad(cost, ((0, 30 - n), (0, 30 - m)), constant_values=np.nan)
        a, b = np.pad(a, (0, 30 - n)), np.pad(b, (0, 30 - m))
        return np.asarray(dense(*map(jnp.asarray, (cost, epsilon, a, b)), mass=jnp.asarray(mass), num_iters=num_iters))[:n, :m]


@pytest.mark.parametrize("seed", range(12))
def test_plan_follows_pot_iterate_by_iterate(seed):
    """Oracle: POT's entropic_partial_wasserstein with full matrices, its log method and, where that survives, its linear one."""
    cost, epsilon, a, b, mass = problem(seed)
    for num_iters in NUM_ITERS:
        plan = solve(cost, epsilon, a, b, mass=mass, num_iters=num_iters)
        np.testing.assert_allclose(plan, pot(cost, epsilon, a, b, mass, num_iters), rtol=1e-9)
        with np.errstate(all="ignore"):
            linear = pot(cost, epsilon, a, b, mass, num_iters, method="sinkhorn")
        if np.all(np.isfinite(linear)) and linear.min() > 0:
            np.testing.assert_allclose(plan, linear, rtol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_a_constant_in_all_costs_changes_nothing(seed):
    """Oracle: POT without the constant, whose kernel is too small for a float64 with it; the total takes it back, in padding too."""
    cost, epsilon, a, b, mass = problem(seed)
    for num_iters in NUM_ITERS:
        plan = solve(cost + 2000.0 * epsilon, epsilon, a, b, mass=mass, num_iters=num_iters)
        np.testing.assert_allclose(plan, pot(cost, epsilon, a, b, mass, num_iters), rtol=1e-9)


def test_the_problems_above_are_hard():
    """Oracle: POT's plans; caps bind, and rows and columns that were full give mass back later, again and again."""
    full, given_back = 0, 0
    for seed in range(12):
        cost, epsilon, a, b, mass = problem(seed)
        plans = [pot(cost, epsilon, a, b, mass, k) for k in range(30)]
        filled = np.array([np.r_[plan.sum(axis=1) / a, plan.sum(axis=0) / b] for plan in plans])
        full += int(np.sum(filled[-1] > 1 - 1e-6))
        given_back += int(np.sum((filled[:-1] > 1 + 1e-6) & (filled[1:] < 1 - 1e-6)))
    assert full > 50
    assert given_back > 10


@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 7), (7, 1), (30, 30)])
@pytest.mark.parametrize("share", [0.1, 1.0])
def test_uniform_marginals_follow_pot(n, m, share):
    """Oracle: POT's log method; the paper's setting, with share 1 the balanced problem, where every cap is reached."""
    cost = np.random.default_rng(0).uniform(size=(n, m))
    a, b = np.full(n, 1 / n), np.full(m, 1 / m)
    mass = share * min(a.sum(), b.sum())  # POT refuses a mass one rounding above that of the marginals
    for num_iters in NUM_ITERS:
        plan = solve(cost, 0.05, a, b, mass=mass, num_iters=num_iters)
        np.testing.assert_allclose(plan, pot(cost, 0.05, a, b, mass, num_iters), rtol=1e-9)


@pytest.mark.parametrize("epsilon", [1e-2, 1e-3])
def test_small_epsilon_follows_pot(epsilon):
    """Oracle: POT's log method where exp(-C / epsilon) underflows; potentials near 5e4 keep 1e-11 in float64."""
    rng = np.random.default_rng(0)
    cost = -scipy.special.log_softmax(rng.uniform(0, 50, size=(14, 11)), axis=1)
    a, b = rng.uniform(0.5, 1, size=14), rng.uniform(0.5, 1, size=11)
    for num_iters in NUM_ITERS:
        plan = solve(cost, epsilon, a, b, mass=3.0, num_iters=num_iters)
        np.testing.assert_allclose(plan, pot(cost, epsilon, a, b, 3.0, num_iters), rtol=1e-9, atol=1e-300)


def exact_cost(cost, a, b, mass):
    n, m = cost.shape
    sums = np.vstack([np.kron(np.eye(n), np.ones((1, m))), np.kron(np.ones((1, n)), np.eye(m))])
    return linprog(cost.ravel(), A_ub=sums, b_ub=np.r_[a, b], A_eq=np.ones((1, n * m)), b_eq=[mass]).fun


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("uniform", [False, True])
def test_cost_approaches_the_linear_program(seed, uniform):
    """Oracle: scipy linprog on the problem without entropy; the gap is at most epsilon mass log(n m)."""
    rng = np.random.default_rng(seed)
    n, m = 12, 15
    a, b = (np.full(n, 1 / n), np.full(m, 1 / m)) if uniform else (rng.uniform(0.01, 0.2, size=n), rng.uniform(0.01, 0.2, size=m))
    mass = 0.4 * min(a.sum(), b.sum())
    cost = rng.uniform(size=(n, m))
    exact = exact_cost(cost, a, b, mass)
    for epsilon, num_iters in ((1e-2, 1000), (1e-3, 5000)):
        plan = solve(cost, epsilon, a, b, mass=mass, num_iters=num_iters)
        assert plan.sum() == pytest.approx(mass, rel=1e-9)
        assert np.all(plan.sum(axis=1) <= a * (1 + 1e-6))
        assert np.all(plan.sum(axis=0) <= b * (1 + 1e-6))
        assert 0 <= np.sum(plan * cost) - exact <= epsilon * mass * np.log(n * m)


@pytest.mark.parametrize(("mass", "room"), [(0.1, 2.0), (1.0, 10.0)])
def test_with_no_cap_active_the_plan_is_the_soft_pointer(mass, room):
    """Oracle: scipy softmax; at epsilon = 1, with no cap active, the plan IS DCP's soft pointer, times the mass.

    No cap is active when no target collects more than it may: 1 / mass rows' worth, or what a wide marginal lets it.
    """
    scores = np.random.default_rng(0).normal(size=(20, 20))
    pointer = scipy.special.softmax(scores, axis=1)
    a, b = np.full(20, 1 / 20), np.full(20, room / 20)
    assert np.all(mass * pointer.sum(axis=0) / 20 <= b)
    with jax.enable_x64(True):
        cost = matching_cost(jnp.asarray(scores), jnp.ones(20, bool))
        for num_iters in (0, 1, 5):
            plan = partial_transport(cost, 1.0, jnp.asarray(a), jnp.asarray(b), mass=mass, num_iters=num_iters)
            np.testing.assert_allclose(plan, mass * pointer / 20, rtol=1e-12)
            np.testing.assert_allclose(plan, mass * softmax_plan(jnp.asarray(scores), jnp.asarray(a), jnp.asarray(b)), rtol=1e-12)


@pytest.mark.parametrize("epsilon", [1e-4, 1.0])
def test_float32_survives_small_epsilon_and_ties(epsilon):
    """Oracle: the constraint on the total; equal costs share equally.

    At C / epsilon = 1e4 the sum of potentials and scores is rounded to 1e-3, which is the relative error of the plan.
    """
    run = jax.jit(lambda cost, a, b: partial_transport(cost, epsilon, a, b, mass=0.3, num_iters=5))
    cost = jnp.asarray(np.random.default_rng(0).uniform(size=(12, 15)), jnp.float32)
    a, b, one = jnp.full(12, 1 / 12), jnp.full(15, 1 / 15), jnp.ones(1)
    assert np.sum(run(cost, a, b)) == pytest.approx(0.3, rel=2e-3)
    np.testing.assert_allclose(run(jnp.ones((12, 15)), a, b), np.full((12, 15), 0.3 / 180), rtol=2e-3)
    assert float(run(jnp.ones((1, 1)), one, one)[0, 0]) == pytest.approx(0.3, rel=2e-3)


def candidates(seed, k):
    """A problem in which row i may be matched to `index[i]` only, and a mass that the candidates can carry."""
    cost, epsilon, a, b, _ = problem(seed, (13, 17))
    rng = np.random.default_rng(seed)
    n, m = cost.shape
    index = np.argsort(rng.uniform(size=(n, m)), axis=1)[:, : min(k, m)]
    allowed = np.zeros((n, m), bool)
    np.put_along_axis(allowed, index, True, axis=1)
    sums = np.vstack([np.kron(np.eye(n), np.ones((1, m))), np.kron(np.ones((1, n)), np.eye(m))])
    flow = -linprog(-allowed.ravel().astype(float), A_ub=sums, b_ub=np.r_[a, b]).fun
    return cost, index, epsilon, a, b, 0.8 * flow, allowed


def scatter(plan, index, shape):
    full = np.zeros(shape)
    np.put_along_axis(full, index, np.asarray(plan), axis=1)
    return full


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("k", [1, 3, 100])
def test_candidates_follow_the_dense_problem_with_the_other_pairs_forbidden(seed, k):
    """Oracle: POT's log method, iterate by iterate, the other pairs at a cost of 1e4 epsilon; k = 100 allows all."""
    cost, index, epsilon, a, b, mass, allowed = candidates(seed, k)
    dear = np.where(allowed, cost, 1e4 * epsilon)
    for num_iters in NUM_ITERS:
        with jax.enable_x64(True):
            arguments = map(jnp.asarray, (np.take_along_axis(cost, index, axis=1), index, epsilon, a, b))
            plan = scatter(sparse(*arguments, mass=jnp.asarray(mass), num_iters=num_iters), index, cost.shape)
        np.testing.assert_allclose(plan, pot(dear, epsilon, a, b, mass, num_iters), rtol=1e-9, atol=1e-300)
        np.testing.assert_allclose(plan, solve(dear, epsilon, a, b, mass=mass, num_iters=num_iters), rtol=1e-9, atol=1e-300)


def test_candidates_in_float32_at_a_small_epsilon():
    """Oracle: POT's log method in float64, to the rounding of potentials of 1e3; no value or gradient leaves float32."""
    rng = np.random.default_rng(0)
    cost = -scipy.special.log_softmax(rng.uniform(0, 15, size=(40, 40)), axis=1).astype(np.float32)
    index = np.argsort(cost, axis=1)[:, :6]
    share = np.full(40, 1 / 40, np.float32)
    allowed = np.zeros((40, 40), bool)
    np.put_along_axis(allowed, index, True, axis=1)

    def run(cost, epsilon):
        return sparse(cost, jnp.asarray(index), epsilon, jnp.asarray(share), jnp.asarray(share), mass=0.3, num_iters=5)

    near = jnp.asarray(np.take_along_axis(cost, index, axis=1))
    expected = pot(np.where(allowed, cost.astype(float), 1e4), 0.01, share.astype(float), share.astype(float), 0.3, 5)
    np.testing.assert_allclose(scatter(run(near, jnp.float32(0.01)), index, (40, 40)), expected, atol=1e-3 / 40)
    gradients = jax.grad(lambda *x: jnp.sum(near * run(*x)), argnums=(0, 1))(near, jnp.float32(0.01))
    assert all(np.all(np.isfinite(gradient)) for gradient in gradients)
