"""Coarse stage: from matching costs to a planar pose."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delo_jax.config import CoarseConfig
from delo_jax.model.coarse import coarse_pose
from tests.fixtures import errors
from tests.oracles.agreement import assert_transforms_agree
from tests.oracles.street import pose

CFG = CoarseConfig()
NUM = 64
solve = jax.jit(functools.partial(coarse_pose, cfg=CFG))


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


@pytest.mark.parametrize("valid", ["nothing", "no source", "no target", "one source", "all at one place"])
def test_hopeless_input_is_finite(valid):
    """Oracle: a rigid transformation all the same, with a gradient of finite numbers."""
    (cost, source, target, *_), _ = problem(0)
    counts = {"nothing": (0, 0), "no source": (0, NUM), "no target": (NUM, 0), "one source": (1, NUM), "all at one place": (NUM, NUM)}
    masks = [jnp.arange(NUM) < count for count in counts[valid]]
    if valid == "all at one place":
        source = target = jnp.ones_like(source)
    found = solve(cost, source, target, *masks)
    T = np.asarray(found.T_target_source, np.float64)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-5)
    assert np.isfinite(T).all()
    assert 0.0 <= found.inlier_share <= 1.0
    gradients = slope(cost, source, target, *masks)
    assert all(np.isfinite(gradient).all() for gradient in gradients)


slope = jax.jit(jax.grad(lambda *data: jnp.sum(coarse_pose(*data, cfg=CFG).T_target_source), argnums=(0, 1, 2)))


def test_jit_and_vmap():
    """Oracle: the same function, one problem at a time, not compiled; a small reweighted solve in float32."""
    batches = [jnp.stack(arrays) for arrays in zip(*(problem(seed, 0.3, 0.05)[0] for seed in range(2)), strict=True)]
    assert_transforms_agree(functools.partial(coarse_pose, cfg=CFG), *batches, rtol=1e-3, atol=1e-3)
