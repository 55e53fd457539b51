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
