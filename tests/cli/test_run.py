import csv
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from delo_jax import weights
from delo_jax.cli import main
from delo_jax.data.sequence import Dataset
from tests.fixtures import narrow_model
from tests.report.pages import page_data

NUM_SCANS, NAME = 8, "mixed-50"  # of the tree
CALIBRATION = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])  # that the tree is written with


@pytest.fixture(scope="module")
def folder(tree, weights_file, tmp_path_factory) -> Path:
    """A run over the tree."""
    from delo_jax.cli import main

    out = tmp_path_factory.mktemp("run") / "out"
    assert main(["run", str(tree), "--out", str(out), "--weights", weights_file]) == 0
    return out


def read_rows(path):
    """KITTI rows as (n, 4, 4)."""
    rows = np.loadtxt(path).reshape(-1, 3, 4)
    return np.concatenate([rows, np.tile([[[0.0, 0, 0, 1]]], (len(rows), 1, 1))], axis=1)


def check_whole(folder) -> int:
    """The number of whole frames, of which the files may differ by one; fails on a file that cannot be read."""
    poses, tum = read_rows(folder / "poses_kitti.txt"), np.loadtxt(folder / "trajectory.tum", ndmin=2)
    with (folder / "frames.csv").open(newline="") as file:
        frames = list(csv.DictReader(file))
    covariances = np.load(folder / "covariances.npy")
    counts = [len(poses), len(tum), len(frames), len(covariances)]
    assert max(counts) - min(counts) <= 1
    assert tum.shape[1] == 8
    assert covariances.shape[1:] == (6, 6)
    assert all(None not in row.values() for row in frames)
    tomllib.loads((folder / "config.toml").read_text())
    json.loads((folder / "run.json").read_text())
    return min(counts)


def test_files_agree_with_each_other_and_with_the_truth(folder, tree):
    """Oracle: SciPy rotations between the two files, and the simulator's poses of a car that hardly moves, loosely (untrained weights)."""
    assert check_whole(folder) == NUM_SCANS
    tum = np.loadtxt(folder / "trajectory.tum")
    cam = read_rows(folder / "poses_kitti.txt")
    lidar = np.linalg.inv(CALIBRATION) @ cam @ CALIBRATION
    np.testing.assert_allclose(tum[:, 0], 0.1 * np.arange(NUM_SCANS), atol=1e-9)
    np.testing.assert_allclose(lidar[:, :3, 3], tum[:, 1:4], atol=1e-9)
    np.testing.assert_allclose(lidar[:, :3, :3], Rotation.from_quat(tum[:, 4:]).as_matrix(), atol=1e-9)
    true = np.linalg.inv(CALIBRATION) @ read_rows(tree / "poses" / f"{NAME}.txt") @ CALIBRATION
    assert np.linalg.norm(lidar[:, :3, 3] - true[:, :3, 3], axis=1).max() < 0.5
    assert (folder / "trajectory.png").read_bytes().startswith(b"\x89PNG")
    page = page_data(folder)
    np.testing.assert_allclose(np.transpose(page["track"]), tum[:, 1:4], atol=1e-3)
    np.testing.assert_allclose(np.transpose(page["truth"]), true[:, :3, 3], atol=1e-3)
    assert page["cloud"]["count"] > 1000


def test_what_the_run_says_of_itself(folder, tree, weights_file):
    """Oracle: the options given, the tree as it was written, and the hash of the weights file."""
    facts = json.loads((folder / "run.json").read_text())
    assert facts["state"] == "complete"
    assert facts["frames"] == {"ok": NUM_SCANS}
    assert facts["weights"] == {"name": weights_file, "sha256": hashlib.sha256(Path(weights_file).read_bytes()).hexdigest()}
    assert facts["dataset"] == {"path": str(tree.resolve()), "sequence": None, "name": NAME, "layout": "KITTI odometry sequence"}
    assert facts["sensor"]["elevation_correction_deg"] == 0.0
    assert facts["sensor"]["motion_compensated"] is True
    assert facts["sensor"]["deskew"] == "none: the points carry no times"
    assert facts["poses_kitti_frame"] == "camera"
    assert "not calibrated" in facts["uncertainty"]
    assert set(facts["timing_ms"]) == {"read", "prepare", "solve", "insert"}
    options = tomllib.loads((folder / "config.toml").read_text())
    assert options["run"]["out"] == str(folder)
    assert options["model"]["preprocess"]["max_points"] == 3072


@pytest.mark.parametrize(("options", "kind"), [((), "local"), (("--map", "none"), "none")])
def test_run_with_and_without_a_map(tree, cli, tmp_path, options, kind):
    """Oracle: the option given, a map by default, and the simulator's poses; released weights."""
    code, printed, _ = cli("run", str(tree), *options, "--weights", "delo-base", "--out", str(tmp_path / "out"))
    assert code == 0, printed
    assert json.loads((tmp_path / "out" / "run.json").read_text())["map"] == kind
    assert check_whole(tmp_path / "out") == NUM_SCANS
    true = read_rows(tree / "poses" / f"{NAME}.txt")
    found = read_rows(tmp_path / "out" / "poses_kitti.txt")
    assert np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1).max() < 0.05


def test_a_network_without_a_fine_stage_needs_no_map(tree, cli, tmp_path):
    """Oracle: exit code and sentence; with --map none the same weights run."""
    file = weights.save(tmp_path / "paper", narrow_model("paper", 128), {"name": "paper"})
    done = cli("run", tree, "--weights", str(file), "--out", tmp_path / "out")
    assert done.code == 2
    assert "expected a network with a fine stage" in done.err
    assert "--map none" in done.err
    assert cli("run", tree, "--weights", str(file), "--map", "none", "--out", tmp_path / "out").code == 0


@pytest.mark.parametrize(("method", "bound_m"), [("point-to-plane", 0.1), ("identity", 0.1)])
def test_another_method_leaves_the_same_files(tree, tmp_path, capfd, method, bound_m):
    """Oracle: the simulator's poses of a car that hardly moves, loosely; NaN; the sentence of `delo refine`."""
    out = tmp_path / "out"
    assert main(["run", str(tree), "--method", method, "--out", str(out)]) == 0
    assert "the method does not say how sure it is" in " ".join(capfd.readouterr().out.replace("│", " ").split())
    assert check_whole(out) == NUM_SCANS
    facts = json.loads((out / "run.json").read_text())
    assert (facts["method"], facts["weights"], facts["map"], facts["frames"]) == (method, None, None, {"ok": NUM_SCANS})
    assert facts["uncertainty"].startswith(f"none: {method} does not say")
    assert tomllib.loads((out / "config.toml").read_text())["run"]["method"] == method
    for name in ("covariances", "pose_covariances", "local_covariances"):
        assert np.isnan(np.load(out / f"{name}.npy")).all()
    with (out / "frames.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert all(np.isnan(float(row[name])) for row in rows for name in row if name.startswith("sigma") or name == "confidence")
    true, found = read_rows(tree / "poses" / f"{NAME}.txt"), read_rows(out / "poses_kitti.txt")
    assert np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1).max() < bound_m
    assert main(["eval", str(out)]) == 0
    capfd.readouterr()
    assert main(["refine", str(out)]) == 2
    assert f"expected a run of --method delo, whose covariances say what a motion counts, got one of {method}" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("identity", "--weights", "delo-base"), "--weights: expected a method with a network, got --method identity"),
        (("icp", "--map", "local"), "--map local: expected --method delo, got icp"),
        (("icp", "--refine"), "--refine: expected --method delo"),
        (("dcp",), "--method dcp: expected weights trained by `delo train dcp`, got none"),
        (("dcp", "--weights", "delo-base"), "--method dcp: expected weights of the preset dcp, got the preset base"),
    ],
)
def test_options_that_mean_nothing_to_a_method(tree, tmp_path, capfd, options, words):
    """Oracle: exit code 2, one sentence, and no folder."""
    assert main(["run", str(tree), "--out", str(tmp_path / "out"), "--method", *options]) == 2
    error = capfd.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_same_bytes_twice_in_numbered_folders(folder, tree, cli, monkeypatch, tmp_path):
    """Oracle: the bytes of the run before."""
    monkeypatch.chdir(tmp_path)
    for name in (NAME, f"{NAME}-2"):
        done = cli("run", tree)
        assert done.code == 0
        assert f"runs/{name}" in done.out
        for file in ("poses_kitti.txt", "trajectory.tum", "covariances.npy"):
            assert (tmp_path / "runs" / name / file).read_bytes() == (folder / file).read_bytes()


def test_what_is_printed(tree, cli, tmp_path):
    """Oracle: the parts that the help promises, with units."""
    done = cli("run", tree, "--sequence", NAME, "--out", tmp_path / "out", "--deskew", "on")
    for words in (
        "KITTI odometry sequence",
        "truth: ",
        "elevation correction: none",
        "de-skew: done, with times by azimuth",
        "compiled in ",
    ):
        assert words in done.out
    for words in ("scans/s", " cm ", " deg ", " ms ", "whole scan, p50 / p95", f"ok {NUM_SCANS}", "path below 10 m"):
        assert words in done.out
    assert f"{NUM_SCANS}/{NUM_SCANS}" in done.err  # the bar


def test_compiling_shows_how_far_it_is(tree, cli, monkeypatch, tmp_path):
    """Oracle: on a terminal, which FORCE_COLOR stands for, every part by name and number, and the time; in a file nothing."""
    arguments = "run", tree, "--sequence", NAME, "--out"
    assert "compiling" not in cli(*arguments, tmp_path / "file").err
    for name, value in {"FORCE_COLOR": "1", "TERM": "xterm", "COLUMNS": "120"}.items():
        monkeypatch.setenv(name, value)
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", cli(*arguments, tmp_path / "terminal").err)
    names = "encoder", "solver", "covariance", "learned step", "classical steps", "steps of a sweep"
    for number, name in enumerate(names):
        assert re.search(rf"compiling .* {number}/{len(names)} 0:00:\d\d {name}", shown)


def test_a_folder_with_a_run_is_left_alone(folder, tree, cli):
    """Oracle: the bytes of the run that was there."""
    before = (folder / "run.json").read_bytes()
    done = cli("run", tree, "--out", folder)
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "choose another or delete it" in done.err
    assert (folder / "run.json").read_bytes() == before


def test_a_folder_that_cannot_be_written(tree, cli, tmp_path):
    """Oracle: a file where the folder should be."""
    (tmp_path / "file").write_text("")
    done = cli("run", tree, "--out", tmp_path / "file" / "out")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "expected a folder to write to" in done.err


def test_ctrl_c_keeps_whole_frames(tree, cli, monkeypatch, tmp_path):
    """Oracle: a real SIGINT while scan 3 is read; that frame is finished and nothing after it is begun."""
    read = Dataset.__getitem__

    def read_and_interrupt(self, index):
        if index == 3:
            signal.raise_signal(signal.SIGINT)
        return read(self, index)

    monkeypatch.setattr(Dataset, "__getitem__", read_and_interrupt)
    before = signal.getsignal(signal.SIGINT)  # ignored where the tests run in the background of a shell
    done = cli("run", tree, "--out", tmp_path / "out")
    assert done.code == 1
    assert f"delo: interrupted; 4 of {NUM_SCANS} frames are kept in " in done.err
    assert check_whole(tmp_path / "out") == 4
    assert json.loads((tmp_path / "out" / "run.json").read_text())["state"] == "interrupted"
    assert (tmp_path / "out" / "trajectory.png").exists()
    assert page_data(tmp_path / "out")["n"] == 4
    assert signal.getsignal(signal.SIGINT) is before


def test_kill_leaves_readable_files(scans, weights_file, tmp_path):
    """Oracle: SIGKILL in the middle of a long folder, then independent readers."""
    folder, out = tmp_path / "scans", tmp_path / "out"
    folder.mkdir()
    for index in range(400):
        os.link(scans[index % len(scans)], folder / f"{index:06d}.bin")
    command = [sys.executable, "-m", "delo_jax", "run", str(folder), "--out", str(out), "--weights", weights_file]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 120.0
        while not ((out / "frames.csv").exists() and (out / "frames.csv").read_text().count("\n") > 5):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.02)
        process.kill()
    assert 4 <= check_whole(out) < 400
    assert json.loads((out / "run.json").read_text())["state"] == "running"
