import csv
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from delo_jax.errors import DeloError
from delo_jax.pipeline.trajectory import CovarianceFile, RunWriter, Trajectory

ROOT = Path(__file__).parents[2]
STAGES = ("prepare", "solve")
COVARIANCES = ("covariances.npy", "pose_covariances.npy", "local_covariances.npy")
FILES = ("poses_kitti.txt", "trajectory.tum", "frames.csv", *COVARIANCES)
EPOCH_NS = 1_317_384_506_123_456_789  # float64 seconds would lose its last digits


def make_frame(index, *, status="ok", reason="", stamp_ns=None, since=None):
    """A frame on a winding track whose numbers all depend on its index."""
    T_world_lidar = np.eye(4)
    T_world_lidar[:3, :3] = Rotation.from_euler("xyz", [0.01 * index, -0.02, 0.1 * index]).as_matrix()
    T_world_lidar[:3, 3] = [1.2 * index, -0.0, 0.05 * index**2]
    sigmas = np.deg2rad([0.1, 0.2, 0.3]).tolist() + [0.01, 0.02, 0.03]
    motion = SimpleNamespace(covariance=np.diag(np.square(sigmas)) * (index + 1), confidence=0.75, status=status, reason=reason)
    timing = {"prepare": 0.0125} if index == 0 else {"prepare": 0.0125, "solve": 0.0075}
    since = max(index - 1, 0) if since is None else since
    known = {"T_world_lidar": T_world_lidar, "covariance": 2.0 * motion.covariance, "local": 0.5 * motion.covariance}
    return SimpleNamespace(**known, motion=motion, since=since, status=status, stamp_ns=stamp_ns, timing=timing)


@pytest.fixture
def frames():
    stamps = [EPOCH_NS + 103_000_001 * index for index in range(5)]
    frames = [make_frame(index, stamp_ns=stamp) for index, stamp in enumerate(stamps)]
    frames[3] = make_frame(3, status="rejected", reason='too few points: 12,\nexpected "100"', stamp_ns=stamps[3])
    frames[4] = make_frame(4, stamp_ns=stamps[4], since=2)  # bridges the bad one
    return frames


@pytest.fixture
def T_cam_lidar():
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    T[:3, 3] = [0.1, -0.08, -0.27]
    return T


def test_kitti_rows_are_read_back_by_evo(frames, T_cam_lidar, tmp_path):
    """Oracle: evo's reader, and the change of frame written out; 12 digits are kept of metres."""
    Ts_world_lidar = np.array([frame.T_world_lidar for frame in frames])
    trajectory = Trajectory(frames)
    assert trajectory.save_kitti(tmp_path / "lidar.txt") == "lidar"
    assert trajectory.save_kitti(tmp_path / "camera.txt", T_cam_lidar) == "camera"
    for name, expected in (("lidar", Ts_world_lidar), ("camera", T_cam_lidar @ Ts_world_lidar @ np.linalg.inv(T_cam_lidar))):
        path = tmp_path / f"{name}.txt"
        np.testing.assert_allclose(file_interface.read_kitti_poses_file(path).poses_se3, expected, atol=1e-11)


def test_tum_rows_keep_every_nanosecond(frames, tmp_path):
    """Oracle: evo's reader for the poses; the stamps digit by digit."""
    Trajectory(frames).save_tum(tmp_path / "trajectory.tum")
    read = file_interface.read_tum_trajectory_file(tmp_path / "trajectory.tum")
    np.testing.assert_allclose(read.poses_se3, [frame.T_world_lidar for frame in frames], atol=1e-10)
    lines = (tmp_path / "trajectory.tum").read_text().splitlines()
    assert [int(line.split()[0].replace(".", "")) for line in lines] == [frame.stamp_ns for frame in frames]
    assert all(float(line.split()[-1]) >= 0.0 for line in lines)


def test_frame_table_has_units_and_one_line_per_frame(frames, tmp_path):
    """Oracle: the numbers the frames were made from."""
    Trajectory(frames).save_csv(tmp_path / "frames.csv")
    assert len((tmp_path / "frames.csv").read_text().splitlines()) == 6
    with open(tmp_path / "frames.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["index"] for row in rows] == list("01234")
    assert [row["since_index"] for row in rows] == list("00122")
    assert [row["status"] for row in rows] == ["ok", "ok", "ok", "rejected", "ok"]
    assert rows[3]["reason"] == 'too few points: 12, expected "100"'
    assert float(rows[0]["sigma_ry_deg"]) == pytest.approx(0.2)
    assert float(rows[3]["sigma_z_m"]) == pytest.approx(0.03 * 2)
    assert (rows[0]["prepare_ms"], rows[0]["solve_ms"], rows[1]["solve_ms"]) == ("12.500", "", "7.500")


def test_frames_without_a_stamp_are_a_tenth_of_a_second_apart():
    """Oracle: by hand."""
    trajectory = Trajectory(make_frame(index) for index in range(3))
    np.testing.assert_array_equal(trajectory.stamps_ns, [0, 100_000_000, 200_000_000])


def test_arrays_of_an_empty_trajectory_have_their_shapes():
    """Oracle: the documented shapes with n = 0."""
    trajectory = Trajectory()
    assert trajectory.Ts_world_lidar.shape == (0, 4, 4)
    assert trajectory.covariances.shape == (0, 6, 6)
    assert trajectory.sigmas.shape == (0, 6)
    assert len(trajectory) == len(trajectory.statuses) == len(trajectory.confidences) == 0


def test_writer_leaves_the_files_that_saving_at_the_end_would(frames, T_cam_lidar, tmp_path):
    """Oracle: symmetry of the two ways; the covariances against those of the frames."""
    with RunWriter(tmp_path / "run", T_cam_lidar=T_cam_lidar, timing_names=STAGES) as writer:
        assert writer.kitti_frame == "camera"
        for num, frame in enumerate(frames, start=1):
            writer.append(frame)
            assert all(count == num for count in num_whole_frames(tmp_path / "run").values())  # before it is closed
    trajectory = Trajectory(frames)
    trajectory.save_kitti(tmp_path / "poses_kitti.txt", T_cam_lidar)
    trajectory.save_tum(tmp_path / "trajectory.tum")
    trajectory.save_csv(tmp_path / "frames.csv")
    for name in FILES[:3]:
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / name).read_bytes()
    np.testing.assert_array_equal(np.load(tmp_path / "run" / "covariances.npy"), [frame.motion.covariance for frame in frames])
    np.testing.assert_array_equal(np.load(tmp_path / "run" / "pose_covariances.npy"), [frame.covariance for frame in frames])
    np.testing.assert_array_equal(np.load(tmp_path / "run" / "local_covariances.npy"), [frame.local for frame in frames])


def test_unannounced_stage_is_refused_and_nothing_written(frames, tmp_path):
    """Oracle: the message, and the files' lengths."""
    with RunWriter(tmp_path, timing_names=["prepare"]) as writer:
        writer.append(frames[0])
        with pytest.raises(DeloError, match="timing: expected only prepare, got solve"):
            writer.append(frames[1])
        assert set(num_whole_frames(tmp_path).values()) == {1}


@pytest.mark.parametrize("num", [0, 1, 9, 10, 1234])
def test_growing_npy_file_is_like_that_of_numpy(num, tmp_path):
    """Oracle: np.load; and the header length numpy asks for, a multiple of 64."""
    matrices = np.random.default_rng(num).normal(size=(num, 6, 6))
    file = CovarianceFile(tmp_path / "covariances.npy")
    for matrix in matrices:
        file.append(matrix)
    np.testing.assert_array_equal(np.load(tmp_path / "covariances.npy"), matrices)
    file.close()
    assert (tmp_path / "covariances.npy").stat().st_size == 128 + num * 288


def test_killed_run_leaves_whole_frames(tmp_path):
    """Oracle: the operating system's SIGKILL, at three instants that the writer does not choose."""
    script = textwrap.dedent(f"""
        import sys
        sys.path[:0] = [{str(Path(__file__).parent)!r}, {str(ROOT)!r}]
        from test_trajectory import STAGES, RunWriter, make_frame
        writer = RunWriter(sys.argv[1], timing_names=STAGES)
        print("started", flush=True)
        for index in range(10**9):
            writer.append(make_frame(index % 100))
    """)
    for delay_s in (0.05, 0.0731, 0.1113):
        out = tmp_path / f"run_{delay_s}"
        with subprocess.Popen([sys.executable, "-c", script, out], stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "started\n"
            time.sleep(delay_s)
            process.send_signal(signal.SIGKILL)
        counts = num_whole_frames(out)
        assert min(counts.values()) > 0
        assert max(counts.values()) - min(counts.values()) <= 1
        covariances = np.load(out / "covariances.npy")
        np.testing.assert_array_equal(covariances, [make_frame(index % 100).motion.covariance for index in range(len(covariances))])


def num_whole_frames(run):
    """Frames in each file of a run, read as a user would; a torn row fails here."""
    kitti, tum = (np.loadtxt(run / name, ndmin=2) for name in FILES[:2])
    with open(run / "frames.csv", newline="") as file:
        header, *table = csv.reader(file)
    assert kitti.shape[1] == 12
    assert tum.shape[1] == 8
    assert {len(row) for row in table} == {len(header)}
    return dict(zip(FILES, (len(kitti), len(tum), len(table), *(len(np.load(run / name)) for name in COVARIANCES)), strict=True))
