"""Several scans of one world: short clips for training, long drives for evaluation."""

import dataclasses
from collections.abc import Iterator

import jax
import numpy as np

from delo_jax.errors import ConfigError
from delo_jax.sim import roadside
from delo_jax.sim.motion import MAX_LATERAL_ACCELERATION, Motion, make_motion
from delo_jax.sim.primitives import Primitives, concatenate
from delo_jax.sim.scan import SimulatedScan, simulate_scan
from delo_jax.sim.scenes import (
    KINDS,
    Scene,
    clear_path,
    draw_world,
    lead_vehicle,
    make_chunk,
    make_scene,
    make_traffic,
    match_traffic,
)
from delo_jax.sim.sensors import SENSORS, Sensor, draw_unit
from delo_jax.sim.style import Style
from delo_jax.sim.warp import Warp, max_curvature

CLIP_START_M = 60.0
REACH_M = 130.0
"""How far ahead and behind a long drive keeps its world."""
DRIVE_SEED, LAST_DRIVE_SEED = 500_000, 999_999
"""Of the first drive to test on, and of the last; training worlds and their validation use none from here to there."""


def simulate_clip(
    kind: str,
    seed: int,
    *,
    num_frames: int = 6,
    sensor: str | Sensor = "hdl64e",
    num_columns: int | None = None,
    turning_share: float = 0.35,
    rolling_shutter_share: float = 0.75,
    traffic: float = 1.0,
) -> list[SimulatedScan]:
    """Consecutive scans of a random world, for training; a function of its arguments alone.

    Args:
        kind: of the scene, one of `scenes.KINDS`.
        seed: of scene, motion, sensor unit and noise.
        num_frames: number of scans, one per turn of the sensor.
        sensor: model, or its name.
        num_columns: replaces the sensor's own.
        turning_share: share of clips with free turning rather than lane keeping.
        rolling_shutter_share: share of clips delivered as measured.
        traffic: density of the moving traffic, as a factor > 0.
    """
    sensor = resolve(sensor, num_columns)
    rng = np.random.default_rng([seed, KINDS.index(kind), 5])
    turning, rolling_shutter = rng.uniform() < turning_share, bool(rng.uniform() < rolling_shutter_share)
    motion_seed, unit_seed, noise_seed = (int(s) for s in rng.integers(0, 2**31, 3))
    scene = make_scene(kind, seed, traffic=traffic)
    motion = make_motion(
        motion_seed,
        num_frames * sensor.period_s,
        turning=turning,
        start_x=CLIP_START_M,
        max_speed=min(15.0 if turning else 30.0, safe_speed(scene.warp)),
        start_s=-sensor.period_s,
    )
    scene = clear_path(match_traffic(scene, motion, motion_seed), motion)
    unit, keys = draw_unit(sensor, unit_seed), jax.random.split(jax.random.PRNGKey(noise_seed), num_frames)
    return [
        simulate_scan(scene, motion, k * sensor.period_s, sensor, keys[k], rolling_shutter=rolling_shutter, unit=unit)
        for k in range(num_frames)
    ]


def simulate_drive(
    kind: str,
    seed: int,
    num_scans: int,
    sensor: str | Sensor = "hdl64e",
    *,
    rolling_shutter: bool = False,
    max_speed: float = 30.0,
) -> Iterator[SimulatedScan]:
    """A long drive in its lane; the world is laid out ahead and dropped behind.

    Args:
        kind: of the world, one of `scenes.KINDS`.
        seed: of everything drawn.
        num_scans: number of scans, one per turn of the sensor.
        sensor: model, or its name.
        rolling_shutter: deliver points as measured rather than motion-compensated.
        max_speed: upper bound of the speed [m/s].
    """
    sensor = resolve(sensor, None)
    style, ground, warp = draw_world(kind, seed)
    duration_s, top_speed = num_scans * sensor.period_s, min(max_speed, safe_speed(warp))
    motion = make_motion(seed, duration_s, max_speed=top_speed, start_s=-sensor.period_s)
    unit, key = draw_unit(sensor, seed), jax.random.PRNGKey(seed)
    world = _World(style, seed, motion)
    for k in range(num_scans):
        stamp_s = k * sensor.period_s
        scene = Scene(world.at(stamp_s), ground, warp)
        yield simulate_scan(scene, motion, stamp_s, sensor, jax.random.fold_in(key, k), rolling_shutter=rolling_shutter, unit=unit)


def safe_speed(warp: Warp) -> float:
    """Speed at which the road's tightest bend is taken with the largest lateral acceleration [m/s]."""
    return float(np.sqrt(MAX_LATERAL_ACCELERATION / max(max_curvature(warp), 1e-4)))


class _World:
    """The part of an endless road around the vehicle; keeps what it has laid out while it is near."""

    def __init__(self, style: Style, seed: int, motion: Motion):
        self._style, self._seed, self._motion = style, seed, motion
        self._parts: dict[tuple[int, ...], Primitives] = {}
        rng = np.random.default_rng([seed, 29])
        self._leader = lead_vehicle(rng)
        self._gap_phase, self._gap_period_s = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(30.0, 80.0)

    def at(self, stamp_s: float) -> Primitives:
        """All primitives near the vehicle; positions are those at time 0, had they always moved as now."""
        x = self._x(stamp_s)
        parts: dict[tuple[int, ...], Primitives] = {}
        for index in _chunks_near(x):
            # Whoever walks here starts to do so when the vehicle comes near.
            part = self._parts.get((index,)) or _started(make_chunk(self._style, self._seed, index), stamp_s)
            parts[index,] = part
        for number, lane in enumerate(self._style.lanes):
            # Traffic is laid out in a frame that moves with its lane.
            for index in _chunks_near(x - lane.velocity * stamp_s):
                part = self._parts.get((number, index)) or make_traffic(self._style, self._seed, number, index)
                parts[number, index] = part
        self._parts = parts
        return concatenate([*parts.values(), self._lead(stamp_s)])

    def _x(self, stamp_s: float) -> float:
        return float(np.interp(stamp_s, self._motion.times, self._motion.position[:, 0]))

    def _lead(self, stamp_s: float) -> Primitives:
        """The vehicle ahead: its gap swings between close following and out of sight."""

        def place(time_s):
            swing = 0.5 + 0.5 * np.sin(2.0 * np.pi * time_s / self._gap_period_s + self._gap_phase)
            return self._x(time_s) + 12.0 + 110.0 * swing**2

        speed = (place(stamp_s + 0.05) - place(stamp_s - 0.05)) / 0.1
        velocity = np.zeros_like(self._leader.velocity) + np.array([[speed, 0.0]])
        center = self._leader.center + np.array([[place(stamp_s), 0.0, 0.0]])
        return _started(self._leader._replace(center=center, velocity=velocity), stamp_s)


def _chunks_near(x: float) -> range:
    return range(int((x - REACH_M) // roadside.CHUNK_M), int((x + REACH_M) // roadside.CHUNK_M) + 1)


def _started(primitives: Primitives, stamp_s: float) -> Primitives:
    """The primitives with their positions taken as those at the stamp."""
    center = primitives.center.copy()
    center[:, :2] -= stamp_s * primitives.velocity
    return primitives._replace(center=center)


def resolve(sensor: str | Sensor, num_columns: int | None) -> Sensor:
    """A model of sensor by its name, with another number of columns if there is one."""
    if isinstance(sensor, str) and sensor not in SENSORS:
        raise ConfigError(f"sensor: expected one of {', '.join(SENSORS)}, got {sensor!r}")
    model = SENSORS[sensor] if isinstance(sensor, str) else sensor
    return model if num_columns is None else dataclasses.replace(model, num_columns=num_columns)
