"""What needs no points: nothing moves, the motion goes on as it began, the mean motion of the training worlds."""

import numpy as np

from delo_jax.baselines.gicp import Gicp
from delo_jax.baselines.protocols import Aligned, PairMethod, ScanToScan, Sweep
from delo_jax.geometry import se3

MEAN_VELOCITY = np.array([0.0, 0.0, 0.0, 10.5, 0.0, 0.0])
"""[omega rad/s, v m/s] of the body: the mean twist of the 2,800 motions of the 560 training worlds of delo-base, 10.51 m/s forward with a
standard error of 0.3; the other five are within 1.1 standard errors of zero."""
PERIOD_S = 0.1


class Identity(PairMethod):
    """Nothing has moved."""

    deskews = True  # it looks at no points

    def align(self, source: np.ndarray, target: np.ndarray, T_target_source_init: np.ndarray) -> Aligned:
        """The identity."""
        return Aligned.of(np.eye(4))

    def track(self, sweep: Sweep, T_last_guess: np.ndarray) -> Aligned:
        """The identity."""
        return Aligned.of(np.eye(4))


class Start(PairMethod):
    """The start itself; the prediction of a motion model, where it is one."""

    def align(self, source: np.ndarray, target: np.ndarray, T_target_source_init: np.ndarray) -> Aligned:
        """The start."""
        return Aligned.of(T_target_source_init)


class FirstMotion:
    """The motion that GICP measures between the first two scans goes on for ever: prediction alone."""

    deskews = True  # it looks at no points after the first motion, before which there is none to de-skew with

    def __init__(self):
        self._gicp, self._num_scans = ScanToScan(Gicp()), 0

    def track(self, sweep: Sweep, T_last_guess: np.ndarray) -> Aligned:
        """T_last_current: measured at the second scan, from then on the prediction."""
        self._num_scans += 1
        return self._gicp.track(sweep, T_last_guess) if self._num_scans <= 2 else Aligned.of(T_last_guess)


class MeanMotion(PairMethod):
    """The mean motion of the training worlds, 10.5 m/s straight ahead; of a pair, that of 0.1 s from the source to the target."""

    deskews = True  # it looks at no points

    def align(self, source: np.ndarray, target: np.ndarray, T_target_source_init: np.ndarray) -> Aligned:
        """The inverse of the motion of one period."""
        return Aligned.of(se3.exp(-PERIOD_S * MEAN_VELOCITY))

    def track(self, sweep: Sweep, T_last_guess: np.ndarray) -> Aligned:
        """The mean velocity times the time that has passed."""
        return Aligned.of(se3.exp(sweep.elapsed_s * MEAN_VELOCITY))
