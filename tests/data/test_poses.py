import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from delo_jax.data.poses import (
    camera_to_lidar,
    format_seconds,
    lidar_to_camera,
    parse_seconds,
    read_kitti_poses,
    read_times,
    read_tum,
    write_kitti_poses,
    write_tum,
)
from delo_jax.errors import DatasetError


def random_poses(count, seed=0):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(seed).normal(0, 100, (count, 3))
    return poses


def test_kitti_file_holds_the_upper_rows(tmp_path):
    """Oracle: numpy's own text reader; 13 digits are written."""
    poses = random_poses(5)
    write_kitti_poses(tmp_path / "00.txt", poses)
    np.testing.assert_allclose(np.loadtxt(tmp_path / "00.txt"), poses[:, :3].reshape(5, 12), rtol=1e-12)
    np.testing.assert_allclose(read_kitti_poses(tmp_path / "00.txt"), poses, rtol=1e-12)


def test_tum_file_holds_seconds_position_and_xyzw(tmp_path):
    """Oracle: scipy's rotation from numpy's own text reader; stamps exact in integers, positions to the nanometre."""
    poses, stamps_ns = random_poses(5), 1_317_013_364_326_110_540 + np.arange(5) * 103_456_789
    write_tum(tmp_path / "t.tum", stamps_ns, poses)
    rows = np.loadtxt(tmp_path / "t.tum")
    np.testing.assert_allclose(rows[:, 1:4], poses[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(Rotation.from_quat(rows[:, 4:]).as_matrix(), poses[:, :3, :3], atol=1e-8)
    (tmp_path / "t.tum").write_text("# stamp x y z qx qy qz qw\n\n" + (tmp_path / "t.tum").read_text())
    read_ns, read_poses = read_tum(tmp_path / "t.tum")
    np.testing.assert_array_equal(read_ns, stamps_ns)
    np.testing.assert_allclose(read_poses, poses, atol=1e-8)


def test_seconds_are_exact():
    """Oracle: integers; a float64 of an epoch is good to 240 ns only."""
    for stamp_ns in (0, 1, -1, 103_614_000, -2_500_000_001, 1_317_013_364_326_110_540):
        assert parse_seconds(format_seconds(stamp_ns), "here") == stamp_ns
    assert parse_seconds("1.036140e-01", "here") == 103_614_000


def test_camera_and_lidar_frames():
    """Oracle: a point fixed in the world, seen by both: T_cam_lidar takes its lidar coordinates to those of the camera."""
    T_cam_lidar, poses = random_poses(1, seed=1)[0], random_poses(4, seed=2)
    poses[0] = np.eye(4)
    in_first_lidar = np.array([3.0, -2.0, 1.0, 1.0])
    in_first_cam = T_cam_lidar @ in_first_lidar
    cam_poses = lidar_to_camera(poses, T_cam_lidar)
    for T_lidar, T_cam in zip(poses, cam_poses, strict=True):
        in_lidar, in_cam = np.linalg.solve(T_lidar, in_first_lidar), np.linalg.solve(T_cam, in_first_cam)
        np.testing.assert_allclose(in_cam, T_cam_lidar @ in_lidar, atol=1e-9)
    np.testing.assert_allclose(camera_to_lidar(cam_poses, T_cam_lidar), poses, atol=1e-9)


@pytest.mark.parametrize(
    ("read", "text", "reason"),
    [
        (read_kitti_poses, "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1\n", "line 2: expected 12 finite numbers"),
        (read_kitti_poses, "1 0 0 0 0 1 0 0 0 0 1 0\n\n1 0 0 nan 0 1 0 0 0 0 1 0\n", "line 3: expected 12 finite numbers"),
        (read_kitti_poses, "1 0 0 0 0 1 0 0 0 0 one 0\n", "line 1: expected 12 finite numbers"),
        (read_kitti_poses, "1 0 0 0 0 1 0 0 0 0 -1 0\n", "line 1: expected a rotation"),
        (read_kitti_poses, "2 0 0 0 0 2 0 0 0 0 2 0\n", "line 1: expected a rotation"),
        (read_kitti_poses, "\n", "empty file"),
        (read_tum, "0 0 0 0 0 0 0 1\n0.1 0 0 0 0 0 0\n", "line 2: expected 8 finite numbers"),
        (read_tum, "0 0 0 0 0 0 0 0\n", "line 1: expected a unit quaternion"),
        (read_times, "0\n1e300\n", "line 2: expected a time"),
        (read_times, "0 1\n", "line 1: expected 1 finite"),
    ],
)
def test_bad_rows(tmp_path, read, text, reason):
    """Oracle: one sentence with the file and the line."""
    (tmp_path / "rows.txt").write_text(text)
    with pytest.raises(DatasetError, match=reason) as caught:
        read(tmp_path / "rows.txt")
    assert str(tmp_path / "rows.txt") in str(caught.value)


def test_missing_and_binary_files(tmp_path):
    """Oracle: one sentence with the reason."""
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DatasetError, match="No such file"):
        read_kitti_poses(tmp_path / "missing.txt")
    with pytest.raises(DatasetError, match="no text"):
        read_kitti_poses(tmp_path / "binary.txt")
