"""From descriptors to a plan: each formulation calls its formula with the documented weights."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import expit, log_softmax

from delo_jax.config import PLANS, MatchingConfig
from delo_jax.model.matching import MASS_RANGE, MIN_EPSILON, Matcher
from delo_jax.ops.matching import dual_softmax_plan, softmax_plan
from delo_jax.ops.transport import algorithm_1, dustbin_transport, partial_transport, unbalanced_transport

N, M, D = 12, 15, 8
CFG = MatchingConfig(mass=0.3, epsilon=0.4, num_iters=4, num_candidates=M, marginal_weight=0.7)


def descriptors(seed=0):
    """Two sets of unit descriptors, some of which are alike, and their masks."""
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(N, D)), rng.normal(size=(M, D))
    target[:6] = source[:6] + 0.3 * rng.normal(size=(6, D))
    source, target = (rows / np.linalg.norm(rows, axis=1, keepdims=True) for rows in (source, target))
    return *(jnp.asarray(rows, jnp.float32) for rows in (source, target)), jnp.arange(N) < 10, jnp.arange(M) < 13


@functools.cache
def initial(cfg):
    """Variables as they are drawn."""
    return jax.jit(Matcher(cfg).init)(jax.random.key(0), *descriptors())


def variables_of(cfg, **params):
    """Initial weights, some replaced."""
    variables = initial(cfg)
    return {"params": {**variables.get("params", {}), **{name: jnp.asarray(value) for name, value in params.items()}}}


@functools.partial(jax.jit, static_argnames=("cfg", "method"))
def apply(cfg, *arguments, method=None):
    """The matcher's answer."""
    answer: Any = Matcher(cfg).apply(*arguments, method=method)
    return answer


def marginals(source_mask, target_mask):
    return (jnp.asarray(np.asarray(mask) / np.sum(mask), jnp.float32) for mask in (source_mask, target_mask))


def cost_of(scores, target_mask):
    """-log softmax over the valid targets, by scipy in float64."""
    cost = np.zeros(scores.shape)
    cost[:, target_mask] = -log_softmax(np.asarray(scores, np.float64)[:, target_mask], axis=1)
    return jnp.asarray(cost, jnp.float32)


@pytest.mark.parametrize("plan", PLANS)
def test_plan_is_that_of_the_formula(plan):
    """Oracle: the formula of that name (each has its own), called by hand on scores over sqrt(D), epsilon 0.4, mass 0.3."""
    cfg = dataclasses.replace(CFG, plan=plan, scores="scaled")
    source, target, *masks = descriptors()
    variables = variables_of(cfg)
    scores = np.asarray(source, np.float64) @ np.asarray(target, np.float64).T / np.sqrt(D)
    a, b = marginals(*masks)
    scaled, cost = jnp.asarray(scores / 0.4, jnp.float32), cost_of(scores, np.asarray(masks[1]))
    transport = {"epsilon": 0.4, "a": a, "b": b, "mass": 0.3, "num_iters": 4}
    expected = {
        "softmax": lambda: softmax_plan(scaled, a, b),
        "dual_softmax": lambda: dual_softmax_plan(scaled, a, b),
        "softmax_confidence": lambda: softmax_plan(scaled, a * confidence(variables, source), b),
        "algorithm_1": lambda: algorithm_1(cost, **transport),
        "released_code": lambda: algorithm_1(cost, **transport, scale_first=True),
        "partial_transport": lambda: partial_transport(cost, **transport),
        "sparse_transport": lambda: partial_transport(cost, **transport),  # with as many candidates as targets
        "dustbin_transport": lambda: dustbin_transport(scaled, 1.0, a, b, num_iters=4),
        "unbalanced_transport": lambda: unbalanced_transport(cost, 0.4, a, b, marginal_weight=0.7, num_iters=4),
    }[plan]()
    found = apply(cfg, variables, source, target, *masks)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-8)
    assert np.all(np.asarray(found)[10:] == 0)
    assert np.all(np.asarray(found)[:, 13:] == 0)


def confidence(variables, source):
    layer = variables["params"]["confidence"]
    return jnp.asarray(expit(np.asarray(source) @ np.asarray(layer["kernel"]) + np.asarray(layer["bias"]))[:, 0], jnp.float32)


def test_scores_are_cosines_or_products():
    """Oracle: NumPy in float64; a factor that starts at 10, or 1 over the root of D."""
    source, target, *_ = descriptors()
    products = np.asarray(source, np.float64) @ np.asarray(target, np.float64).T
    for scores, factor in (("cosine", 10.0), ("scaled", D**-0.5)):
        cfg = dataclasses.replace(CFG, scores=scores)
        found = apply(cfg, variables_of(cfg), source, target, method="scores")
        np.testing.assert_allclose(found, factor * products, rtol=1e-5, atol=1e-6)
    cfg = dataclasses.replace(CFG, scores="cosine")
    found = apply(cfg, variables_of(cfg, log_temperature=np.float32(np.log(3.0))), source, target, method="scores")
    np.testing.assert_allclose(found, 3.0 * products, rtol=1e-5, atol=1e-6)


LEARNED = dataclasses.replace(CFG, learn_epsilon=True)


@pytest.mark.parametrize("epsilon", [0.011, 0.1, 1.0, 5.0, 200.0])
def test_learned_epsilon_starts_where_it_is_told(epsilon):
    """Oracle: the config."""
    cfg = dataclasses.replace(LEARNED, epsilon=epsilon)
    found = apply(cfg, variables_of(cfg), method="epsilon")
    np.testing.assert_allclose(found, epsilon, rtol=1e-5)


@jax.jit
@jax.value_and_grad
def sharpness_and_slope(variables, *arguments):
    """Sum of squares of the plan of a learned epsilon, by the weights."""
    return jnp.sum(apply(LEARNED, variables, *arguments) ** 2)


@pytest.mark.parametrize("raw", [-1e30, -100.0, -1.0, 0.0, 3.0, 1e4])
def test_learned_epsilon_is_above_its_floor(raw):
    """Oracle: softplus in float64 above the floor; a plan of numbers, with a slope that is one."""
    source, target, *masks = descriptors()
    variables = variables_of(LEARNED, raw_epsilon=np.float32(raw))
    found = apply(LEARNED, variables, method="epsilon")
    np.testing.assert_allclose(found, MIN_EPSILON + np.logaddexp(0.0, raw), rtol=1e-6)

    value, slope = sharpness_and_slope(variables, source, target, *masks)
    assert np.isfinite(value)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))


def test_epsilon_learns_what_a_sharper_plan_wants():
    """Oracle: two values of epsilon by hand; the slope says which way the sum of squares, largest for a sharp plan, grows."""
    source, target, *masks = descriptors()

    def sharpness(epsilon):
        variables = variables_of(LEARNED, raw_epsilon=jnp.log(jnp.expm1(epsilon - MIN_EPSILON)))
        return jnp.sum(apply(LEARNED, variables, source, target, *masks) ** 2)

    step = 0.01
    slope = (sharpness(0.4 + step) - sharpness(0.4 - step)) / (2 * step)
    assert slope < 0
    np.testing.assert_allclose(jax.grad(sharpness)(jnp.asarray(0.4)), slope, rtol=0.02)


PREDICTED = dataclasses.replace(CFG, predict_mass=True)
WITH_MASS = ("partial_transport", "sparse_transport", "algorithm_1", "released_code")


@pytest.mark.parametrize("weights", [(0.0, 2.0), (-1.0, 3.0), (-1e6, 0.0), (1e6, 1e6), (0.0, -50.0)])
def test_predicted_mass_is_within_its_range(weights):
    """Oracle: the documented formula in float64; mean probability of the best match of each valid row; the plan's total."""
    source, target, *masks = descriptors()
    variables = variables_of(PREDICTED, mass_of_fit=np.float32(weights))
    scores = apply(PREDICTED, variables, source, target, method="scores")
    cost = np.asarray(cost_of(scores, np.asarray(masks[1])), np.float64)
    fit = np.exp(-cost[:10, :13]).max(axis=1).mean()
    expected = 0.05 + 0.95 * expit(weights[0] + weights[1] * fit)
    mass = apply(PREDICTED, variables, jnp.asarray(cost, jnp.float32), *marginals(*masks), method="mass")
    np.testing.assert_allclose(mass, expected, rtol=1e-4)
    assert MASS_RANGE[0] <= mass <= MASS_RANGE[1]
    plan = apply(PREDICTED, variables, source, target, *masks)
    np.testing.assert_allclose(np.sum(plan), expected, rtol=1e-4)


def test_better_matches_are_given_more_mass():
    """Oracle: monotony; descriptors that have a counterpart against descriptors that have none, at the initial weights."""
    source, target, *masks = descriptors()
    stranger = jnp.asarray(np.random.default_rng(9).normal(size=(M, D)), jnp.float32)
    stranger = 0.1 * stranger / jnp.linalg.norm(stranger, axis=1, keepdims=True)
    totals = [float(jnp.sum(apply(PREDICTED, variables_of(PREDICTED), source, other, *masks))) for other in (target, stranger)]
    assert totals[0] > totals[1] + 0.01


@pytest.mark.parametrize("num_candidates", [3, M, 100])
def test_sparse_plan_is_the_dense_one_on_its_candidates(num_candidates):
    """Oracle: the dense transport, on costs that forbid all but the cheapest targets of each row."""
    cfg = dataclasses.replace(CFG, plan="sparse_transport", num_candidates=num_candidates)
    source, target, *masks = descriptors()
    variables = variables_of(cfg)
    scores = apply(cfg, variables, source, target, method="scores")
    cost = np.array(cost_of(scores, np.asarray(masks[1])))
    rank = np.argsort(np.argsort(np.where(masks[1], cost, np.inf), axis=1), axis=1)
    cost[rank >= num_candidates] = 1e3
    expected = partial_transport(jnp.asarray(cost), 0.4, *marginals(*masks), mass=0.3, num_iters=4)
    found = apply(cfg, variables, source, target, *masks)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-8)
    assert np.all(np.count_nonzero(found, axis=1) <= num_candidates)


@functools.cache
def slopes_and_plan(cfg):
    """Slopes of the plan's total by weights and source, and the plan."""

    def total(variables, source, target, *masks):
        plan = apply(cfg, variables, source, target, *masks)
        return jnp.sum(plan), plan

    return jax.jit(jax.grad(total, argnums=(0, 1), has_aux=True))


@pytest.mark.parametrize("plan", PLANS)
@pytest.mark.parametrize("valid", [(0, 0), (0, M), (N, 0), (1, 1)])
def test_nothing_to_match_is_finite(plan, valid):
    """Oracle: nothing moves where nothing is; the slopes are numbers."""
    cfg = dataclasses.replace(CFG, plan=plan, learn_epsilon=True, predict_mass=plan in WITH_MASS)
    source, target, *_ = descriptors()
    masks = jnp.arange(N) < valid[0], jnp.arange(M) < valid[1]
    slopes, found = slopes_and_plan(cfg)(variables_of(cfg), source, target, *masks)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((slopes, found)))
    assert np.all(np.asarray(found)[valid[0] :] == 0)
    assert np.all(np.asarray(found)[:, valid[1] :] == 0)
