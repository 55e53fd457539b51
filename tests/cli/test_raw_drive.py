"""A KITTI raw drive through `delo run`, from its files to a trajectory beside its truth."""

import itertools
import json

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from delo_jax.data import open_dataset
from delo_jax.sim import simulate_drive
from tests.data.test_kitti_raw import R_RECT, T_CAM_VELO, T_VELO_IMU, packet, pose, write_calib, write_timestamps

NUM_SCANS, SEED = 8, 3  # 12 m/s


def write_drive(root):
    """A simulated drive as KITTI stores a raw one: scans as measured, packets up to 10 ms off them. Returns folder and true poses."""
    scans = list(itertools.islice(simulate_drive("urban", SEED, NUM_SCANS, rolling_shutter=True), NUM_SCANS))
    Ts_world_imu = np.stack([scan.T_world_lidar for scan in scans]) @ T_VELO_IMU
    day = root / "2011_09_26"
    drive = day / "2011_09_26_drive_0001_sync"
    for folder in ("velodyne_points/data", "oxts/data"):
        (drive / folder).mkdir(parents=True)
    scan_times = 0.1 * np.arange(NUM_SCANS)
    packet_times = np.clip(scan_times + np.random.default_rng(0).uniform(-0.01, 0.01, NUM_SCANS), 0.0, scan_times[-1])
    turned = Slerp(scan_times, Rotation.from_matrix(Ts_world_imu[:, :3, :3]))(packet_times).as_matrix()
    moved = np.stack([np.interp(packet_times, scan_times, axis) for axis in Ts_world_imu[:, :3, 3].T], axis=1)
    packets = [pose(R, t) for R, t in zip(turned, moved, strict=True)]
    write_timestamps(drive / "velodyne_points/timestamps.txt", scan_times)
    write_timestamps(drive / "oxts/timestamps.txt", packet_times)
    for i, (scan, T) in enumerate(zip(scans, packets, strict=True)):
        (drive / f"oxts/data/{i:010d}.txt").write_text(packet(T, packets[0]))
        np.column_stack([scan.points, np.zeros(len(scan.points))]).astype("<f4").tofile(drive / f"velodyne_points/data/{i:010d}.bin")
    write_calib(day / "calib_imu_to_velo.txt", T_VELO_IMU)
    write_calib(day / "calib_velo_to_cam.txt", T_CAM_VELO)
    (day / "calib_cam_to_cam.txt").write_text("R_rect_00: " + " ".join(map(str, R_RECT.ravel())) + "\n")
    return drive, np.stack([scan.T_world_lidar for scan in scans])


def test_raw_drive_from_files_to_trajectory(cli, tmp_path):
    """Oracle: the simulator's poses. Released weights; a step is 1.2 m long and within 3 cm, the truth in the files within 1 cm."""
    drive, Ts_world_lidar = write_drive(tmp_path)
    out = tmp_path / "out"
    done = cli("run", drive, "--out", out, "--no-elevation-correction", "--weights", "delo-base")
    assert done.code == 0
    assert "KITTI raw" in done.out
    sensor = json.loads((out / "run.json").read_text())["sensor"]
    assert (sensor["motion_compensated"], sensor["point_times"], sensor["deskew"][:4]) == (False, "azimuth", "done")
    first = np.linalg.inv(Ts_world_lidar[0])
    np.testing.assert_allclose(open_dataset(drive).truth[:, :3, 3], (first @ Ts_world_lidar)[:, :3, 3], atol=0.01)
    T_cam_lidar = pose(R_RECT, np.zeros(3)) @ T_CAM_VELO
    rows = np.loadtxt(out / "poses_kitti.txt").reshape(-1, 3, 4)
    found = np.linalg.inv(T_cam_lidar) @ np.concatenate([rows, np.tile([[[0, 0, 0, 1]]], (len(rows), 1, 1))], axis=1) @ T_cam_lidar
    steps, true = (np.linalg.inv(Ts[:-1]) @ Ts[1:] for Ts in (found, Ts_world_lidar))
    assert np.linalg.norm((np.linalg.inv(true) @ steps)[:, :3, 3], axis=1).max() < 0.03
    assert cli("eval", out).code == 0
