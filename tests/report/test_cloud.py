import gtsam
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from delo_jax.data.fields import RawScan
from delo_jax.report.cloud import DriveCloud


def poses(num):
    Ts = np.tile(np.eye(4), (num, 1, 1))
    Ts[:, :3, :3] = Rotation.from_euler("z", 0.05 * np.arange(num)[:, None]).as_matrix()
    Ts[:, 0, 3] = np.arange(num)
    return Ts


def walls(rng, num):
    """Points on two walls beside the sensor."""
    points = rng.uniform([-30.0, -1.0, -2.0], [30.0, 1.0, 4.0], size=(num, 3))
    points[:, 1] = np.where(points[:, 1] > 0, 8.0, -8.0)
    return points.astype(np.float32)


def test_one_point_per_voxel_the_first():
    """Oracle: a dictionary of voxels, filled point by point; a few voxels may share a slot of the table."""
    rng, cloud = np.random.default_rng(0), DriveCloud(voxel_m=1.0, range_m=(0.0, 100.0))
    first: dict[tuple, np.ndarray] = {}
    for number in range(3):
        points = walls(rng, 800)
        cloud.add(number, points, np.eye(4))
        for point in points:
            first.setdefault(tuple(np.floor(point)), point)
    placed = cloud.placed(poses(1)[[0, 0, 0]])
    assert 0.97 * len(first) <= len(placed.points) <= len(first)
    distances, _ = cKDTree(np.array(list(first.values()))).query(placed.points)
    np.testing.assert_array_equal(distances, 0.0)
    np.testing.assert_array_equal(placed.heights, placed.points[:, 2])


def test_points_follow_the_poses_of_their_frames():
    """Oracle: each scan placed by SciPy at the other poses; frames that are gone take their points along."""
    rng, cloud, Ts = np.random.default_rng(1), DriveCloud(voxel_m=0.1, range_m=(0.0, 100.0)), poses(4)
    moved = Ts.copy()
    moved[:, :3, 3] += [[5.0, -3.0, 0.5]]
    scans = [walls(rng, 200) for _ in Ts]
    for number, (scan, T) in enumerate(zip(scans, Ts, strict=True)):
        cloud.add(number, scan, T)
    expected = np.concatenate([Rotation.from_matrix(T[:3, :3]).apply(scan) + T[:3, 3] for scan, T in zip(scans, moved, strict=True)])
    found = cloud.placed(moved)
    distances, _ = cKDTree(expected).query(found.points)
    assert len(found.points) > 700
    assert distances.max() < 1e-5  # float32 on the way
    assert len(cloud.placed(moved[:2]).points) <= 400


@pytest.mark.parametrize("max_points", [100, 1000])
def test_memory_is_bounded_and_the_whole_drive_is_kept(max_points):
    """Oracle: the count at every frame, and the stretch that was driven."""
    rng, cloud, Ts = np.random.default_rng(2), DriveCloud(max_points=max_points), poses(150)
    Ts[:, :3, :3] = np.eye(3)
    for number, T in enumerate(Ts):
        cloud.add(number, walls(rng, 300), T)
        assert len(cloud) <= 2 * max_points
    points = cloud.placed(Ts).points
    assert 0.4 * max_points < len(points) <= max_points
    assert np.ptp(points[:, 0]) > 190.0  # of 149 m and 30 m of sight to either side


def test_unusable_points_are_left_out():
    """Oracle: by hand: NaN, infinity, the vehicle itself, and what is out of range."""
    points = np.array([[np.nan, 0, 0], [np.inf, 1, 1], [3e38, 3e38, 0], [0, 0, 0], [500, 0, 0], [10, 0, 0]], np.float32)
    cloud = DriveCloud()
    cloud.add(0, points, np.eye(4))
    cloud.add(1, points[:0], np.eye(4))
    np.testing.assert_allclose(cloud.placed(poses(2)).points, [[10.0, 0.0, 0.0]])


def test_a_scan_a_metre():
    """Oracle: by hand: scans every 40 cm, of which the first, the fourth (1.2 m on) and the seventh count, and a turn on the spot."""
    rng, cloud = np.random.default_rng(3), DriveCloud(voxel_m=1e-3, range_m=(0.0, 100.0))
    Ts = np.tile(np.eye(4), (8, 1, 1))
    Ts[:7, 0, 3], Ts[7] = 0.4 * np.arange(7), Ts[6]
    Ts[7, :3, :3] = Rotation.from_euler("z", 6.0, degrees=True).as_matrix()
    counts = []
    for number, T in enumerate(Ts):
        before = len(cloud)
        cloud.add_scan(number, T, RawScan(points=walls(rng, 50), times=None))
        counts.append(len(cloud) - before)
    assert [count > 0 for count in counts] == [True, False, False, True, False, False, True, True]


def test_raw_scans_are_de_skewed_where_their_velocity_is_known():
    """Oracle: points that stand still in the world, seen from poses on the way by gtsam's exponential map."""
    rng, velocity = np.random.default_rng(0), np.array([0.0, 0.1, 0.6, 15.0, 0.3, 0.0])
    world, times = walls(rng, 3000), rng.uniform(-0.05, 0.05, 3000)
    measured = [gtsam.Pose3.Expmap(velocity * t).inverse().matrix() @ np.r_[point, 1.0] for point, t in zip(world, times, strict=True)]
    scan = RawScan(points=np.array(measured, np.float32)[:, :3], times=times)
    errors = []
    for known in (None, velocity):
        cloud = DriveCloud(voxel_m=0.01, range_m=(0.0, 100.0))
        cloud.add_scan(0, np.eye(4), scan, known)
        distances, _ = cKDTree(world).query(cloud.placed(np.eye(4)[None]).points)
        errors.append(np.quantile(distances, 0.9))
    assert errors[0] > 0.15
    assert errors[1] < 0.01
