"""Errors of single poses: what a registration got wrong, in length, in angle and by direction."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from delo_jax.geometry import se3
from delo_jax.metrics._poses import checked_pair


class PoseErrors(NamedTuple):
    """Errors of n poses, estimated against true."""

    translation_m: Float64[np.ndarray, " n"]
    """Distance between the two positions."""
    rotation_rad: Float64[np.ndarray, " n"]
    """Angle between the two orientations, in [0, pi]."""
    components_m: Float64[np.ndarray, "n 3"]
    """Estimated minus true position along the axes of the source frame: forward, left and up for a LiDAR with x forward and z up."""


def pose_errors(Ts_estimated: Float[np.ndarray, "n 4 4"], Ts_true: Float[np.ndarray, "m 4 4"]) -> PoseErrors:
    """Errors of T_target_source (or any other T_a_b), pair by pair.

    Angle and distance are the paper's registration errors (Eq. 12); its arc cosine of the trace loses small angles, so the angle is
    an arc tangent here.

    The error is T_true^-1 T_estimated, the right perturbation in which covariances are given too; its translation is therefore
    expressed in the source frame b. Pass motions T_previous_current for components whose sign is that of the vehicle's motion.

    Args:
        Ts_estimated: estimated poses.
        Ts_true: true poses, row i beside row i.

    Returns:
        Errors in metres and radians.

    Raises:
        DeloError: wrong shape, unequal lengths, NaN or infinity.
    """
    estimated, true = checked_pair(Ts_estimated, Ts_true)
    Ts_error = se3.inverse(true) @ estimated
    components = Ts_error[:, :3, 3]
    return PoseErrors(np.linalg.norm(components, axis=-1), np.asarray(se3.rotation_angle(Ts_error[:, :3, :3])), components)
