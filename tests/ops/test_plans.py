"""What every plan has to satisfy, whatever problem it solves: slopes, transformations, padding, permutations, float32."""

import functools

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delo_jax.ops import matching, transport
from tests.oracles.agreement import assert_gradient_is_the_slope, assert_transforms_agree

N, M = 7, 9
SHARE = 0.6


def cost_of(scores, b):
    return matching.matching_cost(scores, b > 0)


def mass_of(a, b):
    return SHARE * jnp.minimum(jnp.sum(a), jnp.sum(b))


def partial(scores, epsilon, a, b):
    return transport.partial_transport(cost_of(scores, b), epsilon, a, b, mass=mass_of(a, b), num_iters=5)


def printed(scores, epsilon, a, b):
    return transport.algorithm_1(cost_of(scores, b), epsilon, a, b, mass=mass_of(a, b), num_iters=5)


def released(scores, epsilon, a, b):
    return transport.algorithm_1(cost_of(scores, b), epsilon, a, b, mass=mass_of(a, b), num_iters=5, scale_first=True)


def sparse(scores, epsilon, a, b):
    """Over the six best candidates of every row, back in a full matrix."""
    cost = cost_of(scores, b)
    index = jnp.argsort(jax.lax.stop_gradient(jnp.where((b > 0)[None, :], cost, jnp.inf)), axis=1)[:, :6]
    near = jnp.take_along_axis(cost, index, axis=1)
    plan = transport.sparse_partial_transport(near, index, epsilon, a, b, mass=0.5 * mass_of(a, b), num_iters=5)
    return jnp.zeros_like(cost).at[jnp.arange(cost.shape[0])[:, None], index].set(plan)


def dustbin(scores, epsilon, a, b):
    """The scalar is the score of the bin."""
    return transport.dustbin_transport(scores, epsilon, a, b, num_iters=5)


def unbalanced(scores, epsilon, a, b):
    return transport.unbalanced_transport(cost_of(scores, b), epsilon, a, b, marginal_weight=0.7, num_iters=5)


def soft(scores, epsilon, a, b):
    return matching.softmax_plan(scores / epsilon, a, b)


def dual(scores, epsilon, a, b):
    return matching.dual_softmax_plan(scores / epsilon, a, b)


PLANS = [partial, printed, released, sparse, dustbin, unbalanced, soft, dual]
every_plan = pytest.mark.parametrize("plan", PLANS, ids=lambda plan: plan.__name__)
compiled = functools.cache(jax.jit)


def problem(seed, n=N, m=M):
    """Scores, epsilon, and marginals of different totals."""
    rng = np.random.default_rng(seed)
    return 2 * rng.normal(size=(n, m)), 0.5, rng.uniform(0.3, 1, size=n), rng.uniform(0.3, 1, size=m)


def as_float32(arguments):
    return tuple(jnp.asarray(argument, jnp.float32) for argument in arguments)


@every_plan
def test_gradients_are_the_slopes(plan):
    """Oracle: central differences in x64, through scores, the scalar and both marginals, with padding."""
    scores, epsilon, a, b = problem(0)
    with jax.enable_x64(True):
        probe = jnp.asarray(np.random.default_rng(1).normal(size=(N, M)))
        rows, columns = (jnp.arange(N) != 5).astype(float), (jnp.arange(M) > 1).astype(float)

        def loss(scores, epsilon, a, b):
            return jnp.sum(probe * plan(scores, epsilon, rows * a, columns * b))

        assert_gradient_is_the_slope(loss, [scores, epsilon, a, b])


@every_plan
def test_plans_under_jit_and_vmap(plan):
    """Oracle: the same function, one problem at a time, not compiled; float32 rounds potentials of up to ten."""
    batches = [np.stack(x) for x in zip(*map(problem, range(3)), strict=True)]
    batches[2][0, 2:4], batches[3][1, :3] = 0, 0
    assert_transforms_agree(plan, *as_float32(batches), rtol=1e-4, atol=1e-6)


@every_plan
@hypothesis.given(seed=st.integers(0, 2**32 - 1))
@hypothesis.settings(max_examples=25)
def test_padding_is_inert(plan, seed):
    """Oracle: symmetry; the valid block of a padded problem is the plan without padding, the rest exactly zero."""
    rng = np.random.default_rng(seed)
    scores, epsilon, a, b = problem(seed)
    rows, columns = np.sort(rng.permutation(N + 4)[:N]), np.sort(rng.permutation(M + 3)[:M])
    garbage, wide_a, wide_b = 1e3 * rng.normal(size=(N + 4, M + 3)), np.zeros(N + 4), np.zeros(M + 3)
    garbage[np.ix_(rows, columns)], wide_a[rows], wide_b[columns] = scores, a, b
    with jax.enable_x64(True):
        padded = np.array(compiled(plan)(*map(jnp.asarray, (garbage, epsilon, wide_a, wide_b))))
        expected = compiled(plan)(*map(jnp.asarray, (scores, epsilon, a, b)))
        np.testing.assert_allclose(padded[np.ix_(rows, columns)], expected, rtol=1e-6, atol=1e-15)
    padded[np.ix_(rows, columns)] = 0
    np.testing.assert_array_equal(padded, np.zeros_like(padded))


@every_plan
@hypothesis.given(seed=st.integers(0, 2**32 - 1))
@hypothesis.settings(max_examples=25)
def test_plans_permute_with_their_points(plan, seed):
    """Oracle: symmetry in the order of source and of target points."""
    rng = np.random.default_rng(seed)
    scores, epsilon, a, b = problem(seed)
    rows, columns = rng.permutation(N), rng.permutation(M)
    with jax.enable_x64(True):
        moved = compiled(plan)(*map(jnp.asarray, (scores[np.ix_(rows, columns)], epsilon, a[rows], b[columns])))
        expected = np.asarray(compiled(plan)(*map(jnp.asarray, (scores, epsilon, a, b))))[np.ix_(rows, columns)]
        np.testing.assert_allclose(moved, expected, rtol=1e-6, atol=1e-15)


@every_plan
@pytest.mark.parametrize("empty", ["rows", "columns", "both"])
def test_nothing_valid_moves_nothing(plan, empty):
    """Oracle: the documented answer, zeros, with finite gradients; the mass asked for is then zero too."""
    scores, epsilon, a, b = as_float32(problem(0, 32, 24))
    a, b = a * float(empty == "columns"), b * float(empty == "rows")
    np.testing.assert_array_equal(compiled(plan)(scores, epsilon, a, b), np.zeros((32, 24)))
    gradients = slopes(plan)(scores, epsilon, a, b)
    assert all(np.all(np.isfinite(gradient)) for gradient in gradients)


@functools.cache
def slopes(plan):
    """Gradients of a sum that weighs every entry differently."""

    def loss(scores, *others):
        return jnp.sum(jnp.arange(1.0, scores.size + 1).reshape(scores.shape) * plan(scores, *others))

    return jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3)))


@every_plan
@pytest.mark.parametrize("seed", range(3))
def test_float32_at_epsilon_of_a_hundredth(plan, seed):
    """Oracle: finiteness, of values and gradients, for scores over 0..50: weights span exp(-5000)."""
    rng = np.random.default_rng(seed)
    scores, a, b = rng.uniform(0, 50, size=(32, 24)), rng.uniform(0.2, 1, size=32) / 32, rng.uniform(0.2, 1, size=24) / 24
    a[-3:], b[:2] = 0, 0
    arguments = as_float32((scores, 0.01, a, b))
    found = np.asarray(compiled(plan)(*arguments))
    assert np.all(np.isfinite(found))
    assert np.all(found >= 0)
    assert found.sum() > 0
    assert all(np.all(np.isfinite(gradient)) for gradient in slopes(plan)(*arguments))


@pytest.mark.parametrize("plan", [partial, released, printed], ids=lambda plan: plan.__name__)
def test_projection_of_a_sharp_plan_has_finite_gradients(plan):
    """Oracle: finiteness, in float32, of the chain scores -> plan -> matches at epsilon = 0.01, where most rows carry nothing."""
    rng = np.random.default_rng(0)
    scores, target = rng.uniform(0, 50, size=(32, 24)), rng.uniform(-70, 70, size=(24, 3))
    scores, epsilon, a, b, target = as_float32((scores, 0.01, np.full(32, 1 / 32), np.full(24, 1 / 24), target))

    def loss(scores, epsilon):
        matched, weights = matching.barycentric_projection(plan(scores, epsilon, a, b), target)
        return jnp.sum(jnp.abs(matched)) + jnp.sum(weights)

    assert all(np.all(np.isfinite(gradient)) for gradient in jax.jit(jax.grad(loss, argnums=(0, 1)))(scores, epsilon))


@jax.jit
def raw_plans(scores, epsilon, a, b):
    """Every plan of the same numbers, as cost or as scores, and of a mass that is there whether points are or not."""
    common = scores, epsilon, a, b
    index = jnp.broadcast_to(jnp.arange(b.size)[::-1], scores.shape)
    return jnp.stack(
        [
            transport.partial_transport(*common, mass=0.5, num_iters=3),
            transport.algorithm_1(*common, mass=0.5, num_iters=3),
            transport.sparse_partial_transport(scores[:, ::-1], index, *common[1:], mass=0.5, num_iters=3),
            transport.dustbin_transport(*common, num_iters=3),
            transport.unbalanced_transport(*common, marginal_weight=1.0, num_iters=3),
            matching.softmax_plan(scores, a, b),
            matching.dual_softmax_plan(scores, a, b),
        ]
    )


def test_a_mass_that_is_not_there_moves_nothing():
    """Oracle: the documented answer for no valid points, also when a constant mass is asked for, with finite gradients."""
    scores, epsilon, a, b = as_float32(problem(0))
    np.testing.assert_array_equal(raw_plans(scores, epsilon, 0 * a, 0 * b), np.zeros((7, N, M)))
    gradients = jax.grad(lambda *x: jnp.sum(raw_plans(*x)), argnums=(0, 1, 2, 3))(scores, epsilon, 0 * a, 0 * b)
    assert all(np.all(np.isfinite(gradient)) for gradient in gradients)


def test_nan_in_padding_touches_nothing():
    """Oracle: symmetry; costs and scores of padded pairs may be anything, in the plan and in its gradients."""
    scores, epsilon, a, b = as_float32(problem(0))
    a, b = a.at[2].set(0), b.at[4:].set(0)
    dirty = scores.at[2].set(jnp.nan).at[:, 4:].set(jnp.nan)

    np.testing.assert_array_equal(raw_plans(dirty, epsilon, a, b), raw_plans(scores, epsilon, a, b))
    loss = jax.jit(jax.grad(lambda *x: jnp.sum(raw_plans(*x) ** 2), argnums=(0, 1)))
    for found, expected in zip(loss(dirty, epsilon, a, b), loss(scores, epsilon, a, b), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_excess_under_jit_and_vmap_and_its_slope():
    """Oracle: the same function, one plan at a time, not compiled; central differences in x64."""
    batches = as_float32([np.stack(x) for x in zip(*map(problem, range(3)), strict=True)])
    assert_transforms_agree(lambda s, _, a, b: transport.marginal_excess(jnp.exp(s), a, b), *batches)
    scores, _, a, b = problem(0)
    with jax.enable_x64(True):
        assert_gradient_is_the_slope(transport.marginal_excess, [np.exp(scores), a, b])


def test_residual_falls_with_more_rounds():
    """Oracle: convergence; five rounds leave an excess of some per cent, two hundred leave next to none, rows by NumPy."""
    scores, _, a, b = as_float32(problem(0))
    cost, mass = cost_of(scores, b), 0.9 * mass_of(a, b) / SHARE
    plans = [transport.partial_transport(cost, 0.5, a, b, mass=mass, num_iters=k) for k in (1, 5, 200)]
    excess = [float(transport.marginal_excess(plan, a, b)) for plan in plans]
    assert excess[0] > excess[1] > 1e-4
    assert excess[2] < 1e-5
    by_numpy = [max((np.sum(p, axis=1) / a).max(), (np.sum(p, axis=0) / b).max()) - 1 for p in map(np.asarray, plans)]
    np.testing.assert_allclose(excess, np.maximum(by_numpy, 0), atol=1e-6)
