"""Constant velocity: the prediction of the next pose, and the de-skew of a sweep."""

import numpy as np

from delo_jax.geometry import se3

NANOSECOND = 1e-9


class ConstantVelocity:
    """The last measured body velocity, a twist per second; None until a motion was measured."""

    def __init__(self):
        self.velocity: np.ndarray | None = None  # (6,) [omega rad/s, v m/s]

    def update(self, T_previous_current: np.ndarray, elapsed_s: float) -> None:
        """Take over the velocity of a measured motion."""
        self.velocity = se3.log(T_previous_current) / elapsed_s

    def predict(self, elapsed_s: float) -> np.ndarray:
        """T_previous_current after `elapsed_s`; the identity while nothing is known."""
        return np.eye(4) if self.velocity is None else se3.exp(self.velocity * elapsed_s)

    def deskew(self, points: np.ndarray, times_s: np.ndarray) -> np.ndarray:
        """Points measured at `times_s` (relative to the stamp) in the sensor frame at the stamp.

        Poses are computed at 128 instants of the sweep and the nearest one is used: at 40 m/s and 0.1 s per sweep
        two instants are 3 cm apart, so a point is at most 1.6 cm off where nothing would leave it 2 m off.

        Args:
            points: (n, 3) as measured [m].
            times_s: (n,) relative to the stamp [s]; a point whose time is not finite counts as measured at the stamp.
        """
        if self.velocity is None or len(points) == 0:
            return points
        times_s = np.where(np.isfinite(times_s), times_s, 0.0)
        first, last = float(np.min(times_s)), float(np.max(times_s))
        knots = np.linspace(first, last, 128)
        poses = se3.exp(knots[:, None] * self.velocity[None, :]).astype(np.float32)
        nearest = np.rint((times_s - first) * (127 / max(last - first, 1e-9))).astype(np.int64)
        at = poses[nearest]
        return np.einsum("nij,nj->ni", at[:, :3, :3], points) + at[:, :3, 3]
