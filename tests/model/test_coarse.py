"""From a plan to a pose; plans are those of the transport on costs made by hand, or one-hot."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from delo_jax.config import SOLVERS, MatchingConfig, PoseConfig
from delo_jax.model.coarse import coarse_pose
from delo_jax.ops.matching import uniform_marginal
from delo_jax.ops.transport import partial_transport
from tests.fixtures import errors
from tests.oracles.agreement import assert_gradient_is_the_slope, assert_transforms_agree
from tests.oracles.street import pose

CFG, MATCHING = PoseConfig(), MatchingConfig()
NUM = 64


def pose_of_costs(cost, source, target, row_mask, column_mask, *, cfg):
    """Transport, then the pose."""
    marginals = uniform_marginal(row_mask), uniform_marginal(column_mask)
    plan = partial_transport(cost, jnp.ones(()), *marginals, mass=MATCHING.mass, num_iters=MATCHING.num_iters)
    return coarse_pose(plan, source, target, row_mask, cfg=cfg)


solve = jax.jit(functools.partial(pose_of_costs, cfg=CFG))


def problem(seed, outlier_share=0.0, noise_m=0.0):
    """Key points of two scans in different order, costs that know the matches, wrong ones among them, and T_target_source."""
    rng = np.random.default_rng(seed)
    source = rng.uniform([-40, -40, -1], [40, 40, 5], size=(NUM, 3))
    x, y = rng.uniform(-8, 8, 2)
    T = pose(x, y, 0.3, yaw_deg=rng.uniform(-180, 180))
    order = rng.permutation(NUM)
    target = np.empty_like(source)
    target[order] = source @ T[:3, :3].T + T[:3, 3] + noise_m * rng.normal(size=source.shape)
    believed = order.copy()
    wrong = rng.permutation(NUM)[: int(outlier_share * NUM)]
    believed[wrong] = np.roll(order[wrong], 1)
    cost = np.full((NUM, NUM), 10.0)
    cost[np.arange(NUM), believed] = 0.0
    masks = np.ones(NUM, bool), np.ones(NUM, bool)
    return [jnp.asarray(a, jnp.float32) for a in (cost, source, target)] + [jnp.asarray(m) for m in masks], T


@pytest.mark.parametrize("seed", range(3))
def test_perfect_costs_give_the_motion(seed):
    """Oracle: the planar motion that made the target, any yaw, up to 11 m; float32 at 50 m."""
    data, T_true = problem(seed)
    found = solve(*data)
    translation, rotation = errors(found.T_target_source, T_true)
    assert translation < 1e-4
    assert rotation < 1e-3
    assert found.inlier_share == 1.0


@pytest.mark.parametrize("seed", range(3))
def test_half_of_the_matches_may_be_wrong(seed):
    """Oracle: the motion that made the target. The wrong half agrees with no rigid motion; its weights go to nothing.

    A thousandth of the weight left on matches that are 30 m off would show as centimetres.
    """
    data, T_true = problem(seed, outlier_share=0.5)
    found = solve(*data)
    translation, rotation = errors(found.T_target_source, T_true)
    assert translation < 1e-3
    assert rotation < 1e-2
    assert 0.5 <= found.inlier_share < 0.6


def test_padding_changes_nothing():
    """Oracle: symmetry; padded rows and columns hold garbage, and the bytes stay."""
    (cost, source, target, mask, _), T_true = problem(0)
    row_mask, column_mask = mask.at[48:].set(False), mask
    rng = np.random.default_rng(1)
    other = cost.at[48:].set(jnp.asarray(rng.normal(size=(16, NUM)), jnp.float32)), source.at[48:].set(100.0)
    here, there = solve(cost, source, target, row_mask, column_mask), solve(*other, target, row_mask, column_mask)
    assert np.array_equal(here.T_target_source, there.T_target_source)
    assert here.inlier_share == there.inlier_share == 1.0
    unused = jnp.argmin(cost[48:], axis=1)  # the columns of the padded rows become padding too
    column_mask = mask.at[unused].set(False)
    there = solve(cost.at[:, unused].set(-50.0), source, target.at[unused].set(-70.0), row_mask, column_mask)
    assert errors(there.T_target_source, T_true)[0] < 1e-4


@pytest.mark.parametrize("yaw_deg", [30.0, -170.0])
def test_pose_turns_with_both_scans(yaw_deg):
    """Oracle: symmetry; a turned pair has the conjugated pose."""
    (cost, source, target, *masks), _ = problem(3, outlier_share=0.3, noise_m=0.05)
    G = pose(z=0.0, yaw_deg=yaw_deg)
    R = jnp.asarray(G[:3, :3], jnp.float32)
    here = np.asarray(solve(cost, source, target, *masks).T_target_source)
    there = solve(cost, source @ R.T, target @ R.T, *masks).T_target_source
    np.testing.assert_allclose(there, G @ here @ np.linalg.inv(G), atol=1e-3)  # float32 at 50 m, through the reweighting


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("valid", ["nothing", "no source", "no target", "one source", "all at one place"])
def test_hopeless_input_is_finite(valid, solver):
    """Oracle: a rigid transformation all the same, with a gradient of finite numbers; and it is said that nothing fixes it."""
    (cost, source, target, *_), _ = problem(0)
    counts = {"nothing": (0, 0), "no source": (0, NUM), "no target": (NUM, 0), "one source": (1, NUM), "all at one place": (NUM, NUM)}
    masks = [jnp.arange(NUM) < count for count in counts[valid]]
    if valid == "all at one place":
        source = target = jnp.ones_like(source)
    found = compiled(solver)(cost, source, target, *masks)
    T = np.asarray(found.T_target_source, np.float64)
    assert not found.determined
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-5)
    assert np.isfinite(T).all()
    assert 0.0 <= found.inlier_share <= 1.0
    gradients = slope(solver)(cost, source, target, *masks)
    assert all(np.isfinite(gradient).all() for gradient in gradients)


@functools.cache
def slope(solver):
    """Gradient of the pose by costs and points."""
    cfg = PoseConfig(solver=solver)
    return jax.jit(jax.grad(lambda *data: jnp.sum(pose_of_costs(*data, cfg=cfg).T_target_source), argnums=(0, 1, 2)))


@functools.cache
def compiled(solver):
    """Costs to pose by one of the solvers."""
    return jax.jit(functools.partial(pose_of_costs, cfg=PoseConfig(solver=solver)))


@pytest.mark.parametrize("solver", ["procrustes", "consistency"])
def test_jit_and_vmap(solver):
    """Oracle: the same function, one problem at a time, not compiled; a small reweighted solve in float32."""
    batches = [jnp.stack(arrays) for arrays in zip(*(problem(seed, 0.3, 0.05)[0] for seed in range(2)), strict=True)]
    cfg = PoseConfig(solver=solver)
    assert_transforms_agree(lambda *data: pose_of_costs(*data, cfg=cfg)[:4], *batches, rtol=1e-3, atol=1e-3)


@functools.cache
def pose_of_plan(solver):
    """Plan to pose by one of the solvers."""
    return jax.jit(functools.partial(coarse_pose, cfg=PoseConfig(solver=solver)))


def exact(solver, seed, num_matched=40):
    """A one-hot plan of some key points, the clouds, the mask, and T_target_source: any motion, or one in the plane."""
    rng = np.random.default_rng(seed)
    angles = {"yaw_deg": rng.uniform(-180, 180)}
    if solver != "consistency":
        angles |= {"pitch_deg": rng.uniform(-80, 80), "roll_deg": rng.uniform(-180, 180)}
    T = pose(*rng.uniform(-9, 9, 3), **angles)
    source = rng.uniform([-40, -40, -1], [40, 40, 5], size=(NUM, 3))
    order, mask = rng.permutation(NUM), np.arange(NUM) < 50
    target = np.empty_like(source)
    target[order] = source @ T[:3, :3].T + T[:3, 3]
    plan = np.zeros((NUM, NUM))
    plan[np.arange(num_matched), order[:num_matched]] = rng.uniform(0.5, 1.0, num_matched) / NUM
    return [jnp.asarray(array, jnp.float32) for array in (plan, source, target)], jnp.asarray(mask), plan, order, T


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("seed", range(3))
def test_one_hot_plan_gives_the_motion(solver, seed):
    """Oracle: the motion that made the target: any rotation, or with `consistency` any yaw; float32 at 50 m.

    40 of 50 key points are matched; what the others would say is of no weight, or a robust one.
    """
    data, mask, plan, order, T_true = exact(solver, seed)
    found = pose_of_plan(solver)(*data, mask)
    translation, rotation = errors(found.T_target_source, T_true)
    assert translation < (1e-4 if solver != "consistency" else 1e-3)
    assert rotation < (1e-3 if solver != "consistency" else 1e-2)
    assert found.determined
    assert found.inlier_share == 40 / 50
    np.testing.assert_allclose(found.matched[:40], data[2][order[:40]], atol=1e-4)
    assert np.all(np.asarray(found.weights[40:]) == 0)
    if solver == "procrustes":
        np.testing.assert_allclose(found.weights, plan.sum(axis=1), rtol=1e-6)


def test_procrustes_on_a_soft_plan_is_the_weighted_fit():
    """Oracle: scipy's Rotation.align_vectors on the plan's averages of the targets, weighted by its row sums, in float64."""
    rng = np.random.default_rng(5)
    (_, source, target), mask, *_ = exact("procrustes", 5)
    plan = rng.uniform(size=(NUM, NUM)) ** 8 * np.asarray(mask)[:, None]
    found = coarse_pose(jnp.asarray(plan, jnp.float32), source, target, mask, cfg=PoseConfig(solver="procrustes"))
    weights, x, y = plan.sum(axis=1)[:50], np.asarray(source, np.float64)[:50], np.asarray(target, np.float64)
    matched = (plan[:50] @ y) / weights[:, None]
    x_mean, y_mean = np.average(x, axis=0, weights=weights), np.average(matched, axis=0, weights=weights)
    R = Rotation.align_vectors(matched - y_mean, x - x_mean, weights=weights)[0].as_matrix()
    np.testing.assert_allclose(found.T_target_source[:3, :3], R, atol=1e-4)
    np.testing.assert_allclose(found.T_target_source[:3, 3], y_mean - R @ x_mean, atol=1e-3)


@pytest.mark.parametrize("solver", SOLVERS)
def test_gradient_is_the_slope(solver):
    """Oracle: central differences in x64, through plan and points; which match is best does not change within a step."""
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        source = rng.uniform([-20, -20, -1], [20, 20, 5], size=(12, 3))
        T = pose(1.0, -0.5, 0.1, yaw_deg=10.0)
        target = source @ T[:3, :3].T + T[:3, 3] + 0.1 * rng.normal(size=source.shape)
        plan = (0.3 * rng.uniform(size=(12, 12)) + np.eye(12)) / 20.0
        probe, mask = jnp.asarray(rng.normal(size=(4, 4))), jnp.ones(12, bool)

        def loss(plan, source, target):
            return jnp.sum(probe * coarse_pose(plan, source, target, mask, cfg=PoseConfig(solver=solver)).T_target_source)

        assert_gradient_is_the_slope(loss, [plan, source, target], rtol=1e-5)
