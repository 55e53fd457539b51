"""Spinning LiDARs as data: beam tables, rates, noise."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from delo_jax.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class Sensor:
    """One model of spinning LiDAR."""

    name: str
    elevations_deg: tuple[float, ...]
    """Beam angles above the horizon, one per ring, top first [deg]."""
    num_columns: int
    """Firings per turn."""
    height_m: float
    """Of the sensor above the road."""
    rate_hz: float = 10.0
    min_range_m: float = 1.0
    max_range_m: float = 120.0
    range_noise_m: float = 0.02
    """Standard deviation of one range."""
    threshold: float = 3e-6
    """Signal (reflectance * cos(incidence) / range^2) at which half of the pulses come back."""

    def __post_init__(self) -> None:
        if len(self.elevations_deg) < 1:
            raise ConfigError("sensor.elevations_deg: expected at least one beam, got none")
        if self.num_columns < COLUMNS_PER_GROUP:
            raise ConfigError(f"sensor.num_columns: expected at least {COLUMNS_PER_GROUP}, got {self.num_columns}")
        if not 0.0 <= self.min_range_m < self.max_range_m:
            raise ConfigError(f"sensor.max_range_m: expected more than min_range_m, got {self.max_range_m} and {self.min_range_m}")

    @property
    def period_s(self) -> float:
        """Duration of one turn."""
        return 1.0 / self.rate_hz


COLUMNS_PER_GROUP = 16
"""Width of the column groups for which primitives are culled together."""


class SensorUnit(NamedTuple):
    """The constant errors of one built sensor, per beam."""

    range_offset: Float[np.ndarray, " beams"]
    """Added to each range [m]."""
    elevation_error: Float[np.ndarray, " beams"]
    """True minus nominal elevation [rad]."""
    azimuth_error: Float[np.ndarray, " beams"]
    """True minus nominal azimuth [rad]."""
    blind: Float[np.ndarray, "4 3"]
    """Patches hidden by the vehicle: centre and half width in azimuth, highest elevation [rad]."""


def perfect_unit(sensor: Sensor) -> SensorUnit:
    """A unit without calibration errors."""
    zeros = np.zeros(len(sensor.elevations_deg))
    return SensorUnit(zeros, zeros, zeros, np.tile([0.0, 0.0, -np.pi], (4, 1)))


def draw_unit(sensor: Sensor, seed: int) -> SensorUnit:
    """A unit with residual calibration errors as left by a good factory, on some vehicle.

    Each beam has its own error (1 cm, 0.03 deg) and the whole unit a common elevation error; the
    lowest rings are hidden here and there by the roof and what stands on it.
    """
    rng = np.random.default_rng([seed, 41])
    num_beams = len(sensor.elevations_deg)
    scale = rng.uniform(0.2, 1.2)
    lowest = np.deg2rad(sensor.elevations_deg[-1])
    hidden = np.stack(
        [
            rng.uniform(-np.pi, np.pi, 4),
            rng.uniform(0.02, 0.35, 4) * (rng.uniform(size=4) < 0.7),
            lowest + np.deg2rad(rng.uniform(0.3, 6.0, 4)),
        ],
        axis=1,
    )
    return SensorUnit(
        range_offset=scale * 0.010 * rng.normal(size=num_beams),
        elevation_error=np.deg2rad(scale * 0.03 * rng.normal(size=num_beams) + 0.05 * rng.normal()),
        azimuth_error=np.deg2rad(scale * 0.03 * rng.normal(size=num_beams)),
        blind=hidden,
    )


def _spread(top_deg: float, bottom_deg: float, count: int) -> tuple[float, ...]:
    return tuple(float(angle) for angle in np.linspace(top_deg, bottom_deg, count))


SENSORS: dict[str, Sensor] = {
    sensor.name: sensor
    for sensor in (
        Sensor(
            name="hdl64e",
            elevations_deg=_spread(2.0, -8.0 - 1.0 / 3.0, 32) + _spread(-8.0 - 5.0 / 6.0, -24.0 - 1.0 / 3.0, 32),
            num_columns=2000,
            height_m=1.73,
            min_range_m=2.0,
            max_range_m=80.0,
        ),
        Sensor(
            name="hdl32e",
            elevations_deg=_spread(10.67, -30.67, 32),
            num_columns=1800,
            height_m=1.84,
            max_range_m=80.0,
            threshold=8e-6,
        ),
        Sensor(
            name="os1-128",
            elevations_deg=_spread(22.5, -22.5, 128),
            num_columns=1024,
            height_m=1.80,
            max_range_m=100.0,
            threshold=8e-6,
        ),
        Sensor(
            name="vlp16",
            elevations_deg=_spread(15.0, -15.0, 16),
            num_columns=1800,
            height_m=1.80,
            max_range_m=100.0,
            threshold=8e-6,
        ),
    )
}
