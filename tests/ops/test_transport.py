"""Matching costs and partial transport."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import ot
import pytest
import scipy.special
from scipy.optimize import linprog

from delo_jax.ops.transport import matching_cost, partial_transport
from tests.oracles.agreement import assert_gradient_is_the_slope, assert_transforms_agree


def random_cost(seed, n=12, m=15):
    return np.random.default_rng(seed).uniform(size=(n, m))


@pytest.mark.parametrize(("mass", "num_iters"), [(0.1, 5), (0.6, 0), (0.6, 1), (0.6, 2), (0.6, 5), (0.6, 40), (1.0, 5)])
def test_plan_follows_pot_iterate_by_iterate(mass, num_iters):
    """Oracle: POT's entropic_partial_wasserstein, linear domain with full matrices, stopped after as many rounds."""
    cost = random_cost(0)
    a, b = np.full(12, 1 / 12), np.full(15, 1 / 15)
    mass = min(mass, a.sum(), b.sum())  # POT refuses a mass one rounding above that of the marginals
    if num_iters:
        expected = ot.partial.entropic_partial_wasserstein(a, b, cost, reg=0.07, m=mass, numItermax=num_iters, stopThr=0.0)
    else:
        expected = mass * scipy.special.softmax(-cost / 0.07)
    with jax.enable_x64(True):
        plan = jax.jit(lambda cost: partial_transport(cost, 0.07, mass=mass, num_iters=num_iters))(jnp.asarray(cost))
        np.testing.assert_allclose(plan, expected, atol=1e-13)


@pytest.mark.parametrize("seed", range(2))
def test_cost_approaches_the_linear_program(seed):
    """Oracle: scipy linprog on the unregularised problem, the limit epsilon -> 0."""
    n, m, mass = 12, 15, 0.3
    cost = random_cost(seed, n, m)
    row_sums, col_sums = np.kron(np.eye(n), np.ones((1, m))), np.kron(np.ones((1, n)), np.eye(m))
    exact = linprog(
        cost.ravel(),
        A_ub=np.vstack([row_sums, col_sums]),
        b_ub=np.r_[np.full(n, 1 / n), np.full(m, 1 / m)],
        A_eq=np.ones((1, n * m)),
        b_eq=[mass],
    ).fun
    with jax.enable_x64(True):
        plan = partial_transport(jnp.asarray(cost), 1e-3, mass=mass, num_iters=2000)
        assert float(jnp.sum(plan)) == pytest.approx(mass, rel=1e-9)
        assert float(jnp.max(jnp.sum(plan, axis=1))) <= 1 / n + 1e-3
        assert float(jnp.sum(plan * cost)) == pytest.approx(exact, rel=1e-2)  # entropy gap at 1e-3


def test_padding_is_invisible():
    """Oracle: symmetry; the valid block of a padded problem is the plan of the problem without padding."""
    cost = jnp.asarray(random_cost(0), jnp.float32)
    padded = jnp.full((16, 20), -7.0, jnp.float32).at[2:14, 5:].set(cost)
    rows = jnp.zeros(16, bool).at[2:14].set(True)
    columns = jnp.zeros(20, bool).at[5:].set(True)
    solve = jax.jit(functools.partial(partial_transport, epsilon=0.1, mass=0.6, num_iters=5))
    plan = np.array(solve(padded, row_mask=rows, column_mask=columns))
    np.testing.assert_allclose(plan[2:14, 5:], solve(cost), rtol=1e-4, atol=1e-8)
    assert plan.sum() == pytest.approx(0.6, rel=1e-5)
    plan[2:14, 5:] = 0
    np.testing.assert_array_equal(plan, np.zeros((16, 20)))


@pytest.mark.parametrize("epsilon", [1e-4, 1.0])
def test_float32_survives_small_epsilon_and_ties(epsilon):
    """Oracle: the constraint on the total; at 1e-4 exp(-C / epsilon) underflows. Equal costs share equally.

    At C / epsilon = 1e4 the sum of potentials and scores is rounded to 1e-3, which is the relative error of the plan.
    """
    solve = jax.jit(lambda cost: partial_transport(cost, epsilon, mass=0.3, num_iters=5))
    assert np.sum(solve(jnp.asarray(random_cost(0), jnp.float32))) == pytest.approx(0.3, rel=2e-3)
    np.testing.assert_allclose(solve(jnp.ones((12, 15), jnp.float32)), np.full((12, 15), 0.3 / 180), rtol=2e-3)
    assert float(solve(jnp.ones((1, 1), jnp.float32))[0, 0]) == pytest.approx(0.3, rel=2e-3)


def test_nothing_valid_moves_nothing():
    """Oracle: the documented answer, with finite gradients."""
    nobody = jnp.zeros(3, bool)

    def moved(cost, epsilon):
        return jnp.sum(partial_transport(cost, epsilon, mass=0.5, num_iters=3, row_mask=nobody, column_mask=nobody))

    value, gradients = jax.jit(jax.value_and_grad(moved, argnums=(0, 1)))(jnp.ones((3, 3), jnp.float32), jnp.float32(0.1))
    assert float(value) == 0
    np.testing.assert_array_equal(gradients[0], np.zeros((3, 3)))
    assert float(gradients[1]) == 0
    np.testing.assert_array_equal(matching_cost(jnp.ones((3, 2)), jnp.ones((3, 2)), 1.0, nobody), np.zeros((3, 3)))


def test_gradients_are_the_slopes():
    """Oracle: central differences in x64, through cost, scale and epsilon, with padding."""
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        probe = jnp.asarray(rng.normal(size=(6, 7)))
        columns = jnp.arange(7) < 5

        def loss(source, target, scale, epsilon):
            cost = matching_cost(source, target, scale, columns)
            plan = partial_transport(cost, epsilon, mass=0.7, num_iters=5, column_mask=columns)
            return jnp.sum(probe * 10 * plan)

        assert_gradient_is_the_slope(loss, [rng.normal(size=(6, 4)), rng.normal(size=(7, 4)), 1.3, 0.4])


def test_cost_is_a_log_softmax():
    """Oracle: scipy.special log_softmax of the scores, padded columns left out."""
    rng = np.random.default_rng(0)
    source, target = jnp.asarray(rng.normal(size=(2, 9, 4)), jnp.float32)
    columns = jnp.arange(9) != 3
    scores = np.asarray(source, float) @ np.asarray(target, float).T / 2.0  # sqrt(d) = 2
    np.testing.assert_allclose(matching_cost(source, target), -scipy.special.log_softmax(scores, axis=1), atol=1e-5)
    cost = matching_cost(source, target, 3.0, columns)
    np.testing.assert_allclose(cost[:, columns], -scipy.special.log_softmax(6 * scores[:, columns], axis=1), atol=1e-5)
    np.testing.assert_array_equal(cost[:, 3], np.zeros(9))


def test_transport_under_jit_and_vmap():
    """Oracle: the same functions, one problem at a time, not compiled."""
    rng = np.random.default_rng(0)
    features = jnp.asarray(rng.normal(size=(2, 3, 8, 4)), jnp.float32)
    rows = jnp.asarray(rng.uniform(size=(3, 8)) < 0.8)

    def match(source, target, row_mask):
        cost = matching_cost(source, target, None, row_mask)
        return partial_transport(cost, 0.2, mass=0.5, num_iters=3, row_mask=row_mask)

    assert_transforms_agree(match, *features, rows)
