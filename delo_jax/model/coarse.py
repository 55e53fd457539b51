"""From a plan between key points to a pose: Procrustes on the plan, on best matches, or on best matches that agree."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from delo_jax.config import PoseConfig
from delo_jax.geometry import se3
from delo_jax.geometry.procrustes import is_determined, planar_procrustes, weighted_procrustes
from delo_jax.geometry.se3 import full_float32
from delo_jax.ops.consistency import consistency_weights
from delo_jax.ops.matching import barycentric_projection


class CoarsePose(NamedTuple):
    """Pose of a plan, and what it was computed from."""

    T_target_source: Float[Array, "4 4"]
    inlier_share: Float[Array, ""]  # share of the source key points whose match fits the pose
    matched: Float[Array, "n 3"]  # target point of every source point [m]
    weights: Float[Array, " n"]  # weights of the matches
    determined: Bool[Array, ""]  # whether the matches fix a rotation


@full_float32
def coarse_pose(
    plan: Float[Array, "n m"],
    source: Float[Array, "n 3"],
    target: Float[Array, "m 3"],
    source_mask: Bool[Array, " n"],
    *,
    cfg: PoseConfig,
) -> CoarsePose:
    """Pose from a plan.

    `procrustes` is the paper's: matched points are the plan's averages of target points, weights its row sums. `argmax`
    takes the best target of each row. `consistency` also weighs those by how well they agree in pairs, and solves for
    yaw and translation alone (roll and pitch are the fine stage's), with reweighted rounds.

    Args:
        plan: >= 0, rows source, columns target; zero in padded rows and columns.
        source: key points in the source frame [m].
        target: key points in the target frame [m].
        source_mask: True where a source key point is real.
        cfg: solver and scales.

    Returns:
        T_target_source with the matches and weights that gave it.
    """
    if cfg.solver == "procrustes":
        matched, weights = barycentric_projection(plan, target)
    else:
        matched = target[jnp.argmax(plan, axis=1)]
        weights = jnp.where(source_mask, jnp.max(plan, axis=1) * jnp.sum(source_mask), 0.0)
    if cfg.solver == "consistency":
        weights = consistency_weights(source, matched, weights, scale=cfg.consistency_m)
        T, num_inliers = _reweighted(source, matched, weights, source_mask, cfg)
    else:
        T = weighted_procrustes(source, matched, weights)
        num_inliers = jnp.sum(_inliers(T, source, matched, source_mask, cfg)[0])
    share = num_inliers / jnp.maximum(jnp.sum(source_mask), 1)
    return CoarsePose(T, share, matched, weights, is_determined(source, matched, weights))


def _inliers(T, source, matched, mask, cfg):
    """Whether each match fits a pose, and its squared residual [m^2]."""
    squared = jnp.sum((se3.transform(T, source) - matched) ** 2, axis=1)
    return (squared < cfg.consistency_m**2) & mask, squared


def _reweighted(source, matched, weights, mask, cfg):
    """Planar pose after rounds in which far matches count less and near ones come back; and how many fitted the last but one."""

    def reweight(_, carry):
        inliers, squared = _inliers(carry[0], source, matched, mask, cfg)
        robust = 1.0 / (1.0 + squared / cfg.consistency_m**2) ** 2
        T = planar_procrustes(source, matched, (weights + 1e-3 / weights.shape[0]) * robust * mask)
        return T, jnp.sum(inliers).astype(jnp.int32)

    start = planar_procrustes(source, matched, weights), jnp.zeros((), jnp.int32)
    return jax.lax.fori_loop(0, cfg.num_rounds, reweight, start)


def point_information(points: Float[Array, "n 3"], weights: Float[Array, " n"]) -> Float[Array, "6 6"]:
    """Gauss-Newton matrix of the distances between matched points, for a right perturbation; zero without weight."""
    total = jnp.sum(weights)
    share = weights / jnp.where(total > 0, total, 1.0)
    eye = jnp.broadcast_to(jnp.eye(3), (points.shape[0], 3, 3))
    jacobian = jnp.concatenate([-se3.skew(points), eye], axis=-1)  # of R^T d(T x) by [omega, v]
    return jnp.einsum("n,nki,nkj->ij", share, jacobian, jacobian)
