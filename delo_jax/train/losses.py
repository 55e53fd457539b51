"""Losses of the three parts: matching, pose, evidence."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from delo_jax.config import StatusConfig
from delo_jax.geometry import se3
from delo_jax.geometry.se3 import full_float32
from delo_jax.ops import evidence

MATCH_SIGMA_M = 0.7  # width of a soft true match
MATCH_REACH_M = 1.5  # a key point without a counterpart within this has no true match
ITERATION_WEIGHTS = (0.3, 0.5, 0.8, 1.0)


def true_matches(
    source: Float[Array, "n 3"],
    target: Float[Array, "m 3"],
    source_normals: Float[Array, "s 3"],
    target_normals: Float[Array, "t 3"],
    source_mask: Bool[Array, " n"],
    target_mask: Bool[Array, " m"],
    T_target_source: Float[Array, "4 4"],
) -> Float[Array, "n m"]:
    """Unnormalised soft matches: a Gaussian of the distance under the true pose where the normals, if there are any, agree."""
    moved = se3.transform(T_target_source, source)
    squared = sum((moved[:, None, axis] - target[None, :, axis]) ** 2 for axis in range(3))
    possible = (squared < MATCH_REACH_M**2) & source_mask[:, None] & target_mask[None, :]
    if source_normals.shape[0] > 0:
        possible &= (source_normals @ T_target_source[:3, :3].T) @ target_normals.T > 0.5
    return jnp.where(possible, jnp.exp(-0.5 * squared / MATCH_SIGMA_M**2), 0.0)


def matching_loss(
    scores: Float[Array, "n m"], matches: Float[Array, "n m"], source_mask: Bool[Array, " n"], target_mask: Bool[Array, " m"]
):
    """Cross-entropy of the scores' row and column softmax against the soft true matches; rows without one do not count."""
    valid = source_mask[:, None] & target_mask[None, :]
    masked = jnp.where(valid, scores, -1e9)
    total = jnp.zeros(())
    for axis in (0, 1):
        mass = jnp.sum(matches, axis=axis, keepdims=True)
        share = matches / jnp.where(mass > 0, mass, 1.0)
        entropy = -jnp.sum(share * jax.nn.log_softmax(masked, axis=axis), axis=axis)
        matched = (mass > 0).squeeze(axis)
        total += 0.5 * jnp.sum(jnp.where(matched, entropy, 0.0)) / jnp.maximum(jnp.sum(matched), 1)
    return total


@full_float32
def pose_loss(poses: Float[Array, "t 4 4"], T_true: Float[Array, "4 4"]) -> Float[Array, ""]:
    """Sum over iterations of log(1 cm + translation error) + log(1 mrad + rotation error), later ones weighing more.

    The logarithm keeps a hopeless start from drowning the millimetres of a good one.
    """
    error = jax.vmap(lambda T: se3.inverse(T) @ T_true)(poses)
    translation = jnp.sqrt(jnp.sum(error[:, :3, 3] ** 2, axis=1) + 1e-10)
    rotation = jax.vmap(se3.rotation_angle)(error[:, :3, :3])
    values = jnp.log(1.0 + translation / 0.01) + jnp.log(1.0 + rotation / 0.001)
    weights = jnp.array(ITERATION_WEIGHTS)[-poses.shape[0] :]
    return jnp.sum(weights * values) / jnp.sum(weights)


def plan_loss(plan: Float[Array, "n m"], matches: Float[Array, "n m"]) -> Float[Array, ""]:
    """Cross-entropy of a plan, as a distribution over pairs of points, against the soft true matches.

    Any plan can be trained by it, and one that moves less mass where there is no true match is rewarded.
    """
    mass, total = jnp.sum(matches), jnp.sum(plan)
    share = matches / jnp.where(mass > 0, mass, 1.0)
    log_plan = jnp.log(plan / jnp.where(total > 0, total, 1.0) + 1e-12)
    return -jnp.sum(share * log_plan)


def point_loss(
    T: Float[Array, "4 4"], T_true: Float[Array, "4 4"], points: Float[Array, "n 3"], mask: Bool[Array, " n"]
) -> Float[Array, ""]:
    """L_pose of the paper: mean over points of the l1 distance, summed over coordinates, between T y and T_true y [m].

    The released code's variant of it takes the mean over coordinates too, a third of this.
    """
    difference = jnp.abs(se3.transform(T, points) - se3.transform(T_true, points))
    return jnp.sum(jnp.where(mask[:, None], difference, 0.0)) / jnp.maximum(jnp.sum(mask), 1)


@full_float32
def matrix_loss(T: Float[Array, "4 4"], T_true: Float[Array, "4 4"]) -> Float[Array, ""]:
    """Pose loss of the released code: 5 mean((R^T R_true - I)^2) + mean((t - t_true)^2)."""
    rotation = T[:3, :3].T @ T_true[:3, :3] - jnp.eye(3)
    return 5.0 * jnp.mean(rotation**2) + jnp.mean((T[:3, 3] - T_true[:3, 3]) ** 2)


def auxiliary_loss(
    matched: Float[Array, "n 3"], weights: Float[Array, " n"], T_true: Float[Array, "4 4"], points: Float[Array, "n 3"]
) -> Float[Array, ""]:
    """L_aux: mean over points of the l1 distance between a point's barycentric match and where it truly goes [m].

    The paper prints the predicted pose here, which supervises nothing; this is the true one, as in LCDNet (Cattaneo et
    al. 2022) and in the released code, which takes the mean over coordinates too. Points that send no mass do not count.
    """
    difference = jnp.sum(jnp.abs(matched - se3.transform(T_true, points)), axis=1)
    sends = weights > 0
    return jnp.sum(jnp.where(sends, difference, 0.0)) / jnp.maximum(jnp.sum(sends), 1)


def evidence_loss(
    nig: evidence.NIG, observed: Float[Array, "6"], regularisers: Float[Array, "6"], bound: float = jnp.inf
) -> Float[Array, ""]:
    """L_evidence of the paper: mean over six axes of the negative log likelihood plus lambda_R times the regulariser.

    The likelihood is minimised, not maximised as printed, and the observation is the truth, not the prediction. The
    released code sums the means over the three angles and the three translations: twice this.

    Args:
        nig: prediction, in the observation's units.
        observed: the true pose6, or the true error of the pose.
        regularisers: lambda_R per axis.
        bound: the regulariser sees observations clipped to this, so that a lost pair does not drown the rest.
    """
    likelihood = evidence.negative_log_likelihood(nig, observed)
    return jnp.mean(likelihood + regularisers * evidence.regulariser(nig, jnp.clip(observed, -bound, bound)))


def success_loss(logit: Float[Array, ""], observed: Float[Array, "6"], limits: StatusConfig) -> Float[Array, ""]:
    """Cross-entropy of the predicted probability that the pair is not lost, against whether it is."""
    rotation, translation = (jnp.sqrt(jnp.sum(part**2)) for part in jnp.split(observed, 2))
    good = (translation <= limits.lost_translation_m) & (rotation <= jnp.radians(limits.lost_rotation_deg))
    return jax.nn.softplus(jnp.where(good, -logit, logit))
