"""What the solver knows about its own answer: the input of the evidence head, and the vote between hypotheses."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from delo_jax.config import LEVER_M
from delo_jax.geometry import se3
from delo_jax.geometry.se3 import AnyArray
from delo_jax.model import fine

# Mean and standard deviation of each statistic over simulated pairs, a seventh of them lost; they only condition the
# head's first layer, so two digits do.
_TABLE = (
    ("mean confidence", 0.07, 0.025),
    ("consensus", 0.37, 0.16),
    ("consensus of the other hypothesis", 0.34, 0.17),
    ("difference of the two", 0.03, 0.065),
    ("plane distance, log10 of quantile .25", -1.7, 0.5),
    ("plane distance, log10 of quantile .50", -1.1, 0.55),
    ("plane distance, log10 of quantile .75", -0.6, 0.5),
    ("plane distance, log10 of quantile .90", -0.2, 0.45),
    ("plane distance, log10 of weighted rms", -1.6, 0.4),
    ("information, log10 of eigenvalue 1", -1.6, 0.45),
    ("information, log10 of eigenvalue 2", -1.3, 0.3),
    ("information, log10 of eigenvalue 3", -0.9, 0.25),
    ("information, log10 of eigenvalue 4", -0.6, 0.2),
    ("information, log10 of eigenvalue 5", -0.4, 0.2),
    ("information, log10 of eigenvalue 6", 0.1, 0.2),
    ("last step, log10 of translation", -3.5, 1.0),
    ("last step, log10 of rotation times lever", -3.5, 0.9),
    ("between the hypotheses, log10 of translation", -1.9, 1.8),
    ("between the hypotheses, log10 of rotation times lever", -2.3, 1.5),
    ("pose, log10 of translation", 0.1, 0.7),
    ("pose, log10 of rotation times lever", -0.3, 0.7),
    ("inlier share of the coarse pose", 0.18, 0.11),
    ("mean agreement of normals", 0.65, 0.16),
    ("valid points", 960.0, 190.0),
)
NUM_STATISTICS = len(_TABLE)


def consensus(matches: fine.Matches) -> Float[Array, ""]:
    """Share of the source points that lie on a target surface of the same orientation, in [0, 1].

    The learned confidences have no say: they leave out what does not fit, and would call a street that slid along
    itself a perfect match.
    """
    valid = matches.weights > 0.0
    squared = jnp.sum((matches.points - matches.targets) ** 2, axis=1)
    fit = jnp.maximum(matches.agreement, 0.0) ** 2 / (1.0 + (matches.plane_distance / 0.1) ** 2) / (1.0 + squared)
    return jnp.sum(jnp.where(valid, fit, 0.0)) / jnp.maximum(jnp.sum(valid), 1)


def statistics(matches, information, T, T_delta, disagreement, inlier_share, other_score) -> Float[Array, " s"]:
    """What the solver knows about its own answer, standardised.

    Args:
        matches: of the final pose.
        information: of the final pose, about a left twist in the target frame.
        T: the final pose, T_target_source.
        T_delta: the step that one more iteration would take.
        disagreement: pose between the two hypotheses.
        inlier_share: of the coarse pose.
        other_score: consensus of the hypothesis that lost.
    """
    valid = matches.weights > 0.0
    num_valid = jnp.sum(valid)
    distance = jnp.abs(matches.plane_distance)
    weight = jnp.sum(matches.weights) + 1e-6
    rms = jnp.sqrt(jnp.sum(matches.weights * distance**2) / weight + 1e-12)
    quantiles = _quantiles(distance, valid, jnp.array([0.25, 0.5, 0.75, 0.9]))
    agreement = jnp.sum(jnp.where(valid, matches.agreement, 0.0)) / jnp.maximum(num_valid, 1)
    scale = jnp.repeat(jnp.array([1.0 / LEVER_M, 1.0]), 3)
    eigenvalues = jnp.linalg.eigvalsh(information * scale[:, None] * scale[None, :]) / weight
    lengths = jnp.stack([length for pose in (T_delta, disagreement, T) for length in _lengths(pose)])
    score = consensus(matches)
    raw = jnp.concatenate(
        [
            jnp.stack([weight / matches.weights.shape[0], score, other_score, score - other_score]),
            jnp.log10(jnp.append(quantiles, rms) + 1e-3),
            jnp.log10(jnp.maximum(eigenvalues, 1e-6)),
            jnp.log10(lengths + 1e-4),
            jnp.stack([inlier_share, agreement, num_valid]),
        ]
    )
    mean, deviation = (jnp.array([row[column] for row in _TABLE]) for column in (1, 2))
    return (raw - mean) / deviation


def _quantiles(values: Float[Array, " n"], valid: Bool[Array, " n"], shares: Float[Array, " q"]) -> Float[Array, " q"]:
    """Quantiles of the valid values, linear between two of them; 0 when none is valid."""
    ordered = jnp.sort(jnp.where(valid, values, jnp.inf))
    last = jnp.maximum(jnp.sum(valid) - 1, 0)
    place = shares * last
    low = jnp.floor(place).astype(jnp.int32)
    below, above = ordered[low], ordered[jnp.minimum(low + 1, last)]
    return jnp.where(jnp.any(valid), below + (place - low) * (above - below), 0.0)


def _lengths(T: Float[Array, "4 4"]) -> tuple[AnyArray, AnyArray]:
    return jnp.sqrt(jnp.sum(T[:3, 3] ** 2) + 1e-12), LEVER_M * se3.rotation_angle(T[:3, :3])
