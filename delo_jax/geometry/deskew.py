"""De-skew: a sweep measured while the sensor moves, brought to one instant at constant velocity. Host code."""

from typing import NamedTuple

import numpy as np

from delo_jax.geometry import se3

NUM_INSTANTS = 128


class Sweep(NamedTuple):
    """When the points of a sweep were measured: at which of a few instants, so that a pose is computed for each of these alone."""

    instants_s: np.ndarray  # (128,) evenly spaced, relative to the stamp
    nearest: np.ndarray  # (n,) int64, of each point


def sweep_of(times_s: np.ndarray) -> Sweep:
    """The nearest of 128 instants for each point.

    At 40 m/s and 0.1 s per sweep, a point is at most 1.6 cm off where nothing would leave it 2 m off.

    Args:
        times_s: (n,) relative to the stamp [s], n >= 1; one that is not finite counts as 0.
    """
    times_s = np.where(np.isfinite(times_s), times_s, 0.0)
    first, last = float(np.min(times_s)), float(np.max(times_s))
    nearest = np.rint((times_s - first) * ((NUM_INSTANTS - 1) / max(last - first, 1e-9))).astype(np.int64)
    return Sweep(np.linspace(first, last, NUM_INSTANTS), nearest)


def sweep_poses(sweep: Sweep, velocity: np.ndarray) -> np.ndarray:
    """(n, 4, 4) float32 pose of the sensor at each point's instant, in its frame at the stamp.

    Args:
        sweep: when points were measured.
        velocity: (6,) of the body, [omega rad/s, v m/s].
    """
    return se3.exp_along(velocity, sweep.instants_s).astype(np.float32).take(sweep.nearest, axis=0)


def deskew(points: np.ndarray, times_s: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Points measured at `times_s` in the sensor frame at the stamp.

    Args:
        points: (n, 3) as measured [m].
        times_s: (n,) relative to the stamp [s]; a point whose time is not finite counts as measured at the stamp.
        velocity: (6,) of the body, [omega rad/s, v m/s].
    """
    if len(points) == 0:
        return points
    poses = sweep_poses(sweep_of(times_s), velocity)
    return np.einsum("nij,nj->ni", poses[:, :3, :3], points) + poses[:, :3, 3]
