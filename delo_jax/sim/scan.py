"""One simulated scan: rays cast in the flat world, hits warped, noise and dropout added."""

import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt32

from delo_jax.sim import cull
from delo_jax.sim.measure import Beams, Columns, Ground, Limits, Measured, measure
from delo_jax.sim.motion import Motion, pose_at
from delo_jax.sim.primitives import Primitives, take
from delo_jax.sim.raycast import Table, Work
from delo_jax.sim.scenes import Scene
from delo_jax.sim.sensors import Sensor, SensorUnit, perfect_unit
from delo_jax.sim.warp import Warp, evaluate, jacobian, rebase, warp_poses


class SimulatedScan(NamedTuple):
    """Points as a driver delivers them, ring by ring, azimuth rising from straight ahead, and their truth."""

    points: Float[np.ndarray, "n 3"]
    """float32, in the sensor frame at each point's own time, or at the stamp if compensated [m]."""
    times_s: Float[np.ndarray, " n"]
    """Relative to the stamp; zero if compensated [s]."""
    normals: Float[np.ndarray, "n 3"]
    """Unit, in the frame of the points, towards the sensor."""
    object_ids: Int[np.ndarray, " n"]
    """0 for the ground."""
    labels: Int[np.ndarray, " n"]
    """Values of `primitives.Label`."""
    moving: Bool[np.ndarray, " n"]
    T_world_lidar: Float[np.ndarray, "4 4"]
    """True pose of the sensor at the stamp, float64."""


_measure = jax.jit(measure)


def simulate_scan(
    scene: Scene,
    motion: Motion,
    stamp_s: float,
    sensor: Sensor,
    key: UInt32[jax.Array, " 2"],
    *,
    rolling_shutter: bool,
    unit: SensorUnit | None = None,
    noise: bool = True,
) -> SimulatedScan:
    """The scan of a sweep centred on the stamp.

    The sweep starts behind the vehicle, goes over its left side, clockwise seen from above, and
    ends behind: a point at azimuth a is measured at -a / (2 pi) * period. Without rolling shutter,
    the points are those of the same moving sweep, brought to the stamp by the true motion.

    Args:
        scene: world at time 0.
        motion: covers the stamp and half a period on both sides.
        stamp_s: time at which the beam points straight ahead.
        sensor: model of the sensor.
        key: randomness of this scan.
        rolling_shutter: deliver points as measured rather than motion-compensated.
        unit: calibration errors of the sensor; none by default.
        noise: False switches off range noise, jitter and dropout.
    """
    phase_key, ray_key = jax.random.split(key)
    phase = float(jax.random.uniform(phase_key))
    azimuth = 2.0 * np.pi * (np.arange(sensor.num_columns) + phase) / sensor.num_columns
    time = -(np.mod(azimuth + np.pi, 2.0 * np.pi) - np.pi) / (2.0 * np.pi) * sensor.period_s
    columns, base, T_world_lidar = _place_columns(scene.warp, motion, stamp_s, sensor, azimuth, time)
    beams = _beams(sensor, unit or perfect_unit(sensor))
    if rolling_shutter:
        identity = np.tile(np.eye(3)[:, :, None], (1, 1, sensor.num_columns))
        columns = columns._replace(R_out=identity, t_out=np.zeros((3, sensor.num_columns)))
    primitives, table, work = _find_work(scene, stamp_s, base, columns, beams, sensor)
    noise_scale = float(noise)
    limits = Limits(
        sensor.min_range_m,
        sensor.max_range_m,
        noise_scale * sensor.range_noise_m,
        noise_scale * 0.1 * 2.0 * np.pi / sensor.num_columns,
        noise_scale * sensor.threshold,
        noise_scale * 0.03,
    )
    reflectance = np.zeros(len(table.shape), np.float32)
    reflectance[: len(primitives.shape)] = primitives.reflectance
    ground = Ground(scene.ground.left - base[1], scene.ground.right - base[1], *scene.ground[2:])
    arguments = columns, beams, rebase(scene.warp, *base), table, reflectance, ground, limits
    measured = _measure(*jax.tree.map(_to_float32, arguments), work, ray_key)
    return _compact(jax.device_get(measured), primitives, time * rolling_shutter, T_world_lidar)


def _to_float32(leaf):
    leaf = np.asarray(leaf)
    return leaf.astype(np.float32) if leaf.dtype == np.float64 else leaf


def _place_columns(
    warp: Warp, motion: Motion, stamp_s: float, sensor: Sensor, azimuth: np.ndarray, time: np.ndarray
) -> tuple[Columns, np.ndarray, np.ndarray]:
    """Poses of all firings, the local origin (x, y) they are counted from, and the pose at the stamp."""
    Ts_flat_lidar = pose_at(motion, np.append(stamp_s + time, stamp_s), sensor.height_m)
    Ts_world_lidar = warp_poses(warp, Ts_flat_lidar)
    T_world_lidar = Ts_world_lidar[-1].copy()
    base = Ts_flat_lidar[-1, :2, 3].copy()
    J = jacobian(evaluate(warp, Ts_flat_lidar[:, 0, 3], Ts_flat_lidar[:, 1, 3]))
    Rs = Ts_world_lidar[:, :3, :3]
    offset = Ts_world_lidar[:, :3, 3] - T_world_lidar[:3, 3]
    local = np.array([*base, 0.0])
    return (
        Columns(
            azimuth=azimuth,
            time=time,
            origin=(Ts_flat_lidar[:-1, :3, 3] - local).T,
            R_flat_lidar=np.moveaxis(np.linalg.solve(J, Rs)[:-1], 0, 2),
            R_lidar_world=np.moveaxis(Rs[:-1], 0, 2).swapaxes(0, 1),
            warped_origin=(Ts_world_lidar[:-1, :3, 3] - local).T,
            R_out=np.moveaxis(T_world_lidar[:3, :3].T @ Rs[:-1], 0, 2),
            t_out=T_world_lidar[:3, :3].T @ offset[:-1].T,
        ),
        base,
        T_world_lidar,
    )


def _beams(sensor: Sensor, unit: SensorUnit) -> Beams:
    # Blocks of rings that look to similar heights are culled apart.
    shape = (-1, math.gcd(len(sensor.elevations_deg), 16))
    elevation = np.deg2rad(np.array(sensor.elevations_deg)) + unit.elevation_error
    errors = unit.azimuth_error.reshape(shape), unit.range_offset.reshape(shape)
    return Beams(elevation.reshape(shape), *errors, unit.blind)


def _find_work(
    scene: Scene, stamp_s: float, base: np.ndarray, columns: Columns, beams: Beams, sensor: Sensor
) -> tuple[Primitives, Table, Work]:
    """The primitives in reach, their table and the work items."""
    moved = scene.primitives.center.copy()
    moved[:, :2] += stamp_s * scene.primitives.velocity - base
    primitives = scene.primitives._replace(center=moved)
    origin = np.array([0.0, 0.0, columns.origin[2].mean()])
    primitives = take(primitives, cull.near(primitives, origin, sensor.max_range_m))
    primitives = cull.sort_by_shape(primitives)
    wedges = cull.make_wedges(columns.origin.T, np.moveaxis(columns.R_flat_lidar, 2, 0), columns.azimuth, np.asarray(beams.elevation))
    work = cull.find_work(
        primitives,
        origin,
        wedges,
        cull.group_starts(sensor.num_columns),
        slack_s=0.5 * sensor.period_s,
        travel=float(np.abs(columns.origin[:2]).max()),
    )
    return primitives, cull.make_table(primitives), work


def _compact(measured: Measured, primitives: Primitives, times: np.ndarray, T_world_lidar: np.ndarray) -> SimulatedScan:
    keep = measured.keep.reshape(-1)
    index = measured.primitive.reshape(-1)[keep]

    def lookup(field, ground_value):
        return np.where(index < 0, ground_value, np.append(field, [ground_value])[index])

    return SimulatedScan(
        points=np.ascontiguousarray(measured.points.reshape(3, -1)[:, keep].T),
        times_s=np.broadcast_to(times, measured.keep.shape).reshape(-1)[keep],
        normals=np.ascontiguousarray(measured.normals.reshape(3, -1)[:, keep].T),
        object_ids=lookup(primitives.object_id, 0).astype(np.int32),
        labels=lookup(primitives.label, 0).astype(np.int32),
        moving=lookup(np.any(primitives.velocity != 0.0, axis=1), False).astype(bool),
        T_world_lidar=T_world_lidar,
    )
