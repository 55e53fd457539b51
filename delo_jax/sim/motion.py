"""Smooth vehicle motion in the flat world, as dense samples."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

SAMPLE_S = 0.01
MAX_LATERAL_ACCELERATION = 5.0
"""m/s^2."""


class Motion(NamedTuple):
    """Vehicle states every `SAMPLE_S`, from `start_s` on; the vehicle frame lies on the road."""

    start_s: float
    position: Float[np.ndarray, "n 2"]
    heading: Float[np.ndarray, " n"]
    """Angle of the vehicle's forward axis from the road's x axis [rad]."""
    roll: Float[np.ndarray, " n"]
    pitch: Float[np.ndarray, " n"]
    heave: Float[np.ndarray, " n"]
    """Of the body above its rest height [m]."""

    @property
    def times(self) -> Float[np.ndarray, " n"]:
        """Of the samples [s]."""
        return self.start_s + SAMPLE_S * np.arange(len(self.heading))


def pose_at(motion: Motion, times: Float[np.ndarray, " m"], height_m: float = 0.0) -> Float[np.ndarray, "m 4 4"]:
    """Poses of a sensor `height_m` above the vehicle frame, in the flat world.

    Args:
        motion: sampled motion.
        times: within the motion [s]; clamped to its ends.
        height_m: of the sensor.

    Returns:
        Ts_flat_lidar, float64.
    """
    states = [*motion.position.T, motion.heading, motion.roll, motion.pitch, motion.heave]
    x, y, heading, roll, pitch, heave = (np.interp(times, motion.times, state) for state in states)
    (cy, cp, cr), (sy, sp, sr) = ([trig(angle) for angle in (heading, pitch, roll)] for trig in (np.cos, np.sin))
    R = np.stack(
        [
            np.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr], axis=1),
            np.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], axis=1),
            np.stack([-sp, cp * sr, cp * cr], axis=1),
        ],
        axis=1,
    )
    Ts_flat_lidar = np.tile(np.eye(4), (len(x), 1, 1))
    Ts_flat_lidar[:, :3, :3] = R
    Ts_flat_lidar[:, :3, 3] = np.stack([x, y, heave], axis=1) + height_m * R[:, :, 2]
    return Ts_flat_lidar


def make_motion(
    seed: int,
    duration_s: float,
    *,
    max_speed: float = 30.0,
    turning: bool = False,
    start_x: float = 0.0,
    start_s: float = -0.1,
) -> Motion:
    """Random driving: in its lane along x, or turning freely as at a crossing.

    Speed, turn rate and body oscillation cover the range of road driving: standing to `max_speed`,
    acceleration within 4 m/s^2, turns up to 45 deg/s with a lateral acceleration below 5 m/s^2,
    pitch and roll up to about 2 deg.

    Args:
        seed: the motion is a function of the arguments alone.
        duration_s: covered time after `start_s`.
        max_speed: upper bound of the speed [m/s].
        turning: start at any heading and turn; else keep to the lane, y near 0.
        start_x: position along the road at the start [m].
        start_s: time of the first sample.
    """
    rng = np.random.default_rng([seed, 17])
    num_samples = int(np.ceil((duration_s - min(start_s, 0.0)) / SAMPLE_S)) + 30
    time = SAMPLE_S * np.arange(num_samples)
    speed = _draw_speed(rng, time, max_speed)
    distance = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * SAMPLE_S)])
    if turning:
        heading, position = _turn(rng, time, speed)
    else:
        heading, position = _keep_lane(rng, distance)
    body_scale = np.deg2rad(rng.uniform(0.0, 1.0)) * np.minimum(1.0, speed / 5.0)
    acceleration = np.gradient(speed, SAMPLE_S)
    turn = np.gradient(heading, SAMPLE_S) * speed
    return Motion(
        start_s=start_s,
        position=position + np.array([start_x, 0.0]),
        heading=heading,
        roll=body_scale * _oscillation(rng, time) + 0.004 * turn,
        pitch=body_scale * _oscillation(rng, time) - 0.003 * acceleration,
        heave=0.02 * rng.uniform() * np.minimum(1.0, speed / 5.0) * _oscillation(rng, time),
    )


def _draw_speed(rng: np.random.Generator, time: np.ndarray, max_speed: float) -> np.ndarray:
    """Speed that tracks targets redrawn every few seconds, acceleration bounded and smooth."""
    targets = [0.0, rng.uniform(0.0, 3.0), rng.uniform(2.0, 16.0), rng.uniform(10.0, 30.0)]
    weights = np.array([0.06, 0.12, 0.47, 0.35])
    speed = target = min(max_speed, targets[rng.choice(4, p=weights)])
    bound = rng.uniform(0.3, 4.0)
    acceleration = 0.0 if target == 0.0 else rng.uniform(-1.0, 1.0) * bound
    speeds, next_draw = np.empty(len(time)), rng.uniform(0.0, 1.0)
    for i, now in enumerate(time):
        if now >= next_draw and rng.uniform() < 0.9:
            target = np.clip(target + rng.normal(0.0, 4.0), 0.0, max_speed) * (rng.uniform() > 0.05)
            next_draw, bound = now + rng.uniform(1.0, 8.0), rng.uniform(0.3, 4.0)
        wanted = np.clip(1.5 * (target - speed), -bound, bound)
        acceleration += np.clip(wanted - acceleration, -8.0 * SAMPLE_S, 8.0 * SAMPLE_S)
        speed = float(np.clip(speed + acceleration * SAMPLE_S, 0.0, max_speed))
        speeds[i] = speed
    return speeds


def _keep_lane(rng: np.random.Generator, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Heading and position of a vehicle that wanders a little about y = 0."""
    lateral, slope = np.zeros_like(distance), np.zeros_like(distance)
    for wavelength in rng.uniform([30.0, 80.0], [80.0, 250.0]):
        k, phase, a = 2.0 * np.pi / wavelength, rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.0, 0.15)
        lateral, slope = lateral + a * np.sin(k * distance + phase), slope + a * k * np.cos(k * distance + phase)
    return np.arctan(slope), np.stack([distance, lateral], axis=1)


def _turn(rng: np.random.Generator, time: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Heading and position of a vehicle that turns at a smoothly varying rate."""
    limit = np.minimum(np.deg2rad(45.0), MAX_LATERAL_ACCELERATION / np.maximum(speed, 0.1))
    limit = limit * np.minimum(1.0, speed / 2.0)
    wave = rng.uniform(-1.0, 1.0) + 0.5 * np.sin(rng.uniform(0.3, 2.0) * time + rng.uniform(0.0, 2.0 * np.pi))
    rate = limit * np.clip(wave, -1.0, 1.0)
    heading = rng.uniform(-np.pi, np.pi) + np.cumsum(rate) * SAMPLE_S
    steps = speed[:, None] * SAMPLE_S * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return heading, np.cumsum(steps, axis=0) - steps[:1]


def _oscillation(rng: np.random.Generator, time: np.ndarray) -> np.ndarray:
    """A wave of amplitude up to 1, slow (body) and fast (wheel) parts."""
    total = np.zeros_like(time)
    for share, frequency in zip(rng.dirichlet(np.ones(3)), rng.uniform([0.3, 1.0, 2.0], [1.0, 2.0, 5.0]), strict=True):
        total += share * np.sin(2.0 * np.pi * frequency * time + rng.uniform(0.0, 2.0 * np.pi))
    return total
