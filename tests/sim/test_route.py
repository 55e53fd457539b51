"""Drives along a given path."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from delo_jax.errors import DeloError
from delo_jax.geometry import se3
from delo_jax.sim import SENSORS, simulate_route
from delo_jax.sim.primitives import Label

SENSOR = dataclasses.replace(SENSORS["hdl64e"], num_columns=512)
RADIUS_M, SPEED = 12.0, 8.0


def around_the_block(num):
    """Poses that drive 20 m, turn left by 90 deg on a circle, and go on, at 8 m/s, rolling by 1 deg up and down."""
    s = 0.1 * SPEED * np.arange(num)
    angle = np.clip((s - 20.0) / RADIUS_M, 0.0, 0.5 * np.pi)
    after = np.maximum(s - 20.0 - 0.5 * np.pi * RADIUS_M, 0.0)
    x, y = np.minimum(s, 20.0) + RADIUS_M * np.sin(angle), RADIUS_M * (1.0 - np.cos(angle)) + after
    roll = np.radians(1.0) * np.sin(2.0 * np.pi * 0.1 * np.arange(num))
    Ts = np.tile(np.eye(4), (num, 1, 1))
    Ts[:, :3, :3] = Rotation.from_euler("ZYX", np.column_stack([angle, 0.0 * s, roll])).as_matrix()
    Ts[:, 0, 3], Ts[:, 1, 3] = x, y
    return Ts


@pytest.fixture(scope="module")
def drive():
    """Compensated scans of it."""
    route = around_the_block(70)
    return route, list(simulate_route(route, "urban", 3, sensor=SENSOR))


def test_the_truth_follows_the_route(drive):
    """Oracle: the route's own motions in the plane, but where the turn begins and ends, which no vehicle does at once; its roll."""
    route, scans = drive
    Ts = np.stack([scan.T_world_lidar for scan in scans])
    assert len(Ts) == len(route)
    moved, wanted = (se3.inverse(T[:-5]) @ T[5:] for T in (Ts, route))
    np.testing.assert_allclose(moved[:, :2, 3], wanted[:, :2, 3], atol=0.12)
    turned, asked = (np.arctan2(T[:, 1, 0], T[:, 0, 0]) for T in (moved, wanted))
    np.testing.assert_allclose(turned, asked, atol=0.03)
    roll = np.arctan2(Ts[5:-5, 2, 1], Ts[5:-5, 2, 2])
    correlation = np.corrcoef(roll, np.arctan2(route[5:-5, 2, 1], route[5:-5, 2, 2]))[0, 1]
    assert correlation > 0.7


def test_the_world_stands_still(drive):
    """Oracle: what stands is met again where it was, to the noise of the range, over a turn of 90 deg; the way ahead is free."""
    _, scans = drive
    first, later = scans[20], scans[26]
    clouds = []
    for scan in (first, later):
        static = ~scan.moving & np.isin(scan.labels, [Label.BUILDING, Label.WALL, Label.FENCE, Label.POLE])
        T = scan.T_world_lidar
        clouds.append((scan.points[static] @ T[:3, :3].T + T[:3, 3], scan.normals[static] @ T[:3, :3].T))
    (points, normals), (others, other_normals) = clouds
    assert min(len(points), len(others)) > 300
    near, place = cKDTree(points).query(others, distance_upper_bound=0.5)
    found = np.isfinite(near)
    found[found] &= np.sum(normals[place[found]] * other_normals[found], axis=1) > 0.98
    offsets = np.sum((others[found] - points[place[found]]) * other_normals[found], axis=1)
    assert found.sum() > 100
    assert np.median(np.abs(offsets)) < 0.05
    for scan in scans[::10]:
        solid = scan.points[~np.isin(scan.labels, [Label.GROUND, Label.KERB])]
        ahead = (np.abs(solid[:, 1]) < 1.0) & (solid[:, 0] > 0) & (solid[:, 0] < 4.0) & (solid[:, 2] < 0.5)
        assert ahead.sum() < 5


def test_a_place_is_the_same_when_one_comes_back():
    """Oracle: two rounds on one circle: the second one meets the walls of the first."""
    angle = 2.0 * np.pi * np.arange(150) / 75.0
    Ts = np.tile(np.eye(4), (150, 1, 1))
    Ts[:, :3, :3] = Rotation.from_euler("z", (angle + 0.5 * np.pi)[:, None]).as_matrix()
    Ts[:, :2, 3] = 10.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    scans = {k: scan for k, scan in enumerate(simulate_route(Ts, "urban", 5, sensor=SENSOR)) if k in (20, 95)}
    walls = []
    for scan in scans.values():
        static = np.isin(scan.labels, [Label.BUILDING, Label.WALL, Label.FENCE])
        walls.append(scan.points[static] @ scan.T_world_lidar[:3, :3].T + scan.T_world_lidar[:3, 3])
    distance, _ = cKDTree(walls[0]).query(walls[1])
    assert len(walls[1]) > 300
    assert np.mean(distance < 0.5) > 0.8


def test_it_is_a_function_of_its_arguments():
    """Oracle: equality of two runs, and another seed."""
    route = around_the_block(9)
    first, again, other = (next(simulate_route(route, "road", seed, sensor=SENSOR, rolling_shutter=True)) for seed in (2, 2, 3))
    assert all(a.tobytes() == b.tobytes() for a, b in zip(first, again, strict=True))
    assert first.points.tobytes() != other.points.tobytes()


def test_a_vehicle_that_stands_is_scanned():
    """Oracle: a pose that never changes."""
    Ts = np.tile(np.eye(4), (9, 1, 1))
    scans = list(simulate_route(Ts, "mixed", 1, sensor=SENSOR))
    for scan in scans[1:]:
        np.testing.assert_allclose(scan.T_world_lidar, scans[0].T_world_lidar, atol=1e-9)
    assert len(scans[0].points) > 3000


def test_too_few_poses():
    """Oracle: the sentence."""
    with pytest.raises(DeloError, match="Ts_world_lidar: expected 9 poses or more, got 3"):
        next(simulate_route(np.tile(np.eye(4), (3, 1, 1)), "urban", 0))
