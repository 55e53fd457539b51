"""Coarse stage: transport plan between key points, consistency of pairs, planar pose."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from delo_jax.config import CoarseConfig
from delo_jax.geometry import se3
from delo_jax.geometry.procrustes import planar_procrustes
from delo_jax.geometry.se3 import full_float32
from delo_jax.ops.consistency import consistency_weights
from delo_jax.ops.transport import partial_transport


class CoarsePose(NamedTuple):
    """Answer of the coarse stage."""

    T_target_source: Float[Array, "4 4"]  # yaw and translation; roll and pitch are left to the fine stage
    inlier_share: Float[Array, ""]  # share of the source key points whose match fits the pose


@full_float32
def coarse_pose(
    cost: Float[Array, "n m"],
    source: Float[Array, "n 3"],
    target: Float[Array, "m 3"],
    source_mask: Bool[Array, " n"],
    target_mask: Bool[Array, " m"],
    *,
    cfg: CoarseConfig,
) -> CoarsePose:
    """Pose from matching costs: partial transport, best match per row, pairwise consistency, reweighted Procrustes.

    Args:
        cost: matching cost, rows source, columns target.
        source: key points in the source frame [m].
        target: key points in the target frame [m].
        source_mask: True where a source key point is real.
        target_mask: the same for the target.
        cfg: mass, iterations and scales.

    Returns:
        The planar pose and the share of matches that fit it.
    """
    plan = partial_transport(cost, jnp.ones(()), mass=cfg.mass, num_iters=cfg.num_iters, row_mask=source_mask, column_mask=target_mask)
    best = jnp.argmax(plan, axis=1)
    strength = jnp.max(plan, axis=1) * jnp.sum(source_mask)
    matched = target[best]
    weights = consistency_weights(source, matched, jnp.where(source_mask, strength, 0.0), scale=cfg.consistency_m)
    T = planar_procrustes(source, matched, weights)

    def reweight(_, carry):
        T, _ = carry
        squared = jnp.sum((se3.transform(T, source) - matched) ** 2, axis=1)
        robust = 1.0 / (1.0 + squared / cfg.consistency_m**2) ** 2
        inlier = (squared < cfg.consistency_m**2) & source_mask
        return planar_procrustes(source, matched, (weights + 1e-3 / weights.shape[0]) * robust * source_mask), jnp.sum(inlier)

    T, num_inliers = jax.lax.fori_loop(0, cfg.num_rounds, reweight, (T, jnp.zeros((), jnp.int32)))
    return CoarsePose(T, num_inliers / jnp.maximum(jnp.sum(source_mask), 1))
