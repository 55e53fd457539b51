"""Covariance of a drive on a map: an error of each pose on the map, new with every scan, and a drift of the map along the way.

Poses on a map do not chain: the errors of two of them, one frame or ten frames apart, hardly differ. The error of a motion is that of
its two ends on the map, plus what the map has drifted by in between; the error of a pose in the world is the drift since the start, plus
that of the pose on the map. Both parts hold a share of the registration's own covariance, which knows the directions that the surfaces
hold badly. A pose on the map is the worse the more the velocity changes from scan to scan, since a sweep is solved for with a constant one;
what bounces up and down also seems to pitch.
"""

from typing import Any, NamedTuple

import numpy as np

from delo_jax.geometry import se3
from delo_jax.uncertainty.covariance import Uncertainty

MEMORY = 0.5  # weight of the newest change of the velocity in the running mean of their squares
NAME = "stream"  # of the numbers among a model's variables, `model.delo.STREAM_NUMBERS`
FORWARD = np.diag([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
TURN, PUSH, HEAVE = (np.diag(np.array(axes, float)) for axes in ([1, 1, 1, 0, 0, 0], [0, 0, 0, 1, 1, 0], [0, 0, 0, 0, 0, 1]))
PITCH_OF_HEAVE = np.outer(np.eye(6)[1], np.eye(6)[5])


class StreamNoise(NamedTuple):
    """Numbers that `delo calibrate` fits; scalars."""

    share: Any
    """Sigma of a pose on the map per sigma of its registration."""
    turn_s: Any
    """Of its rotation, per change of the angular velocity from scan to scan, where points carry times [s]."""
    push_s: Any
    """Of its x and y, per change of the velocity there [s]."""
    heave_s: Any
    """Of its z, likewise [s]."""
    heave_pitch: Any
    """Of its pitch, per change of the vertical velocity, in step with z; of any sign [rad s/m]."""
    drift_share: Any
    """Sigma of the drift per sigma of the registration [m^-1/2]."""
    drift_forward: Any
    """Sigma of the drift along x, beside that [m^1/2]."""

    @classmethod
    def of(cls, variables: dict[str, Any]) -> "StreamNoise | None":
        """Those of a model; None where it is not calibrated."""
        if NAME not in variables:
            return None
        return cls(**{name: float(variables[NAME][name]) for name in cls._fields})

    def stored(self) -> dict[str, Any]:
        """As one of a model's variables."""
        return {name: np.asarray(number, np.float32) for name, number in self._asdict().items()}

    def of_swing(self) -> Any:
        """(6, 6) matrix K: changes of the velocity with squares s make an error of covariance K diag(s) K^T."""
        return self.turn_s * TURN + self.push_s * PUSH + self.heave_s * HEAVE + self.heave_pitch * PITCH_OF_HEAVE


class Swing(NamedTuple):
    """How much the velocity has changed from scan to scan lately."""

    velocity: np.ndarray  # (6,) of the last motion [rad/s, m/s]
    squares: np.ndarray  # (6,) running mean of the squared changes
    num_motions: int

    def after(self, velocity: np.ndarray) -> "Swing":
        """With the velocity of the next motion; the first one has changed from none."""
        if self.num_motions == 0:
            return Swing(velocity, np.zeros(6), 1)
        weight = max(1.0 / self.num_motions, MEMORY)
        squares = (1.0 - weight) * self.squares + weight * (velocity - self.velocity) ** 2
        return Swing(velocity, squares, self.num_motions + 1)


STEADY = Swing(np.zeros(6), np.zeros(6), 0)


class OnMap(NamedTuple):
    """Noise of one pose on a map; (6, 6) of right perturbations of it."""

    local: np.ndarray
    """Of the pose on the map."""
    step: np.ndarray
    """What the map's drift has grown by since the last pose."""


def noise_on_map(numbers: StreamNoise, classical: np.ndarray, squares: np.ndarray, way_m: float) -> OnMap:
    """Noise of a pose that was registered to a map.

    Args:
        numbers: fitted.
        classical: (6, 6) covariance of the registration, from its information.
        squares: (6,) mean squared change of the velocity [rad^2/s^2, m^2/s^2]; zeros where the points carry no times.
        way_m: since the last pose.
    """
    K = numbers.of_swing()
    local = numbers.share**2 * classical + (K * squares[None, :]) @ K.T
    return OnMap(local, way_m * (numbers.drift_share**2 * classical + numbers.drift_forward**2 * FORWARD))


class Standing(NamedTuple):
    """What is known of a pose in the world; (6, 6) of right perturbations of it."""

    drift: np.ndarray
    """Of the map's place in the world."""
    local: np.ndarray
    """Of the pose on the map, or since the last pose on it."""
    begins_map: bool
    """No scan has been registered to the map yet: what is wrong with the scan that it began with is in all that follows."""

    @property
    def covariance(self) -> np.ndarray:
        """Of the pose in the world."""
        return self.drift + self.local

    def settled(self) -> "Standing":
        """The same pose, the first one of a new map: all that is not known of it is drift from now on."""
        return Standing(self.covariance, np.zeros((6, 6)), True)

    def alone(self, covariance: np.ndarray, T: np.ndarray) -> "Standing":
        """After a motion T that no map has measured, with its covariance."""
        Ad = se3.adjoint(se3.inverse(T))
        return Standing(Ad @ self.drift @ Ad.T, Ad @ self.local @ Ad.T + covariance, self.begins_map)

    def on_map(self, noise: OnMap, T: np.ndarray) -> "tuple[Uncertainty, Standing]":
        """Uncertainty of a motion T to a pose that was registered to the map, and what is then known of that pose.

        The error of both ends on the map is noise of the data, the drift in between doubt of the model. The first scan of a map is taken
        to be as wrong as the one after it.
        """
        Ad = se3.adjoint(se3.inverse(T))
        first = noise.local if self.begins_map else np.zeros((6, 6))
        drift = Ad @ self.drift @ Ad.T + noise.step + first
        ends = Ad @ self.local @ Ad.T + first + noise.local
        known = Uncertainty(np.diag(ends).copy(), np.diag(noise.step).copy(), ends + noise.step)
        return known, Standing(drift, noise.local, False)


EXACT = Standing(np.zeros((6, 6)), np.zeros((6, 6)), True)
