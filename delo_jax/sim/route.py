"""Drives along a given path: whoever drove there, through a random world that is laid out beside it."""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter

from delo_jax.errors import DeloError
from delo_jax.sim import objects, roadside
from delo_jax.sim.drive import REACH_M, resolve
from delo_jax.sim.motion import SAMPLE_S, Motion
from delo_jax.sim.primitives import Builder, Primitives, concatenate
from delo_jax.sim.scan import SimulatedScan, simulate_scan
from delo_jax.sim.scenes import CLEARANCE_M, Scene, at_body_height, draw_world, lead_vehicle, make_chunk, without
from delo_jax.sim.sensors import Sensor, draw_unit
from delo_jax.sim.style import Lane, Style

WINDOW, ORDER = 9, 3  # frames and degree of the smoothing polynomials: measured poses jitter, a vehicle does not
SLOPE_S = 4.0  # pitch and roll are counted from their mean over so long: slopes are the world's own
STEP_M = 1.0  # between the places at which the path is looked up
SMALLEST_NUM_POSES = WINDOW


def simulate_route(
    Ts_world_lidar: Float[np.ndarray, "n 4 4"],
    kind: str,
    seed: int,
    *,
    sensor: str | Sensor = "hdl64e",
    rolling_shutter: bool = False,
) -> Iterator[SimulatedScan]:
    """Scans along given poses, one per turn of the sensor; the world has the same things in it wherever the path comes back to.

    Path, heading and speed, pitch and roll against the road are those of the poses, smoothed (Savitzky and Golay 1964); height and slopes
    are the world's. So the truth is that of the scans, and close to the poses in the plane, but not theirs.

    Args:
        Ts_world_lidar: poses, x forward and z up, one turn of the sensor apart.
        kind: of the world, one of `scenes.KINDS`.
        seed: of everything drawn.
        sensor: model, or its name.
        rolling_shutter: deliver points as measured rather than motion-compensated.

    Raises:
        DeloError: too few poses.
    """
    sensor = resolve(sensor, None)
    if len(Ts_world_lidar) < SMALLEST_NUM_POSES:
        raise DeloError(f"Ts_world_lidar: expected {SMALLEST_NUM_POSES} poses or more, got {len(Ts_world_lidar)}")
    style, ground, warp = draw_world(kind, seed)
    # The path may lead anywhere: what runs along x in a world of one straight road is left out.
    still = np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0])[None]
    warp = warp._replace(bend=0.0 * warp.bend, banks=warp.banks * still, bumps=warp.bumps * still)
    ground = ground._replace(left=1e4, right=-1e4)
    motion = motion_along(Ts_world_lidar, sensor.period_s)
    path = Path.of(motion)
    standing, traffic = _standing(style, seed, path), _Traffic(style, seed, path, motion)
    unit, key = draw_unit(sensor, seed), jax.random.PRNGKey(seed)
    for k in range(len(Ts_world_lidar)):
        stamp_s = k * sensor.period_s
        scene = Scene(concatenate([standing, traffic.at(stamp_s)]), ground, warp)
        yield simulate_scan(scene, motion, stamp_s, sensor, jax.random.fold_in(key, k), rolling_shutter=rolling_shutter, unit=unit)


def motion_along(Ts_world_lidar: Float[np.ndarray, "n 4 4"], period_s: float) -> Motion:
    """The motion of a vehicle whose sensor was at these poses, from half a period before the first to half a period after the last."""
    R = Ts_world_lidar[:, :3, :3]
    heading = np.unwrap(np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    pitch, roll = np.arcsin(np.clip(-R[:, 2, 0], -1.0, 1.0)), np.arctan2(R[:, 2, 1], R[:, 2, 2])
    window = min(2 * round(0.5 * SLOPE_S / period_s) + 1, (len(R) - 1) // 2 * 2 + 1)
    body = np.column_stack([pitch, roll])
    body -= savgol_filter(body, window, 1, axis=0)
    states = savgol_filter(np.column_stack([Ts_world_lidar[:, :2, 3], heading, body]), WINDOW, ORDER, axis=0)
    start_s = -period_s
    times = start_s + SAMPLE_S * np.arange(round((len(R) + 1) * period_s / SAMPLE_S) + 1)
    # Beyond the ends it goes on as it was: a straight line through the last two poses.
    padded = np.concatenate([2.0 * states[:1] - states[1:2], states, 2.0 * states[-1:] - states[-2:-1]])
    x, y, heading, pitch, roll = CubicSpline(period_s * np.arange(-1, len(R) + 1), padded)(times).T
    return Motion(start_s, np.column_stack([x, y]), heading, roll, pitch, np.zeros_like(x))


class Path(NamedTuple):
    """The middle of the vehicle's lane, every `STEP_M`, going on straight at both ends; distances count from the first pose on."""

    distance: Float[np.ndarray, " m"]
    position: Float[np.ndarray, "m 2"]
    heading: Float[np.ndarray, " m"]

    @classmethod
    def of(cls, motion: Motion) -> "Path":
        """Of a motion; a vehicle that stands has a path of its two straight ends alone."""
        steps = np.linalg.norm(np.diff(motion.position, axis=0), axis=1)
        moving = np.concatenate([[True], steps > 1e-4])
        position, along = motion.position[moving], np.concatenate([[0.0], np.cumsum(steps)])[moving]
        first, last = motion.heading[0], motion.heading[-1]
        before, after = (REACH_M * np.array([np.cos(angle), np.sin(angle)]) for angle in (first, last))
        position = np.concatenate([position[:1] - before[None], position, position[-1:] + after[None]])
        along = np.concatenate([[-REACH_M], along, [along[-1] + REACH_M]])
        distance = np.arange(along[0], along[-1], STEP_M)
        place = np.column_stack([np.interp(distance, along, column) for column in position.T])
        tangent = np.gradient(place, axis=0)
        return cls(distance, place, np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0])))

    def at(self, distance: Float[np.ndarray, " k"]) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
        """Positions and headings there; clamped to the ends."""
        x, y, heading = (np.interp(distance, self.distance, column) for column in (*self.position.T, self.heading))
        return np.stack([x, y], axis=-1), heading

    def blocked_by(self, primitives: Primitives) -> Bool[np.ndarray, " n"]:
        """Which shapes are nearer to the path than `CLEARANCE_M`, or, being low, lie on it; what hangs high above it stays."""
        reach = np.hypot(*primitives.half_size[:, :2].T).max(initial=0.0) + CLEARANCE_M
        middle = primitives.center[:, :2].mean(axis=0)
        size = np.linalg.norm(primitives.center[:, :2] - middle[None], axis=1).max(initial=0.0)
        near = self.position[np.linalg.norm(self.position - middle[None], axis=1) < size + reach]
        dx, dy = (near[:, None] - primitives.center[None, :, :2]).transpose(2, 0, 1)
        cos, sin = np.cos(primitives.yaw)[None], np.sin(primitives.yaw)[None]
        outside = np.abs(np.stack([cos * dx + sin * dy, cos * dy - sin * dx], axis=-1)) - primitives.half_size[None, :, :2]
        gap = np.linalg.norm(np.maximum(outside, 0.0), axis=2).min(axis=0, initial=np.inf)
        low = primitives.center[:, 2] + primitives.half_size[:, 2] <= 0.3
        return np.where(low, gap <= 0.0, (gap < CLEARANCE_M) & at_body_height(primitives))


def _standing(style: Style, seed: int, path: Path) -> Primitives:
    """What stands along the whole path, laid out straight, piece by piece, and set beside it; whoever walks in it stands, too."""
    found = []
    first, last = (int(np.floor(end / roadside.CHUNK_M)) for end in path.distance[[0, -1]])
    for index in range(first, last + 1):
        chunk, start = make_chunk(style, seed, index), index * roadside.CHUNK_M
        ends, _ = path.at(np.array([start, start + roadside.CHUNK_M]))
        _, (heading,) = path.at(np.array([start + 0.5 * roadside.CHUNK_M]))
        if (step := ends[1] - ends[0]) @ step > 1.0:
            heading = np.arctan2(step[1], step[0])
        placed = moved(chunk, -np.array([start + 0.5 * roadside.CHUNK_M, 0.0]), 0.0)
        placed = moved(placed, ends.mean(axis=0), float(heading))._replace(velocity=np.zeros_like(chunk.velocity))
        if len(placed.yaw):
            found.append(without(placed, path.blocked_by(placed)))
    return concatenate(found)


def moved(primitives: Primitives, position: Float[np.ndarray, " 2"], yaw: float) -> Primitives:
    """Turned about the origin, then set off by a position."""
    R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    center = primitives.center.copy()
    center[:, :2] = center[:, :2] @ R.T + position[None]
    return primitives._replace(center=center, yaw=primitives.yaw + yaw, velocity=primitives.velocity @ R.T)


class _Traffic:
    """Vehicles that keep their lanes along the path, equally fast in each, and one ahead of the sensor."""

    def __init__(self, style: Style, seed: int, path: Path, motion: Motion):
        rng = np.random.default_rng([seed, 31])
        steps = np.linalg.norm(np.diff(motion.position, axis=0), axis=1)
        self._path, self._times, self._along = path, motion.times, np.concatenate([[0.0], np.cumsum(steps)])
        self._leader = lead_vehicle(rng)
        self._gap_phase, self._gap_period_s = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(30.0, 80.0)
        self._cars: list[tuple[Lane, float, Primitives]] = []
        for lane in style.lanes:
            travelled = lane.velocity * motion.times[-1]
            start = path.distance[0] - max(travelled, 0.0) + rng.exponential(style.traffic_gap)
            while start < path.distance[-1] - min(travelled, 0.0):
                builder = Builder(rng, first_id=1_000_000_000 + len(self._cars))
                objects.car(builder, 0.0, 0.0, np.pi if lane.oncoming else 0.0, lorries=True)
                self._cars.append((lane, start, builder.build()))
                start += 16.0 + rng.exponential(style.traffic_gap)

    def at(self, stamp_s: float) -> Primitives:
        """All of them near the sensor; positions are those at time 0, had they always moved as now."""
        own = float(np.interp(stamp_s, self._times, self._along))
        (here,), _ = self._path.at(np.array([own]))
        swing = 0.5 + 0.5 * np.sin(2.0 * np.pi * stamp_s / self._gap_period_s + self._gap_phase)
        speed = (np.interp(stamp_s + 0.05, self._times, self._along) - np.interp(stamp_s - 0.05, self._times, self._along)) / 0.1
        found = [self._placed(self._leader, own + 12.0 + 110.0 * swing**2, 0.0, speed, stamp_s)]
        for lane, start, car in self._cars:
            distance = start + lane.velocity * stamp_s
            if not self._path.distance[0] < distance < self._path.distance[-1]:
                continue
            (there,), _ = self._path.at(np.array([distance]))
            away = np.linalg.norm(there - here)
            if 4.0 - abs(lane.y) < away < REACH_M:  # where the path crosses itself it may meet the sensor
                found.append(self._placed(car, distance, lane.y, lane.velocity, stamp_s))
        return concatenate(found)

    def _placed(self, car: Primitives, distance: float, offset: float, velocity: float, stamp_s: float) -> Primitives:
        (position,), (heading,) = self._path.at(np.array([distance]))
        ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
        placed = moved(car, position + (offset * left) - stamp_s * velocity * ahead, float(heading))
        return placed._replace(velocity=np.tile(velocity * ahead, (len(car.yaw), 1)))
