"""Absolute and relative errors of a whole trajectory."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from delo_jax.errors import DeloError
from delo_jax.geometry import se3
from delo_jax.metrics._poses import checked_pair
from delo_jax.metrics.registration import PoseErrors, pose_errors


class AbsoluteErrors(NamedTuple):
    """Distances between an aligned trajectory and the truth."""

    rmse_m: float
    """Root of the mean squared distance: the absolute trajectory error (ATE)."""
    translation_m: Float64[np.ndarray, " n"]
    """Distance of every position to its true one, after the alignment."""
    T_true_estimated: Float64[np.ndarray, "4 4"]
    """The alignment: world frame of the estimate to that of the truth."""


def align(estimated_m: Float[np.ndarray, "n 3"], true_m: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "4 4"]:
    """Rigid pose that best maps estimated onto true positions, in the least squares sense (Umeyama 1991, no scale).

    Where the positions leave a rotation open (a straight path, a standing vehicle) one of the best poses is returned.

    Args:
        estimated_m: positions in the estimate's world frame.
        true_m: the same positions in the truth's world frame.

    Returns:
        T_true_estimated.
    """
    estimated_mean, true_mean = estimated_m.mean(axis=0), true_m.mean(axis=0)
    u, _, vt = np.linalg.svd((true_m - true_mean).T @ (estimated_m - estimated_mean))
    u[:, 2] *= np.sign(np.linalg.det(u @ vt))  # a rotation, never a reflection
    T_true_estimated = np.eye(4)
    T_true_estimated[:3, :3] = u @ vt
    T_true_estimated[:3, 3] = true_mean - u @ vt @ estimated_mean
    return T_true_estimated


def absolute_errors(Ts_estimated: Float[np.ndarray, "n 4 4"], Ts_true: Float[np.ndarray, "m 4 4"]) -> AbsoluteErrors:
    """Absolute trajectory error after the best rigid alignment of the positions (Sturm et al. 2012).

    Args:
        Ts_estimated: estimated sensor poses, in any fixed world frame.
        Ts_true: true poses of the same sensor, row i beside row i.

    Returns:
        Distances in metres and the alignment.

    Raises:
        DeloError: no pose at all, wrong shape, unequal lengths, NaN or infinity.
    """
    estimated, true = checked_pair(Ts_estimated, Ts_true)
    if len(true) == 0:
        raise DeloError("Ts_true: expected one or more poses, got none")
    T_true_estimated = align(estimated[:, :3, 3], true[:, :3, 3])
    aligned = estimated[:, :3, 3] @ T_true_estimated[:3, :3].T + T_true_estimated[:3, 3]
    distance = np.linalg.norm(aligned - true[:, :3, 3], axis=-1)
    return AbsoluteErrors(float(np.sqrt(np.mean(distance**2))), distance, T_true_estimated)


def relative_errors(Ts_estimated: Float[np.ndarray, "n 4 4"], Ts_true: Float[np.ndarray, "m 4 4"], *, gap: int = 1) -> PoseErrors:
    """Errors of the motions from every frame i to frame i + gap.

    Args:
        Ts_estimated: estimated sensor poses T_world_lidar, in any fixed world frame.
        Ts_true: true poses of the same sensor, row i beside row i.
        gap: number of frames between the two poses of a motion.

    Returns:
        n - gap errors; components along the axes of the later frame.

    Raises:
        DeloError: a track not longer than the gap, wrong shape, unequal lengths, NaN or infinity.
    """
    estimated, true = checked_pair(Ts_estimated, Ts_true)
    if not 1 <= gap < len(true):
        raise DeloError(f"gap: expected 1 to {len(true) - 1} for {len(true)} poses, got {gap}")
    return pose_errors(se3.inverse(estimated[:-gap]) @ estimated[gap:], se3.inverse(true[:-gap]) @ true[gap:])
