"""Marginals, costs, softmax plans, and the projection of a plan to points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from delo_jax.ops.matching import barycentric_projection, dual_softmax_plan, matching_cost, softmax_plan, uniform_marginal
from tests.oracles.agreement import assert_gradient_is_the_slope, assert_transforms_agree


def problem(seed, n=9, m=11, spread=3.0):
    """Scores, marginals with a few zeros and unequal masses, and which pairs are valid."""
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(0.5, 1.5, size=n), rng.uniform(0.5, 1.5, size=m)
    a[rng.permutation(n)[:2]] = 0
    b[rng.permutation(m)[:3]] = 0
    return spread * rng.normal(size=(n, m)), a, b, np.ix_(a > 0, b > 0)


@pytest.mark.parametrize("mask", [[True], [True, False, True, True], [False, False], [True] * 7])
def test_uniform_marginal(mask):
    """Oracle: NumPy; nothing valid gives zeros."""
    mask = np.array(mask)
    found = uniform_marginal(jnp.asarray(mask))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, mask / max(mask.sum(), 1), rtol=1e-7)


def test_uniform_marginal_under_jit_and_vmap():
    """Oracle: the same function, one mask at a time, not compiled."""
    assert_transforms_agree(uniform_marginal, jnp.asarray(np.random.default_rng(0).uniform(size=(4, 12)) < 0.6))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("spread", [1.0, 20.0])
def test_cost_is_minus_a_log_softmax(seed, spread):
    """Oracle: scipy.special.log_softmax over the valid columns; float32 keeps seven digits of the largest score."""
    scores, _, b, _ = problem(seed, spread=spread)
    cost = np.asarray(matching_cost(jnp.asarray(np.where(b > 0, scores, np.nan), jnp.float32), jnp.asarray(b > 0)))
    expected = -scipy.special.log_softmax(scores[:, b > 0].astype(np.float32).astype(float), axis=1)
    np.testing.assert_allclose(cost[:, b > 0], expected, rtol=1e-6, atol=1e-6 * spread)
    np.testing.assert_array_equal(cost[:, b == 0], 0)


def test_cost_is_not_symmetric():
    """Oracle: two formulas by hand; a row spreads over the targets, so exchanging the clouds is not a transpose."""
    scores = jnp.array([[0.0, 0.0], [0.0, 10.0]])
    both = jnp.ones(2, bool)
    assert float(matching_cost(scores, both)[0, 1]) == pytest.approx(np.log(2))
    assert float(matching_cost(scores.T, both).T[0, 1]) == pytest.approx(10 + np.log1p(np.exp(-10)))


def test_cost_without_targets_is_zero():
    """Oracle: the documented answer."""
    np.testing.assert_array_equal(matching_cost(jnp.ones((3, 2)), jnp.zeros(2, bool)), np.zeros((3, 2)))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("dual", [False, True])
def test_softmax_plans(seed, dual):
    """Oracle: scipy.special.softmax of the valid block, times the mass of the row."""
    scores, a, b, block = problem(seed)
    expected = np.zeros_like(scores)
    expected[block] = a[a > 0][:, None] * scipy.special.softmax(scores[block], axis=1)
    if dual:
        expected[block] *= scipy.special.softmax(scores[block], axis=0)
    plan = (dual_softmax_plan if dual else softmax_plan)(*(jnp.asarray(x, jnp.float32) for x in (scores, a, b)))
    np.testing.assert_allclose(plan, expected, rtol=5e-6)
    if not dual:
        np.testing.assert_allclose(np.sum(plan, axis=1), a, rtol=1e-6)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e-20])
def test_projection_is_a_weighted_mean(seed, scale):
    """Oracle: np.average in float64, row by row; the scale of the plan does not matter (the released code's 1e-6 would)."""
    rng = np.random.default_rng(seed)
    plan = (scale * rng.uniform(size=(6, 9)) ** 4).astype(np.float32)
    target = rng.uniform(-70, 70, size=(9, 3)).astype(np.float32)
    matched, weights = barycentric_projection(jnp.asarray(plan), jnp.asarray(target))
    expected = [np.average(target.astype(float), axis=0, weights=row) for row in plan.astype(float)]
    np.testing.assert_allclose(matched, expected, atol=3e-5)  # four roundings at 70 m
    np.testing.assert_allclose(weights, plan.astype(float).sum(axis=1), rtol=1e-6)


@pytest.mark.parametrize("lightest", [0.0, 1e-38, 1e-32])
def test_projection_of_an_unmatched_row(lightest):
    """Oracle: the documented answer, zero match and zero weight, with finite gradients in float32."""
    plan = jnp.full((3, 4), 0.1).at[1].set(lightest)
    target = jnp.full((4, 3), 70.0)
    matched, weights = barycentric_projection(plan, target)
    np.testing.assert_array_equal(matched[1], np.zeros(3))
    assert float(weights[1]) == 0
    np.testing.assert_allclose(matched[::2], np.full((2, 3), 70.0), rtol=1e-6)

    def loss(plan, target):
        return sum(jnp.sum(x**2) for x in barycentric_projection(plan, target))

    assert all(np.all(np.isfinite(g)) for g in jax.grad(loss, argnums=(0, 1))(plan, target))


@pytest.mark.parametrize("lightest", [1e-29, 1e-20])
def test_projection_of_a_very_light_row_has_a_finite_gradient(lightest):
    """Oracle: the derivative by hand, (x_j - mean) / mass; dividing by mass^2 on the way would leave float32."""
    plan = jnp.full((1, 2), lightest / 2)
    target = jnp.array([[10.0, 0.0, 0.0], [30.0, 0.0, 0.0]])
    gradient = jax.grad(lambda plan: barycentric_projection(plan, target)[0][0, 0])(plan)
    np.testing.assert_allclose(gradient, np.array([[-10.0, 10.0]]) / lightest, rtol=1e-5)


def test_projection_permutes_with_its_points():
    """Oracle: symmetry; matches follow the rows, and the order of the targets does not matter."""
    rng = np.random.default_rng(0)
    plan, target = jnp.asarray(rng.uniform(size=(6, 9)), jnp.float32), jnp.asarray(rng.normal(size=(9, 3)), jnp.float32)
    rows, columns = rng.permutation(6), rng.permutation(9)
    matched, weights = barycentric_projection(plan, target)
    moved, moved_weights = barycentric_projection(plan[rows][:, columns], target[columns])
    np.testing.assert_allclose(moved, matched[rows], atol=1e-6)
    np.testing.assert_allclose(moved_weights, weights[rows], rtol=1e-6)


def test_projection_ignores_padding():
    """Oracle: symmetry; targets of no mass may stand anywhere, rows of no mass change nothing."""
    rng = np.random.default_rng(0)
    plan, target = jnp.asarray(rng.uniform(size=(6, 9)), jnp.float32), jnp.asarray(rng.normal(size=(9, 3)), jnp.float32)
    padded = jnp.zeros((8, 12)).at[:6, :9].set(plan)
    garbage = jnp.full((12, 3), 1e9).at[:9].set(target)
    for found, expected in zip(barycentric_projection(padded, garbage), barycentric_projection(plan, target), strict=True):
        np.testing.assert_allclose(found[:6], expected, rtol=1e-6, atol=1e-7)
        np.testing.assert_array_equal(found[6:], np.zeros_like(found[6:]))


def test_gradients_are_the_slopes():
    """Oracle: central differences in x64, of the cost and of the projection."""
    rng = np.random.default_rng(0)
    scores, _, b, _ = problem(0)
    with jax.enable_x64(True):
        probe, other_probe = jnp.asarray(rng.normal(size=scores.shape)), jnp.asarray(rng.normal(size=(6, 3)))
        valid = jnp.asarray(b > 0)
        assert_gradient_is_the_slope(lambda scores: jnp.sum(probe * matching_cost(scores, valid)), [scores])

        def loss(plan, target):
            matched, weights = barycentric_projection(plan, target)
            return jnp.sum(other_probe * matched) + jnp.sum(weights**2)

        assert_gradient_is_the_slope(loss, [rng.uniform(0.1, 1, size=(6, 9)), rng.normal(size=(9, 3))])


def test_matching_under_jit_and_vmap():
    """Oracle: the same functions, one problem at a time, not compiled."""
    rng = np.random.default_rng(0)
    scores = jnp.asarray(rng.normal(size=(3, 6, 9)), jnp.float32)
    valid = jnp.asarray(rng.uniform(size=(3, 9)) < 0.7)
    target = jnp.asarray(rng.normal(size=(3, 9, 3)), jnp.float32)
    assert_transforms_agree(matching_cost, scores, valid)
    assert_transforms_agree(lambda scores, target: barycentric_projection(jnp.exp(scores), target), scores, target)
