"""Constant velocity: the prediction of the next pose."""

import numpy as np

from delo_jax.geometry import se3

NANOSECOND = 1e-9
SURPRISE_M, SURPRISE_DEG = 0.5, 3.0  # between prediction and measurement
MAX_GAP = 3.5  # times the last one


def is_near(T_expected: np.ndarray, T_found: np.ndarray) -> bool:
    """Whether a motion is what the expected one could have become: a vehicle does not jump."""
    return se3.is_within(T_expected, T_found, SURPRISE_M, SURPRISE_DEG)


class ConstantVelocity:
    """The last measured body velocity, a twist per second; None until a motion was measured."""

    def __init__(self):
        self.velocity: np.ndarray | None = None  # (6,) [omega rad/s, v m/s]
        self.earlier: np.ndarray | None = None  # the one before, where the last motion was a surprise
        self.elapsed_s = 0.0  # during the last measured motion

    def update(self, T_previous_current: np.ndarray, elapsed_s: float) -> None:
        """Take over the velocity of a measured motion."""
        surprise = self.velocity is not None and not is_near(self.predict(elapsed_s), T_previous_current)
        self.earlier = self.velocity if surprise else None
        self.velocity, self.elapsed_s = se3.log(T_previous_current) / elapsed_s, elapsed_s

    def predict(self, elapsed_s: float) -> np.ndarray:
        """T_previous_current after `elapsed_s`; the identity while nothing is known."""
        return np.eye(4) if self.velocity is None else se3.exp(self.velocity * elapsed_s)

    def can_tell(self, elapsed_s: float) -> bool:
        """Whether its prediction is worth starting from: known, not surprised last time, and after no gap of more than two scans."""
        return self.velocity is not None and self.earlier is None and elapsed_s < MAX_GAP * self.elapsed_s

    def predictions(self, elapsed_s: float) -> list[np.ndarray]:
        """The prediction and, after a surprise, which a scan that came twice is too, the one of the velocity before it."""
        return [self.predict(elapsed_s)] + ([] if self.earlier is None else [se3.exp(self.earlier * elapsed_s)])
