import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from delo_jax.data.dataset import open_dataset
from delo_jax.errors import DatasetError

EARTH = 6378137.0
LATITUDE, LONGITUDE = np.deg2rad([49.011212804408, 8.4228850417969])
SPEED, TURN_RATE = 11.0, 0.08  # m/s, rad/s
START_NS = int(np.datetime64("2011-09-26T13:02:25.951199337", "ns").astype(np.int64))
POINTS = np.random.default_rng(0).normal(0, [10, 10, 1], (40, 3)).astype("<f4")


def pose(R, t):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


T_VELO_IMU = pose(Rotation.from_euler("xyz", [0.3, -0.2, 0.85], degrees=True).as_matrix(), [-0.81, 0.32, -0.8])
T_CAM_VELO = pose(Rotation.from_euler("xyz", [90.5, -0.5, 89.6], degrees=True).as_matrix(), [-0.004, -0.076, -0.272])
R_RECT = Rotation.from_euler("xyz", [0.5, -0.4, 0.3], degrees=True).as_matrix()


def imu(seconds):
    """T_world_imu on a circle, x east, y north, climbing slightly, with a constant roll and a slow pitch."""
    yaw = 0.4 + TURN_RATE * seconds
    east, north = SPEED / TURN_RATE * np.array([np.sin(yaw), -np.cos(yaw)])
    return pose(Rotation.from_euler("xyz", [0.01, 0.02 * np.sin(seconds), yaw]).as_matrix(), [east, north, 116.0 + 0.1 * seconds])


def packet(T, first):
    """The line of an OXTS file for T_world_imu: the inverse of the Mercator plane by the isometric latitude, lat = asin(tanh(q))."""
    scale = EARTH * np.cos(LATITUDE)
    east, north = (T - first)[:2, 3]
    latitude = np.arcsin(np.tanh(np.arctanh(np.sin(LATITUDE)) + north / scale))
    roll, pitch, yaw = Rotation.from_matrix(T[:3, :3]).as_euler("xyz")
    values = [np.rad2deg(latitude), np.rad2deg(LONGITUDE + east / scale), T[2, 3], roll, pitch, yaw]
    return " ".join(f"{value:.14f}" for value in values) + " 0" * 24 + "\n"


def write_timestamps(path, seconds):
    stamps = (START_NS + np.round(np.asarray(seconds) * 1e9).astype(np.int64)).view("datetime64[ns]")
    path.write_text("".join(f"{str(stamp).replace('T', ' ')}\n" for stamp in stamps))


def write_calib(path, T):
    rows = [" ".join(f"{value:.12e}" for value in block.ravel()) for block in (T[:3, :3], T[:3, 3])]
    path.write_text(f"calib_time: 25-May-2012 16:47:16\nR: {rows[0]}\nT: {rows[1]}\n")


def raw_drive(root, *, number=1, num_frames=40, missing=(), offset=0.0):
    """A drive as KITTI has it: packets up to 10 ms off the scans, some scans missing but not their times. Returns folder, scan times."""
    day = root / "2011_09_26"
    drive = day / f"2011_09_26_drive_{number:04d}_sync"
    for folder in ("velodyne_points/data", "oxts/data"):
        (drive / folder).mkdir(parents=True)
    scan_times = 0.1035 * np.arange(num_frames)
    jitter = np.random.default_rng(0).uniform(-0.01, 0.01, num_frames)
    packet_times = scan_times + jitter + offset
    write_timestamps(drive / "velodyne_points/timestamps.txt", scan_times)
    write_timestamps(drive / "oxts/timestamps.txt", packet_times)
    for i, seconds in enumerate(packet_times):
        (drive / f"oxts/data/{i:010d}.txt").write_text(packet(imu(seconds), imu(packet_times[0])))
    kept = [i for i in range(num_frames) if i not in missing]
    for i in kept:
        np.column_stack([POINTS, POINTS[:, 0]]).tofile(drive / f"velodyne_points/data/{i:010d}.bin")
    write_calib(day / "calib_imu_to_velo.txt", T_VELO_IMU)
    write_calib(day / "calib_velo_to_cam.txt", T_CAM_VELO)
    (day / "calib_cam_to_cam.txt").write_text("corner_dist: 9.95e-02\nR_rect_00: " + " ".join(map(str, R_RECT.ravel())) + "\n")
    return drive, scan_times[kept]


def true_poses(scan_times):
    Ts = np.stack([imu(seconds) @ np.linalg.inv(T_VELO_IMU) for seconds in scan_times])
    return np.linalg.inv(Ts[0]) @ Ts


@pytest.mark.parametrize("missing", [(), (0, 7, 8, 9)])
def test_truth_of_an_analytic_drive(tmp_path, missing):
    """Oracle: the circle itself. Chords of 0.1 s are off by 1.1 mm at most, the Mercator scale by 0.3 mm; packets by up to 11 cm."""
    drive, scan_times = raw_drive(tmp_path, missing=missing)
    dataset = open_dataset(drive)
    expected = true_poses(scan_times)
    np.testing.assert_allclose(dataset.truth[:, :3, 3], expected[:, :3, 3], atol=3e-3)
    np.testing.assert_allclose(dataset.truth[:, :3, :3], expected[:, :3, :3], atol=1e-4)
    np.testing.assert_array_equal(dataset.stamps_ns, START_NS + np.round(scan_times * 1e9).astype(np.int64))
    assert len(dataset) == len(scan_times)
    assert dataset.notes == ()


def test_layout_times_and_calibration(tmp_path):
    """Oracle: what was written; T_cam_lidar is that of the rectified camera, times are those of the azimuth."""
    drive, _ = raw_drive(tmp_path, num_frames=3)
    for path in (tmp_path, tmp_path / "2011_09_26", drive, drive / "velodyne_points", drive / "velodyne_points/data"):
        dataset = open_dataset(path)
        assert dataset.name == "2011_09_26_drive_0001_sync"
        assert (dataset.layout, dataset.compensated, dataset.point_times) == ("KITTI raw drive", False, "azimuth")
    np.testing.assert_allclose(dataset.T_cam_lidar, pose(R_RECT, np.zeros(3)) @ T_CAM_VELO, atol=1e-9)
    points, times = dataset[0]
    np.testing.assert_allclose(times, -np.arctan2(POINTS[:, 1], POINTS[:, 0]) / (2 * np.pi) * 0.1035, atol=1e-7)
    assert (points[:, 2] > POINTS[:, 2]).all()  # lifted
    np.testing.assert_array_equal(open_dataset(drive, elevation_correction=False)[0].points, POINTS)
    assert "KITTI raw drive: 2011_09_26_drive_0001_sync, 3 scans" in dataset.describe()[0]


def test_several_drives_of_a_day(tmp_path):
    """Oracle: the names that were written."""
    for number in (1, 2):
        raw_drive(tmp_path, number=number, num_frames=3)
    assert open_dataset(tmp_path, sequence="2011_09_26_drive_0002_sync").name.endswith("0002_sync")
    with pytest.raises(DatasetError, match="0001_sync, 2011_09_26_drive_0002_sync; name one"):
        open_dataset(tmp_path)


def test_scans_without_truth(tmp_path):
    """Oracle: a note says why: no calibration, no oxts, packets of another time."""
    drive, _ = raw_drive(tmp_path / "other", num_frames=5, offset=2.0)
    dataset = open_dataset(drive)
    assert dataset.truth is None
    assert "does not cover" in dataset.notes[0]
    (drive.parent / "calib_imu_to_velo.txt").unlink()
    dataset = open_dataset(drive)
    assert dataset.truth is None
    assert "calib_imu_to_velo.txt" in dataset.notes[0]


def test_timestamps_cut_short(tmp_path):
    """Oracle: the single line that was left; scans are still read."""
    drive, _ = raw_drive(tmp_path, num_frames=4)
    (drive / "velodyne_points/timestamps.txt").write_text("2011-09-26 13:02:25\n")
    dataset = open_dataset(drive)
    assert (len(dataset), dataset.stamps_ns, dataset.truth) == (4, None, None)
    assert "timestamps.txt not used: it has 1 rows for 4 scans" in dataset.notes[0]
    assert dataset[0].times is not None


def test_gap_in_the_packets_is_told(tmp_path):
    """Oracle: the packets that were removed; their numbers are those of the lines."""
    drive, scan_times = raw_drive(tmp_path)
    for i in range(10, 15):
        (drive / f"oxts/data/{i:010d}.txt").unlink()
    dataset = open_dataset(drive)
    assert "gap of 0.6 s" in dataset.notes[0]
    np.testing.assert_allclose(dataset.truth[20:, :3, 3], true_poses(scan_times)[20:, :3, 3], atol=3e-3)


@pytest.mark.parametrize(
    ("file", "content", "reason"),
    [
        ("oxts/data/0000000001.txt", "49.0 8.4 116.0 0.0\n", "0000000001.txt: expected latitude"),
        ("oxts/data/0000000001.txt", "90.0 8.4 116.0 0 0 0\n", "0000000001.txt: expected latitude"),
        ("velodyne_points/timestamps.txt", "2011-09-26 13:02:25\n13:02:26\n", "timestamps.txt, line 2: expected"),
        ("velodyne_points/timestamps.txt", "2011-09-26 13:02:25\n2011-13-26 13:02:26\n", "timestamps.txt, line 2: expected"),
        ("velodyne_points/timestamps.txt", "2011-09-26 13:02:25\n\n\n\n", "expected a time for every scan"),
        ("oxts/timestamps.txt", "", "expected at least one time"),
        ("../calib_imu_to_velo.txt", "R: 1 0 0\nT: 0 0 0\n", "calib_imu_to_velo.txt: expected rows"),
    ],
)
def test_damaged_drives(tmp_path, file, content, reason):
    """Oracle: one sentence with the file, and the line where there are lines."""
    drive, _ = raw_drive(tmp_path, num_frames=4)
    (drive / file).write_text(content)
    with pytest.raises(DatasetError, match=reason):
        open_dataset(drive)
