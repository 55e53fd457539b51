"""Scans against their own truth: rigidity, time, normals, noise, labels."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.spatial import cKDTree

from delo_jax.errors import ConfigError
from delo_jax.sim import KINDS, SENSORS, clear_path, draw_unit, make_motion, make_scene, pose_at, simulate_scan
from delo_jax.sim.primitives import Builder, Label, Shape
from delo_jax.sim.scenes import CLEARANCE_M, Ground, Scene
from delo_jax.sim.warp import flat_warp, warp_poses

SENSOR = dataclasses.replace(SENSORS["hdl64e"], num_columns=512)


def solid(scene):
    """The scene without soft, transparent or moving things, on a smooth ground."""
    p = scene.primitives
    keep = (p.softness == 0.0) & (p.opacity == 1.0) & ~np.any(p.velocity != 0.0, axis=1)
    ground = scene.ground._replace(grass_height=0.0)
    return scene._replace(primitives=type(p)(*(field[keep] for field in p)), ground=ground)


def scan_pair(kind, seed, *, rolling_shutter, sensor=SENSOR):
    scene, motion = solid(make_scene(kind, seed)), make_motion(seed + 1, 1.0, turning=True, start_x=60.0)
    scene = clear_path(scene, motion)
    return (
        motion,
        scene,
        [
            simulate_scan(scene, motion, stamp, sensor, jax.random.PRNGKey(k), rolling_shutter=rolling_shutter, noise=False)
            for k, stamp in enumerate((0.0, 0.2))
        ],
    )


def to_world(scan, points=None):
    points = scan.points if points is None else points
    return points.astype(np.float64) @ scan.T_world_lidar[:3, :3].T + scan.T_world_lidar[:3, 3]


def plane_distances(source, target):
    """Distances of the source's points from the target's planes, where both saw the same surface."""
    points, reference = to_world(source), to_world(target)
    normals = target.normals.astype(np.float64) @ target.T_world_lidar[:3, :3].T
    gap, index = cKDTree(reference).query(points, distance_upper_bound=0.1)
    near = np.isfinite(gap)
    index = index[near]
    own = source.normals.astype(np.float64)[near] @ source.T_world_lidar[:3, :3].T
    same = (source.object_ids[near] == target.object_ids[index]) & (np.sum(own * normals[index], axis=1) > 0.9)
    return np.abs(np.sum((points[near] - reference[index]) * normals[index], axis=1))[same]


@pytest.mark.parametrize("kind", ["urban", "open"])
def test_true_poses_register_scans(kind):
    """Oracle: rigidity of the world; distance to the nearest plane of the other scan, by cKDTree."""
    _, _, (source, target) = scan_pair(kind, 4, rolling_shutter=False)
    distances = plane_distances(source, target)
    assert len(distances) > 3000
    # 10 cm apart, a curved ground leaves its tangent plane by millimetres; road grain is another 4.
    assert np.median(distances) < 0.006
    assert np.percentile(distances, 95) < 0.02


def test_rolling_shutter_is_undone_by_the_motion():
    """Oracle: the compensated scan; each point is moved by the vehicle's true pose at its own time."""
    motion, scene, (raw, _) = scan_pair("mixed", 5, rolling_shutter=True)
    _, _, (compensated, _) = scan_pair("mixed", 5, rolling_shutter=False)
    poses = warp_poses(scene.warp, pose_at(motion, raw.times_s, SENSOR.height_m))
    world = np.einsum("nij,nj->ni", poses[:, :3, :3], raw.points) + poses[:, :3, 3]
    np.testing.assert_allclose(world, to_world(compensated), atol=2e-3)
    assert np.abs(raw.points - compensated.points).max() > 0.05
    assert not compensated.times_s.any()


def test_sweep_runs_clockwise_from_behind():
    """Oracle: time = -azimuth / (2 pi) * period, where the warp is flat."""
    scene = make_scene("urban", 1)._replace(warp=flat_warp())
    motion = make_motion(1, 0.3, start_x=60.0)
    scan = simulate_scan(scene, motion, 0.0, SENSOR, jax.random.PRNGKey(0), rolling_shutter=True, noise=False)
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    np.testing.assert_allclose(scan.times_s, -azimuth / (2.0 * np.pi) * SENSOR.period_s, atol=1e-6)
    rings = np.split(np.mod(azimuth, 2.0 * np.pi), np.flatnonzero(np.diff(np.mod(azimuth, 2.0 * np.pi)) < -3.0) + 1)
    assert len(rings) == 64


@pytest.mark.parametrize("kind", KINDS)
def test_plausible_scan(kind):
    """Oracle: what a real scanner of this kind returns: share of rays, ground below, unit normals towards it."""
    scene, motion = make_scene(kind, 2), make_motion(2, 0.3, start_x=60.0)
    scan = simulate_scan(scene, motion, 0.0, SENSOR, jax.random.PRNGKey(0), rolling_shutter=True)
    assert 0.6 < len(scan.points) / (64 * 512) < 0.99
    distance = np.linalg.norm(scan.points, axis=1)
    assert distance.min() >= SENSOR.min_range_m - 0.1
    assert distance.max() <= SENSOR.max_range_m + 0.1
    assert np.mean(distance < 20.0) > 0.6
    near_ground = scan.points[(scan.labels == Label.GROUND) & (distance < 8.0)]
    assert np.abs(np.median(near_ground[:, 2]) + SENSOR.height_m) < 0.1
    np.testing.assert_allclose(np.linalg.norm(scan.normals, axis=1), 1.0, atol=1e-5)
    assert np.all(np.sum(scan.normals * scan.points, axis=1) < 0.01 * distance)
    np.testing.assert_array_equal(scan.object_ids == 0, scan.labels == Label.GROUND)
    assert not scan.moving[scan.object_ids == 0].any()
    if kind == "open":
        assert not np.any(scan.labels == Label.BUILDING)
        assert not np.any(scene.primitives.label == Label.BUILDING)


def wall_scene(velocity=(0.0, 0.0)):
    builder = Builder(np.random.default_rng(0))
    builder.begin(Label.WALL, 10.0, 0.0, velocity=velocity)
    builder.box((0.0, 1.0), (-30.0, 30.0), (0.0, 20.0))
    return Scene(builder.build(), Ground(1e3, -1e3, 0.0, 0.2, 0.2), flat_warp())


def standing(duration_s=0.6):
    motion = make_motion(0, duration_s)
    return motion._replace(**{name: 0.0 * getattr(motion, name) for name in ("position", "heading", "roll", "pitch", "heave")})


def test_range_noise():
    """Oracle: the stated standard deviation, on a wall at 10 m."""
    scan = simulate_scan(wall_scene(), standing(), 0.0, SENSOR, jax.random.PRNGKey(1), rolling_shutter=True)
    wall = scan.points[scan.object_ids == 1]
    ranges = np.linalg.norm(wall, axis=1)
    # A point's own x carries the noise: x = 10 + error * cos, so the error is (x - 10) / cos.
    error = (wall[:, 0] - 10.0) * ranges / wall[:, 0]
    assert np.std(error) == pytest.approx(SENSOR.range_noise_m, rel=0.05)
    assert abs(np.mean(error)) < 0.002


def test_moving_objects_move():
    """Oracle: velocity times time between two stamps, on a wall that comes closer."""
    scene, motion = wall_scene(velocity=(-5.0, 0.0)), standing()
    scans = [simulate_scan(scene, motion, stamp, SENSOR, jax.random.PRNGKey(0), rolling_shutter=True, noise=False) for stamp in (0.0, 0.4)]
    for scan, distance in zip(scans, (10.0, 8.0), strict=True):
        wall = scan.object_ids == 1
        assert scan.moving[wall].all()
        assert not scan.moving[~wall].any()
        np.testing.assert_allclose(scan.points[wall, 0], distance - 5.0 * scan.times_s[wall], atol=1e-3)


def test_unit_errors_are_constant():
    """Oracle: the drawn range offsets, on the ground seen by a standing sensor."""
    unit = draw_unit(SENSOR, 3)
    unit = unit._replace(elevation_error=0.0 * unit.elevation_error, azimuth_error=0.0 * unit.azimuth_error)
    unit = unit._replace(blind=unit.blind * np.array([1.0, 0.0, 1.0]))
    arguments = wall_scene(), standing(), 0.0, SENSOR, jax.random.PRNGKey(0)
    plain = simulate_scan(*arguments, rolling_shutter=True, noise=False)
    offset = simulate_scan(*arguments, rolling_shutter=True, noise=False, unit=unit)
    assert len(plain.points) == len(offset.points)
    error = np.linalg.norm(offset.points, axis=1) - np.linalg.norm(plain.points, axis=1)
    elevation = np.rad2deg(np.arcsin(plain.points[:, 2] / np.linalg.norm(plain.points, axis=1)))
    ring = np.abs(elevation[:, None] - np.array(SENSOR.elevations_deg)[None]).argmin(axis=1)
    np.testing.assert_allclose(error, unit.range_offset[ring], atol=1e-4)


def test_ground_fades_and_dropout():
    """Oracle: most road beyond 60 m is lost, almost all of it near by is kept."""
    scene = wall_scene()._replace(primitives=make_scene("open", 0).primitives)
    empty = scene._replace(primitives=type(scene.primitives)(*(field[:1] for field in scene.primitives)))
    scan = simulate_scan(empty, standing(), 0.0, SENSOR, jax.random.PRNGKey(0), rolling_shutter=True)
    clean = simulate_scan(empty, standing(), 0.0, SENSOR, jax.random.PRNGKey(0), rolling_shutter=True, noise=False)
    near, far = (
        [np.sum((lo < r) & (r < hi)) for r in (np.linalg.norm(s.points, axis=1) for s in (scan, clean))]
        for lo, hi in ((4.0, 20.0), (60.0, 79.0))
    )
    assert near[0] / near[1] == pytest.approx(0.97, abs=0.01)
    assert far[0] < 0.3 * far[1]


def test_same_arguments_same_bytes():
    """Oracle: equality, and difference under another key."""
    scene, motion = make_scene("residential", 1), make_motion(1, 0.3, start_x=60.0)
    runs = [
        simulate_scan(scene, motion, 0.0, SENSOR, jax.random.PRNGKey(key), rolling_shutter=True, unit=draw_unit(SENSOR, 1))
        for key in (0, 0, 1)
    ]
    for first, second in zip(runs[0], runs[1], strict=True):
        assert first.tobytes() == second.tobytes()
    assert runs[0].points.tobytes() != runs[2].points.tobytes()


@pytest.mark.parametrize("seed", range(3))
def test_path_is_cleared(seed):
    """Oracle: distances from the path to sampled outlines of what stands near it, in float64."""
    scene, motion = make_scene("urban", seed), make_motion(seed, 0.6, turning=True, start_x=60.0)
    cleared = clear_path(scene, motion)
    assert len(cleared.primitives.shape) > 0.5 * len(scene.primitives.shape)
    p = cleared.primitives
    low = (p.center[:, 2] + p.half_size[:, 2] > 0.3) & (p.center[:, 2] - p.half_size[:, 2] < 2.8)
    still = low & ~np.any(p.velocity != 0.0, axis=1) & (p.shape == Shape.BOX)
    ring = np.concatenate([np.stack([np.linspace(-1, 1, 40), s * np.ones(40)], 1) for s in (-1, 1)])
    ring = np.concatenate([ring, ring[:, ::-1]])
    for center, half, yaw in zip(p.center[still], p.half_size[still], p.yaw[still], strict=True):
        x, y = (ring * half[:2]).T
        outline = center[:2] + np.stack([np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y], 1)
        gaps = np.linalg.norm(outline[None] - motion.position[::5, None], axis=2)
        assert gaps.min() > CLEARANCE_M - 0.01


def test_bad_requests():
    """Oracle: the messages name field, expectation and what was given."""
    with pytest.raises(ConfigError, match="kind: expected one of urban, .*, got 'moon'"):
        make_scene("moon", 0)
    with pytest.raises(ConfigError, match="num_columns: expected at least 16, got 3"):
        dataclasses.replace(SENSOR, num_columns=3)
