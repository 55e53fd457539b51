"""Losses of the three parts: matching, pose, evidence."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from delo_jax.config import StatusConfig
from delo_jax.geometry import se3
from delo_jax.ops import evidence

MATCH_SIGMA_M = 0.7  # width of a soft true match
MATCH_REACH_M = 1.5  # a key point without a counterpart within this has no true match
ITERATION_WEIGHTS = (0.3, 0.5, 0.8, 1.0)


def true_matches(
    source: Float[Array, "n 3"],
    target: Float[Array, "m 3"],
    source_normals: Float[Array, "n 3"],
    target_normals: Float[Array, "m 3"],
    source_mask: Bool[Array, " n"],
    target_mask: Bool[Array, " m"],
    T_target_source: Float[Array, "4 4"],
) -> Float[Array, "n m"]:
    """Unnormalised soft matches: a Gaussian of the distance under the true pose where the normals agree."""
    moved = se3.transform(T_target_source, source)
    squared = sum((moved[:, None, axis] - target[None, :, axis]) ** 2 for axis in range(3))
    agree = (source_normals @ T_target_source[:3, :3].T) @ target_normals.T > 0.5
    possible = agree & (squared < MATCH_REACH_M**2) & source_mask[:, None] & target_mask[None, :]
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


def evidence_loss(nig: evidence.NIG, observed: Float[Array, "6"], units: Float[Array, "6"], regulariser_weight: float) -> Float[Array, ""]:
    """Negative log likelihood of the pose error plus lambda_R times its regulariser, mean over six axes.

    The observation is log(T_predicted^-1 T_true), divided by `units` (rad and m) so that all axes weigh alike.
    """
    observed = observed / units
    scaled = evidence.NIG(nig.gamma / units, nig.nu, nig.alpha, nig.beta / units**2)
    likelihood = evidence.negative_log_likelihood(scaled, observed)
    # a lost pair is off by 500 units: its pull on the regulariser is bounded
    penalty = evidence.regulariser(scaled, jnp.clip(observed, -10.0, 10.0))
    return jnp.mean(likelihood + regulariser_weight * penalty)


def success_loss(logit: Float[Array, ""], observed: Float[Array, "6"], limits: StatusConfig) -> Float[Array, ""]:
    """Cross-entropy of the predicted probability that the pair is not lost, against whether it is."""
    rotation, translation = (jnp.sqrt(jnp.sum(part**2)) for part in jnp.split(observed, 2))
    good = (translation <= limits.lost_translation_m) & (rotation <= jnp.radians(limits.lost_rotation_deg))
    return jax.nn.softplus(jnp.where(good, -logit, logit))
