"""De-skew: a sweep measured while the sensor moves, brought to one instant at constant velocity. Host code."""

import numpy as np

from delo_jax.geometry import se3

NUM_INSTANTS = 128


def sweep_poses(times_s: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """(n, 4, 4) float32 pose of the sensor at each time, in its frame at the stamp.

    Computed at 128 instants of the sweep, of which the nearest is taken: at 40 m/s and 0.1 s per sweep two instants are 3 cm
    apart, so a point is at most 1.6 cm off where nothing would leave it 2 m off.

    Args:
        times_s: (n,) relative to the stamp [s], n >= 1; one that is not finite counts as 0.
        velocity: (6,) of the body, [omega rad/s, v m/s].
    """
    times_s = np.where(np.isfinite(times_s), times_s, 0.0)
    first, last = float(np.min(times_s)), float(np.max(times_s))
    instants = np.linspace(first, last, NUM_INSTANTS)
    poses = se3.exp_along(velocity, instants).astype(np.float32)
    return poses[np.rint((times_s - first) * ((NUM_INSTANTS - 1) / max(last - first, 1e-9))).astype(np.int64)]


def deskew(points: np.ndarray, times_s: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Points measured at `times_s` in the sensor frame at the stamp.

    Args:
        points: (n, 3) as measured [m].
        times_s: (n,) relative to the stamp [s]; a point whose time is not finite counts as measured at the stamp.
        velocity: (6,) of the body, [omega rad/s, v m/s].
    """
    if len(points) == 0:
        return points
    poses = sweep_poses(times_s, velocity)
    return np.einsum("nij,nj->ni", poses[:, :3, :3], points) + poses[:, :3, 3]
