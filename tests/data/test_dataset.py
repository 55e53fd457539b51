import numpy as np
import pytest

from delo_jax.data.dataset import open_dataset
from delo_jax.errors import DatasetError, ScanError

CALIB = "P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3\n"
TR = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1.0]])
POINTS = np.random.default_rng(0).normal(0, [10, 10, 1], (40, 3)).astype("<f4")


def write_scans(folder, names):
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        np.column_stack([POINTS + i, POINTS[:, 0]]).astype("<f4").tofile(folder / name)


def straight_rows(count):
    """Camera rows of a drive along the camera's z, 1 m a frame: along the sensor's x."""
    return "".join(f"1 0 0 0 0 1 0 0 0 0 1 {i}\n" for i in range(count))


def odometry_tree(root, name="00", numbers=range(5), rows=5):
    folder = root / "sequences" / name
    write_scans(folder / "velodyne", [f"{number:06d}.bin" for number in numbers])
    (folder / "calib.txt").write_text(CALIB)
    (folder / "times.txt").write_text("".join(f"{0.1 * i:e}\n" for i in range(rows)))
    (root / "poses").mkdir(exist_ok=True)
    (root / "poses" / f"{name}.txt").write_text(straight_rows(rows))
    return folder


def test_odometry_sequence(tmp_path):
    """Oracle: closed form; a step along the camera's z is one along the sensor's x, seen from a sensor that does not turn."""
    folder = odometry_tree(tmp_path)
    for path in (tmp_path, tmp_path / "sequences", folder, folder / "velodyne"):
        dataset = open_dataset(path, elevation_correction=False)
        assert (len(dataset), dataset.name, dataset.layout) == (5, "00", "KITTI odometry sequence")
        np.testing.assert_allclose(dataset.truth[:, :3, 3], np.arange(5)[:, None] * [1, 0, 0], atol=1e-12)
        np.testing.assert_array_equal(dataset.stamps_ns, np.arange(5) * 100_000_000)
        np.testing.assert_allclose(dataset.T_cam_lidar, TR)
        assert (dataset.compensated, dataset.point_times, dataset.elevation_correction_deg) == (True, "none", 0.0)
        np.testing.assert_array_equal(dataset[2].points, POINTS + np.float32(2))
        assert dataset[2].times is None
    assert [scan.points[0, 0] for scan in dataset] == [dataset[i].points[0, 0] for i in range(5)]


def test_truth_in_a_turned_first_frame(tmp_path):
    """Oracle: closed form; poses need not start at the identity, truth does."""
    folder = odometry_tree(tmp_path)
    (tmp_path / "poses/00.txt").write_text("".join(f"0 0 1 {i} 0 1 0 0 -1 0 0 7\n" for i in range(5)))  # camera looks along x
    np.testing.assert_allclose(open_dataset(folder).truth[:, :3, 3], np.arange(5)[:, None] * [1, 0, 0], atol=1e-12)


def test_elevation_and_azimuth_switches(tmp_path):
    """Oracle: the angle of each point in float64, and the sign of the time left (before) and right (after)."""
    dataset = open_dataset(odometry_tree(tmp_path), azimuth_times=True)

    def elevation_deg(points):
        points = points.astype(np.float64)
        return np.rad2deg(np.arctan2(points[:, 2], np.linalg.norm(points[:, :2], axis=1)))

    assert dataset.elevation_correction_deg == 0.205
    np.testing.assert_allclose(elevation_deg(dataset[0].points) - elevation_deg(POINTS), 0.205, atol=1e-4)
    assert (dataset.compensated, dataset.point_times) == (False, "azimuth")
    np.testing.assert_array_equal(np.sign(dataset[0].times), -np.sign(POINTS[:, 1]))


def test_scans_that_say_to_be_as_measured_get_times_by_themselves(tmp_path):
    """Oracle: the azimuth of each point in sweeps of 0.1 s, the spacing of the stamps."""
    folder = odometry_tree(tmp_path)
    (folder / "calib.txt").write_text(CALIB + "motion_compensated: 0\n")
    dataset = open_dataset(folder)
    assert (dataset.compensated, dataset.point_times) == (False, "azimuth")
    np.testing.assert_allclose(dataset[0].times, -0.1 * np.arctan2(POINTS[:, 1], POINTS[:, 0]) / (2 * np.pi), atol=1e-7)


def test_rows_of_a_tree_have_four_columns(tmp_path):
    """Oracle: the five columns that went in; a plain folder takes them."""
    folder = odometry_tree(tmp_path)
    rng = np.random.default_rng(0)
    rows = np.column_stack([rng.normal(0, [10, 10, 1], (2000, 3)), rng.uniform(0, 255, 2000), np.arange(2000) % 32]).astype("<f4")
    rows.tofile(folder / "velodyne/000000.bin")
    with pytest.raises(ScanError, match="expected rows of 4 float32 values, got values that look like rows of 5"):
        open_dataset(folder)[0]
    (tmp_path / "plain").mkdir()
    rows.tofile(tmp_path / "plain/0.bin")
    np.testing.assert_array_equal(open_dataset(tmp_path / "plain")[0].points, rows[:, :3])


def test_excerpts_with_the_times_and_poses_of_the_whole(tmp_path):
    """Oracle: the frame numbers in the names of the scans, and one that is missing."""
    dataset = open_dataset(odometry_tree(tmp_path, numbers=(56, 57, 59), rows=100))
    np.testing.assert_array_equal(dataset.stamps_ns, np.array([56, 57, 59]) * 100_000_000)
    np.testing.assert_allclose(dataset.truth[:, 0, 3], [0, 1, 3], atol=1e-12)
    dataset = open_dataset(odometry_tree(tmp_path / "short", numbers=(56, 57, 59), rows=20))
    assert (dataset.stamps_ns, dataset.truth, dataset.truth_source) == (None, None, "none")
    assert "times.txt not used: it has 20 rows for 3 scans" in dataset.notes[0]
    assert "00.txt not used: it has 20 rows for 3 scans" in dataset.notes[1]


def test_sequence_without_calibration_times_or_poses(tmp_path):
    """Oracle: None for what is not there, and a note where that hides the truth."""
    folder = odometry_tree(tmp_path)
    (folder / "calib.txt").unlink()
    (folder / "times.txt").unlink()
    dataset = open_dataset(folder)
    assert dataset.truth is None
    assert dataset.stamps_ns is None
    assert dataset.T_cam_lidar is None
    assert "calib.txt with a row Tr" in dataset.describe()[-1]


@pytest.mark.parametrize("tr", ["Tr: 1 2 3", "Tr: 2 0 0 0 0 2 0 0 0 0 2 0"])
def test_damaged_calibration(tmp_path, tr):
    """Oracle: one sentence with the file."""
    folder = odometry_tree(tmp_path)
    (folder / "calib.txt").write_text(tr)
    with pytest.raises(DatasetError, match="calib.txt: expected a"):
        open_dataset(folder)


def test_several_sequences(tmp_path):
    """Oracle: the names that were written."""
    for name in ("00", "01"):
        odometry_tree(tmp_path, name)
    assert open_dataset(tmp_path, sequence="01").name == "01"
    with pytest.raises(DatasetError, match="expected one sequence, got 00, 01; name one"):
        open_dataset(tmp_path)
    with pytest.raises(DatasetError, match="expected a sequence '7', got 00, 01"):
        open_dataset(tmp_path, sequence="7")


def test_missing_empty_and_foreign_paths(tmp_path):
    """Oracle: one sentence each."""
    (tmp_path / "file.bin").touch()
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match="got nothing; check the path"):
        open_dataset(tmp_path / "missing")
    with pytest.raises(DatasetError, match="got a file"):
        open_dataset(tmp_path / "file.bin")
    with pytest.raises(DatasetError, match="got neither; give the folder"):
        open_dataset(tmp_path / "empty")


def test_a_damaged_scan_is_an_error_only_when_asked_for(tmp_path):
    """Oracle: the size of the second file."""
    folder = odometry_tree(tmp_path)
    (folder / "velodyne/000001.bin").write_bytes(bytes(17))
    dataset = open_dataset(folder)
    assert len(dataset[2].points) == 40
    with pytest.raises(ScanError, match=r"000001.bin: expected whole points"):
        dataset[1]
    with pytest.raises(IndexError):
        dataset[5]


def test_folder_in_natural_order(tmp_path):
    """Oracle: the numbers in the names; nothing is corrected, unknown stays unknown, other formats are named."""
    write_scans(tmp_path, ["scan_9.bin", "scan_10.bin", "scan_1.bin"])
    np.save(tmp_path / "map.npy", POINTS)
    (tmp_path / "._scan_1.bin").touch()
    dataset = open_dataset(tmp_path)
    assert [path.name for path in dataset.paths] == ["scan_1.bin", "scan_9.bin", "scan_10.bin"]
    assert (dataset.elevation_correction_deg, dataset.compensated, dataset.point_times) == (0.0, None, "none")
    assert (dataset.stamps_ns, dataset.truth, dataset.truth_source) == (None, None, "none")
    assert "1 .npy files left out" in dataset.describe()[-1]
    assert open_dataset(tmp_path, azimuth_times=True)[0].times is not None


@pytest.mark.parametrize(
    ("stems", "expected_ns"),
    [
        (["1317013364326110540", "1317013364429110541"], [1317013364326110540, 1317013364429110541]),
        (["0", "100000000", "200000000"], [0, 100000000, 200000000]),
        (["1317013364326110", "1317013364429110"], [1317013364326110000, 1317013364429110000]),
        (["1317013364.5", "1317013364.25"], [1317013364250000000, 1317013364500000000]),
        (["000000", "000001", "000010"], None),
        (["1.5", "1.50"], None),
    ],
    ids=["ns", "ns from 0", "us", "seconds", "frame numbers", "twice the same"],
)
def test_stamps_from_names(tmp_path, stems, expected_ns):
    """Oracle: the numbers as integers."""
    write_scans(tmp_path, [f"{stem}.bin" for stem in stems])
    stamps_ns = open_dataset(tmp_path).stamps_ns
    assert stamps_ns is None if expected_ns is None else stamps_ns.tolist() == expected_ns


def test_folder_with_poses_and_times(tmp_path):
    """Oracle: closed form; poses are in the sensor's frame here, and left out with a note where they do not fit."""
    write_scans(tmp_path, ["a.bin", "b.bin", "c.bin"])
    (tmp_path / "poses.txt").write_text(straight_rows(3))
    (tmp_path / "times.txt").write_text("5.0\n5.1\n5.2\n")
    dataset = open_dataset(tmp_path)
    np.testing.assert_allclose(dataset.truth[:, :3, 3], np.arange(3)[:, None] * [0, 0, 1])
    np.testing.assert_array_equal(dataset.stamps_ns, [5_000_000_000, 5_100_000_000, 5_200_000_000])
    (tmp_path / "poses.txt").write_text(straight_rows(2))
    (tmp_path / "times.txt").write_text("5.0\n4.9\n5.2\n")
    dataset = open_dataset(tmp_path)
    assert (dataset.truth, dataset.stamps_ns) == (None, None)
    assert "2 rows for 3 scans" in dataset.describe()[-2]
    assert "scan 1 is not after" in dataset.describe()[-1]


def test_folder_with_stored_times(tmp_path):
    """Oracle: the times that were saved; stored ones win over those by azimuth."""
    (tmp_path / "0.npz").write_bytes(b"damaged")
    np.savez(tmp_path / "1.npz", xyz=POINTS, time=np.linspace(3.0, 3.1, 40))
    dataset = open_dataset(tmp_path, azimuth_times=True)
    assert dataset.point_times == "stored"
    np.testing.assert_allclose(dataset[1].times, np.linspace(-0.05, 0.05, 40), atol=1e-9)  # of a clock


def folder_of_sweeps(folder, starts, *, last=0.1, spacing_s=None):
    """Scans whose times go from each start to `last` after it."""
    folder.mkdir()
    for i, start in enumerate(starts):
        np.savez(folder / f"{i}.npz", xyz=POINTS, time=start + np.linspace(0, last, 40))
    if spacing_s:
        (folder / "times.txt").write_text("".join(f"{spacing_s * i}\n" for i in range(len(starts))))
    return open_dataset(folder)


@pytest.mark.parametrize("count", [2, 3, 15])
def test_times_of_a_recording_are_relative_to_mid_sweep(tmp_path, count):
    """Oracle: closed form; those of the first second are as small as offsets, but do not start over."""
    dataset = folder_of_sweeps(tmp_path / "clock", 0.1 * np.arange(count))
    for scan in dataset:
        np.testing.assert_allclose(scan.times, np.linspace(-0.05, 0.05, 40), atol=1e-9)


def test_offsets_start_over_in_each_scan(tmp_path):
    """Oracle: the times that were saved, which jitter around 0."""
    starts = [1e-4, -1e-4, 0.0, 1e-5]
    for start, scan in zip(starts, folder_of_sweeps(tmp_path / "offsets", starts), strict=True):
        np.testing.assert_allclose(scan.times, start + np.linspace(0, 0.1, 40), atol=1e-12)


@pytest.mark.parametrize(("spacing_s", "used"), [(0.1, False), (0.66, False), (0.68, True), (None, True)])
def test_normalised_times_are_left_out(tmp_path, spacing_s, used):
    """Oracle: closed form; from 0 to 1 they are no seconds where a scan follows in less than 1 s / 1.5."""
    dataset = folder_of_sweeps(tmp_path / "normalised", [0, 0, 0], last=1.0, spacing_s=spacing_s)
    assert dataset.point_times == ("stored" if used else "none")
    assert (dataset[0].times is not None) is used
    assert any("a sweep lasts 1 s" in note for note in dataset.notes) is not used


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "scans", "path_m", "heading_deg"),
    [
        ("raw_0926_0013", 144, 173, 9),
        ("odo_04_000", 51, 69, 0),
        ("odo_00_056", 86, 50, -91),
        ("raw_0926_0002", 10, 8, 0),
        ("raw_0926_0060", 2, 0, 0),
    ],
)
def test_real_sequences(data_dir, name, scans, path_m, heading_deg):
    """Oracle: the table that comes with the data: scans, path, change of heading (left is positive), spacing of the stamps."""
    dataset = open_dataset(data_dir, sequence=name)
    steps_m = np.linalg.norm(np.diff(dataset.truth[:, :3, 3], axis=0), axis=1)
    assert len(dataset) == scans
    assert steps_m.sum() == pytest.approx(path_m, abs=0.6)
    assert abs(np.rad2deg(np.arctan2(dataset.truth[-1, 1, 0], dataset.truth[-1, 0, 0]))) == pytest.approx(abs(heading_deg), abs=1)
    assert (dataset.truth[-1, 0, 3] > 1) == (path_m > 0)  # forward is x
    assert np.all((np.diff(dataset.stamps_ns) > 0.101e9) & (np.diff(dataset.stamps_ns) < 0.1055e9))
    points = dataset[scans // 2].points
    assert len(points) > 100_000
    assert 1.4 < -np.median(points[(np.abs(points[:, 2] + 1.7) < 0.5), 2]) < 2.0  # the sensor is 1.73 m above the road


@pytest.mark.data
def test_real_ouster_and_hdl32(data_dir):
    """Oracle: the note that comes with the data: sweeps of 0.1 s with times, 0.25 m a sweep; four columns, some at the origin."""
    ouster = open_dataset(data_dir / "ouster_street")
    assert (len(ouster), ouster.point_times, ouster.compensated) == (3, "stored", None)
    np.testing.assert_allclose(np.linalg.norm(np.diff(ouster.truth[:, :3, 3], axis=0), axis=1), 0.25, atol=0.02)
    for scan in ouster:
        assert -0.0501 < scan.times.min() < -0.0499
        assert 0.0499 < scan.times.max() < 0.0501
    pairs = open_dataset(data_dir / "pairs")
    assert [len(scan.points) for scan in pairs] == [69_792, 69_088]
    assert all(4000 < np.sum(~scan.points.any(axis=1)) < 6000 for scan in pairs)
