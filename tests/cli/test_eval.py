import json
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

SCALE = 1.01


def straight(num_frames, step_m):
    """Poses along x."""
    Ts = np.tile(np.eye(4), (num_frames, 1, 1))
    Ts[:, 0, 3] = step_m * np.arange(num_frames)
    return Ts


def write_kitti(path, Ts):
    """Twelve numbers a line."""
    np.savetxt(path, Ts[:, :3].reshape(-1, 12))


def write_tum(path, Ts, stamps_s):
    """Eight numbers a line."""
    np.savetxt(path, np.column_stack([stamps_s, Ts[:, :3, 3], Rotation.from_matrix(Ts[:, :3, :3]).as_quat()]), fmt="%.9f")


def write_run(folder, Ts, T_cam_lidar=None):
    """The files of a run that `eval` reads."""
    folder.mkdir(exist_ok=True)
    write_kitti(folder / "poses_kitti.txt", Ts if T_cam_lidar is None else T_cam_lidar @ Ts @ np.linalg.inv(T_cam_lidar))
    write_tum(folder / "trajectory.tum", Ts, 0.1 * np.arange(len(Ts)))
    frame = "lidar" if T_cam_lidar is None else "camera"
    facts = {"state": "complete", "poses_kitti_frame": frame, "T_cam_lidar": None if T_cam_lidar is None else T_cam_lidar.tolist()}
    (folder / "run.json").write_text(json.dumps(facts))


def numbers(out, row):
    """Translation and rotation of the first row that starts so."""
    line = next(line for line in out.splitlines() if re.match(rf"\W*{row}", line))
    return [float(cell) for cell in line.split("│")[2:5:2] if cell.strip()]


@pytest.mark.parametrize(("num_frames", "span"), [(300, "100-200 m"), (60, "10-50 m")])
def test_a_scale_error(num_frames, span, cli, tmp_path):
    """Oracle: closed form: 1 % too long is a drift of 1 % of the distance between the frames, and no rotation."""
    write_run(tmp_path / "run", straight(num_frames, SCALE))
    write_kitti(tmp_path / "truth.txt", straight(num_frames, 1.0))
    done = cli("eval", tmp_path / "run", "--truth", tmp_path / "truth.txt")
    assert done.code == 0
    t, r = numbers(done.out, f"drift over {span}")
    assert 1.0 <= t <= 1.11  # a segment ends at the first frame beyond its length: up to 1 m in 10 m more
    assert r == 0.0
    assert numbers(done.out, "gap 5, median") == [5.0, 0.0]
    spread = np.std(0.01 * np.arange(num_frames))
    assert numbers(done.out, "ATE") == [pytest.approx(spread, abs=1e-3)]


def test_frames_are_converted_with_the_calibration(cli, tmp_path):
    """Oracle: the truth itself, in the camera frame, in the LiDAR frame by stamp, and beside the run."""
    Ts = straight(40, 1.0)
    Ts[:, :3, :3] = Rotation.from_rotvec(np.outer(0.01 * np.arange(40), [0, 0, 1])).as_matrix()
    T_cam_lidar = np.array([[0.0, -1, 0, 0.3], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])
    write_run(tmp_path / "run", Ts, T_cam_lidar)
    write_kitti(tmp_path / "cam.txt", T_cam_lidar @ Ts @ np.linalg.inv(T_cam_lidar))
    denser = np.repeat(Ts, 2, axis=0)  # every frame twice, 3 ms before and 1 ms after
    write_tum(tmp_path / "truth.tum", denser, np.repeat(0.1 * np.arange(40), 2) + np.tile([-0.003, 0.001], 40))
    write_tum(tmp_path / "run" / "truth.tum", Ts, 0.1 * np.arange(40))
    for truth in (["--truth", tmp_path / "cam.txt"], ["--truth", tmp_path / "truth.tum"], []):
        done = cli("eval", tmp_path / "run", *truth)
        assert done.code == 0
        for row in ("drift over 10-30 m", "gap 1, p95", "gap 2, median"):
            np.testing.assert_allclose(numbers(done.out, row), 0.0, atol=2e-3)


def test_the_datasets_own_truth(tree, cli, tmp_path):
    """Oracle: the truth of the tree, given out as the run: no error at all."""
    rows = np.loadtxt(tree / "poses" / "mixed-50.txt").reshape(-1, 3, 4)
    write_run(tmp_path / "run", straight(len(rows), 1.0))
    np.savetxt(tmp_path / "run" / "poses_kitti.txt", rows.reshape(-1, 12))
    calibration = [[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]]
    facts = {"dataset": {"path": str(tree), "sequence": None}, "T_cam_lidar": calibration}
    (tmp_path / "run" / "run.json").write_text(json.dumps(facts))
    done = cli("eval", tmp_path / "run")
    assert done.code == 0
    assert numbers(done.out, "gap 1, median") == [0.0, 0.0]
    assert "drift (path below 10 m)" in done.out


def bad_truths(folder):
    """Files that are no truth of a run of 20 frames, and words of the sentence about each."""
    Ts = straight(20, 1.0)
    write_kitti(folder / "short.txt", Ts[:19])
    write_kitti(folder / "nan.txt", np.where(np.arange(20)[:, None, None] == 7, np.nan, Ts))
    write_tum(folder / "late.tum", Ts, 100.0 + 0.1 * np.arange(20))
    (folder / "words.txt").write_text("no numbers here\n")
    (folder / "empty.txt").write_text("")
    return {
        "short.txt": "20 frames, got 19",
        "nan.txt": "line 8",
        "late.tum": "10 ms",
        "words.txt": "line 1",
        "empty.txt": "empty",
        "no.txt": "check",
    }


def test_bad_truths(cli, tmp_path):
    """Oracle: exit code 2 and one sentence that names the file."""
    write_run(tmp_path / "run", straight(20, 1.0))
    for name, words in bad_truths(tmp_path).items():
        done = cli("eval", tmp_path / "run", "--truth", tmp_path / name)
        assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
        assert name in done.err
        assert words in done.err


def test_bad_runs(cli, tmp_path):
    """Oracle: exit code 2 and one sentence: no truth known, a single frame, a damaged run.json."""
    folder = tmp_path / "run"
    write_run(folder, straight(20, 1.0))
    assert "give one by --truth" in cli("eval", folder).err
    write_run(folder, straight(1, 1.0))
    write_kitti(tmp_path / "truth.txt", straight(1, 1.0))
    done = cli("eval", folder, "--truth", tmp_path / "truth.txt")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "two or more frames" in done.err
    (folder / "run.json").write_text("{")
    done = cli("eval", folder)
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "expected JSON" in done.err


T_CAM_LIDAR = np.array([[0.0, -1, 0, 0.3], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])


def bend(num_frames, step_m):
    """Poses along a circle of 200 m radius, x of the body ahead."""
    s = step_m * np.arange(num_frames)
    Ts = np.tile(np.eye(4), (num_frames, 1, 1))
    Ts[:, :3, :3] = Rotation.from_euler("z", (s / 200)[:, None]).as_matrix()
    Ts[:, 0, 3], Ts[:, 1, 3] = 200 * np.sin(s / 200), 200 * (1 - np.cos(s / 200))
    return Ts


@pytest.fixture
def files(tmp_path):
    """One drive in both frames and both formats, and the calibration between them."""
    Ts = bend(150, 1.0)
    write_kitti(tmp_path / "lidar.txt", Ts)
    write_kitti(tmp_path / "camera.txt", T_CAM_LIDAR @ Ts @ np.linalg.inv(T_CAM_LIDAR))
    write_tum(tmp_path / "lidar.tum", Ts, 0.1 * np.arange(150))
    (tmp_path / "calib.txt").write_text("P0: 1 0 0\nTr: " + " ".join(map(str, T_CAM_LIDAR[:3].ravel())) + "\n")
    return tmp_path


@pytest.mark.parametrize(
    ("estimate", "truth", "frame"),
    [("lidar.txt", "lidar.tum", "LiDAR frame"), ("camera.txt", "camera.txt", "camera frame"), ("lidar.tum", "lidar.tum", "LiDAR frame")],
)
def test_plain_files_state_their_frame(estimate, truth, frame, cli, files):
    """Oracle: the same drive on both sides: no error at all, in the frame that the file was written in; 1 m in 0.1 s is 10 m/s."""
    done = cli("eval", files / estimate, "--truth", files / truth)
    assert done.code == 0
    assert f"150 frames, errors in the {frame}" in done.out
    for row in ("drift over 100 m, mean of 5", "gap 5, p95", r"8 to 12 m/s \(5 segments"):
        np.testing.assert_allclose(numbers(done.out, row), 0.0, atol=2e-3)
    assert numbers(done.out, "ATE") == [pytest.approx(0.0, abs=1e-3)]


@pytest.mark.parametrize(("estimate", "truth"), [("lidar.txt", "camera.txt"), ("camera.txt", "lidar.tum")])
def test_frames_that_differ_are_refused_or_calibrated(estimate, truth, cli, files):
    """Oracle: exit code 2 and one sentence with both axes; with the calibration no error at all."""
    refused = cli("eval", files / estimate, "--truth", files / truth)
    assert (refused.code, refused.out, refused.err.count("\n")) == (2, "", 1)
    for words in (truth, "+x", "+z", "LiDAR frame", "camera frame", "--calib"):
        assert words in refused.err
    done = cli("eval", files / estimate, "--truth", files / truth, "--calib", files / "calib.txt")
    assert done.code == 0
    assert "camera frame, brought to the LiDAR frame with Tr" in done.out
    np.testing.assert_allclose(numbers(done.out, "drift over 100 m, mean of 5"), 0.0, atol=2e-3)


def test_frames_of_a_run_are_held_to_its_calibration(cli, files):
    """Oracle: KITTI rows in the LiDAR's frame beside a run with a calibration, in the camera's beside one without: refused."""
    write_run(files / "with", bend(150, 1.0), T_CAM_LIDAR)
    write_run(files / "without", bend(150, 1.0))
    assert cli("eval", files / "with", "--truth", files / "camera.txt").code == 0
    assert cli("eval", files / "without", "--truth", files / "lidar.txt").code == 0
    refused = cli("eval", files / "with", "--truth", files / "lidar.txt")
    assert (refused.code, refused.err.count("\n")) == (2, 1)
    assert "lidar.txt: expected KITTI rows in the camera frame of the calibration" in refused.err
    refused = cli("eval", files / "without", "--truth", files / "camera.txt")
    assert (refused.code, refused.err.count("\n")) == (2, 1)
    assert "--calib" in refused.err
    assert cli("eval", files / "without", "--truth", files / "camera.txt", "--calib", files / "calib.txt").code == 0


def test_a_run_is_never_in_another_frame_than_its_own_truth(cli, files):
    """Oracle: a lost run that slides sideways all the way beside the truth in its own folder: errors, not a refusal."""
    sideways = bend(150, 1.0)
    sideways[:, :3, :3] = sideways[:, :3, :3] @ Rotation.from_euler("z", 90, degrees=True).as_matrix()
    write_run(files / "run", sideways)
    write_tum(files / "run" / "truth.tum", bend(150, 1.0), 0.1 * np.arange(150))
    done = cli("eval", files / "run")
    assert done.code == 0
    assert "estimate -y, truth +x" in done.out
    t, _ = numbers(done.out, "drift over 100 m, mean of 5")
    assert t > 100
    assert cli("eval", files / "run", "--truth", files / "lidar.tum").code == 2


def test_gaps_and_json(cli, files):
    """Oracle: closed form: steps 1 cm too long, at gap 10 a chord of 10.1 m on the same circle beside one of 10 m; the printed table."""
    write_kitti(files / "long.txt", bend(150, 1.01))
    done = cli("eval", files / "long.txt", "--truth", files / "lidar.txt", "--gap", "10", "--json", files / "numbers.json")
    assert done.code == 0
    t, r = numbers(done.out, "gap 10, median")
    assert t == pytest.approx(10.0, abs=0.2)
    assert r == pytest.approx(np.rad2deg(0.1 / 200), abs=1e-3)
    assert "gap 1," not in done.out
    stored = json.loads((files / "numbers.json").read_text())
    assert (stored["frame"], stored["frames"]) == ("lidar", 150)
    row = next(row for row in stored["rows"] if row["what"] == "gap 10, median")
    assert (round(row["cm"], 2), round(row["deg"], 3)) == (t, r)


def test_bad_files(cli, files):
    """Oracle: exit code 2 and one sentence: no truth, other lengths, one pose, a gap too wide, NaN, no calibration, nowhere to write."""
    estimate, truth = files / "lidar.txt", ["--truth", files / "lidar.txt"]
    write_kitti(files / "short.txt", bend(149, 1.0))
    write_kitti(files / "one.txt", bend(1, 1.0))
    write_kitti(files / "nan.txt", np.where(np.arange(150)[:, None, None] == 7, np.nan, bend(150, 1.0)))
    for arguments, words in (
        ([estimate], "give one by --truth"),
        ([files / "short.txt", *truth], "lidar.txt: expected one pose for each of 149 frames, got 150"),
        ([files / "one.txt", "--truth", files / "one.txt"], "two or more frames, got 1"),
        ([estimate, *truth, "--gap", "150"], "gap: expected 1 to 149 for 150 poses, got 150"),
        ([files / "nan.txt", *truth], "nan.txt, line 8"),
        ([estimate, *truth, "--calib", files / "no.txt"], "no.txt: expected a calib.txt"),
        ([estimate, *truth, "--calib", files / "lidar.txt"], "expected a row 'Tr:'"),
        ([estimate, *truth, "--refined"], "--refined: expected the folder of a run"),
        ([estimate, *truth, "--json", files / "no" / "numbers.json"], "--json"),
    ):
        done = cli("eval", *arguments)
        assert (done.code, done.err.count("\n")) == (2, 1)
        assert words in done.err


def test_a_short_path_has_no_drift_and_says_so(cli, files):
    """Oracle: by hand: 8 poses 1 m apart are 7 m."""
    write_kitti(files / "few.txt", bend(8, 1.0))
    done = cli("eval", files / "few.txt", "--truth", files / "few.txt")
    assert done.code == 0
    assert "no drift: expected a path of more than 10 m, got 7.0 m" in done.out
    assert numbers(done.out, "gap 1, median") == [0.0, 0.0]


@pytest.mark.data
@pytest.mark.parametrize("sequence", ["04", "06"])
def test_released_trajectories_by_hand(sequence, cli, data_dir, tmp_path):
    """Oracle: golden numbers of another evaluator: SiMpLE, and PWCLO-Net in the LiDAR frame by the calibration."""
    golden = json.loads((data_dir / "released_trajectories" / "golden_metrics.json").read_text())["methods"]
    poses, calibration = np.load(data_dir / "kitti_poses.npz")[sequence], np.load(data_dir / "kitti_calib_tr.npz")[sequence]
    np.savetxt(tmp_path / "truth.txt", poses.reshape(-1, 12))
    (tmp_path / "calib.txt").write_text("Tr: " + " ".join(map(str, calibration.ravel())) + "\n")
    for method, frame, options in (("simple_online", "camera", []), ("pwclo_2k", "velodyne", ["--calib", tmp_path / "calib.txt"])):
        released = np.load(data_dir / "released_trajectories" / f"{method}.npz")[sequence]
        np.savetxt(tmp_path / "estimate.txt", released.reshape(-1, 12))
        done = cli("eval", tmp_path / "estimate.txt", "--truth", tmp_path / "truth.txt", *options)
        expected = golden[method][sequence][frame]
        t, r = numbers(done.out, rf"drift over 100-\d+ m, mean of {expected['n']}")
        assert t == pytest.approx(expected["t_rel"], abs=1e-3)
        assert r == pytest.approx(expected["r_rel"], abs=1e-3)
