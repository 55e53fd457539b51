import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from delo_jax.data.dataset import open_dataset
from delo_jax.data.writers import KittiTreeWriter, write_bin
from delo_jax.errors import DatasetError, ScanError


def drive(count):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", 5 * np.arange(count)[:, None], degrees=True).as_matrix()
    poses[:, :3, 3] = np.stack([np.arange(count), 0.1 * np.arange(count), np.zeros(count)], axis=1) + [100, 50, 2]
    return poses


def test_bin_rows(tmp_path):
    """Oracle: numpy's fromfile; a missing reflectance is 0."""
    points = np.random.default_rng(0).normal(0, 10, (30, 4))
    write_bin(tmp_path / "4.bin", points)
    write_bin(tmp_path / "3.bin", points[:, :3])
    np.testing.assert_array_equal(np.fromfile(tmp_path / "4.bin", "<f4").reshape(-1, 4), points.astype(np.float32))
    np.testing.assert_array_equal(np.fromfile(tmp_path / "3.bin", "<f4").reshape(-1, 4)[:, 3], 0)
    with pytest.raises(ScanError, match=r"\(30, 2\)"):
        write_bin(tmp_path / "2.bin", points[:, :2])


def test_tree_in_kittis_own_terms(tmp_path):
    """Oracle: numpy's text reader and KITTI's definition, row i = Tr T_first_lidar inv(Tr), for a world whose origin is far away."""
    poses, points = drive(3), np.random.default_rng(0).normal(0, 10, (40, 3))
    with KittiTreeWriter(tmp_path, "07") as writer:
        for i, T in enumerate(poses):
            writer.append(points + i, T, stamp_ns=10**18 + i * 103_000_001)
    calib = dict(line.split(":") for line in (tmp_path / "sequences/07/calib.txt").read_text().splitlines())
    Tr = np.vstack([np.array(calib["Tr"].split(), float).reshape(3, 4), [0, 0, 0, 1]])
    np.testing.assert_allclose(Tr[:3, :3] @ [1, 0, 0], [0, 0, 1])  # ahead is the camera's z
    np.testing.assert_allclose(Tr[:3, :3] @ [0, 0, 1], [0, -1, 0])  # up is its -y
    rows = np.loadtxt(tmp_path / "poses/07.txt").reshape(3, 3, 4)
    for T, row in zip(poses, rows, strict=True):
        np.testing.assert_allclose(row, (Tr @ np.linalg.solve(poses[0], T) @ np.linalg.inv(Tr))[:3], atol=1e-11)
    np.testing.assert_allclose(np.loadtxt(tmp_path / "sequences/07/times.txt"), [0, 0.103000001, 0.206000002], atol=1e-12)
    np.testing.assert_array_equal(
        np.fromfile(tmp_path / "sequences/07/velodyne/000002.bin", "<f4").reshape(-1, 4)[:, :3], (points + 2).astype(np.float32)
    )


def test_tree_is_read_back_uncorrected(tmp_path):
    """Oracle: what went in; the tree says that its scans need no elevation correction and are not compensated."""
    poses, points = drive(4), np.random.default_rng(0).normal(0, 10, (40, 3)).astype(np.float32)
    T_cam_lidar = np.eye(4)
    T_cam_lidar[:3, :3], T_cam_lidar[:3, 3] = Rotation.from_euler("xyz", [80, 5, -88], degrees=True).as_matrix(), [0.1, -0.2, 0.3]
    with KittiTreeWriter(tmp_path, "sim", T_cam_lidar=T_cam_lidar, motion_compensated=False) as writer:
        for T in poses:
            writer.append(points, T)
        dataset = open_dataset(tmp_path)  # on disk before the writer is closed
    np.testing.assert_allclose(dataset.truth, np.linalg.inv(poses[0]) @ poses, atol=1e-10)
    np.testing.assert_allclose(dataset.T_cam_lidar, T_cam_lidar, atol=1e-12)
    np.testing.assert_array_equal(dataset.stamps_ns, np.arange(4) * 100_000_000)
    np.testing.assert_array_equal(dataset[3].points, points)
    assert dataset.elevation_correction_deg == 0.0
    assert dataset.compensated is False


@pytest.mark.parametrize("victim", ["write_bin", "format_kitti_pose", "format_seconds"])
def test_a_killed_run_leaves_a_tree_that_is_read(tmp_path, monkeypatch, victim):
    """Oracle: the scans before the one in which the process ends; nothing is cleaned up, the last rows may have no scan."""
    writer = KittiTreeWriter(tmp_path, "00")
    for i in range(3):
        writer.append(np.ones((5, 3)) + i, np.eye(4))

    def kill(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"delo_jax.data.writers.{victim}", kill)
    with pytest.raises(KeyboardInterrupt):
        writer.append(np.ones((5, 3)), np.eye(4))
    dataset = open_dataset(tmp_path)
    assert (len(dataset), len(dataset.stamps_ns), len(dataset.truth), dataset.notes) == (3, 3, 3, ())
    writer.__exit__()


def test_existing_sequence_and_unwritable_folder_are_refused(tmp_path):
    """Oracle: one sentence each; the first tree is left as it was."""
    with KittiTreeWriter(tmp_path, "00") as writer:
        writer.append(np.ones((5, 3)), np.eye(4))
    with pytest.raises(DatasetError, match="expected a new sequence"):
        KittiTreeWriter(tmp_path, "00")
    assert len(open_dataset(tmp_path)) == 1
    (tmp_path / "file").touch()
    with pytest.raises(DatasetError, match="expected a folder to write to"):
        KittiTreeWriter(tmp_path / "file", "00")
