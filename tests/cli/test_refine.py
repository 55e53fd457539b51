import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from delo_jax import inference, weights
from delo_jax.cli import refine as command
from delo_jax.cli import refinement
from delo_jax.geometry import se3
from delo_jax.inference import Estimate
from delo_jax.refine import refiner
from tests.refine.graphs import SIGMAS
from tests.refine.test_loops import graph, round_trip
from tests.report.pages import page_data

NAME = "mixed-50"
CALIBRATION = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])  # that the tree is written with
FILES = ("refined.tum", "refined_kitti.txt", "refined_covariances.npy")


@pytest.fixture(scope="module")
def folder(tree, tmp_path_factory):
    """A run over the tree that was refined on the way, with the released weights."""
    from delo_jax.cli import main

    out = tmp_path_factory.mktemp("run") / "out"
    assert main(["run", str(tree), "--out", str(out), "--refine"]) == 0
    return out


def test_files_agree_with_each_other_and_with_the_truth(folder, tree):
    """Oracle: SciPy rotations between the two files, and the simulator's poses."""
    tum, cam = np.loadtxt(folder / "refined.tum"), np.loadtxt(folder / "refined_kitti.txt").reshape(-1, 3, 4)
    cam = np.concatenate([cam, np.tile([[[0.0, 0, 0, 1]]], (len(cam), 1, 1))], axis=1)
    lidar = np.linalg.inv(CALIBRATION) @ cam @ CALIBRATION
    np.testing.assert_allclose(lidar[:, :3, 3], tum[:, 1:4], atol=1e-8)
    np.testing.assert_allclose(lidar[:, :3, :3], Rotation.from_quat(tum[:, 4:]).as_matrix(), atol=1e-8)
    true = np.loadtxt(tree / "poses" / f"{NAME}.txt").reshape(-1, 3, 4)
    assert np.linalg.norm(cam[:, :3, 3] - true[:, :, 3], axis=1).max() < 0.02  # of 6 cm that it moves
    covariances = np.load(folder / "refined_covariances.npy")
    assert covariances.shape == (len(tum), 6, 6)
    assert np.linalg.eigvalsh(covariances)[1:].min() > 0.0


def test_refined_later_is_refined_on_the_way(folder, cli, tmp_path):
    """Oracle: the run that was refined in the second thread; the same passes on the same scans, read again."""
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy, ignore=shutil.ignore_patterns("refined*"))
    done = cli("refine", copy)
    assert done.code == 0, done.err
    assert "multi-frame" in done.out
    assert "ATE" in done.out
    for name in FILES[:2]:
        np.testing.assert_allclose(np.loadtxt(copy / name), np.loadtxt(folder / name), atol=1e-5)
    for path in (copy, folder):
        np.testing.assert_allclose(np.transpose(page_data(path)["refined"]), np.loadtxt(path / FILES[0])[:, 1:4], atol=1e-3)
    ours, first = (np.load(path / FILES[2]) for path in (copy, folder))
    np.testing.assert_allclose(ours, first, rtol=1e-2, atol=1e-9)


def test_scans_that_were_moved_keep_their_truth(folder, tree, cli, tmp_path):
    """Oracle: the rows of errors, from the tree where it is now."""
    copy, moved = tmp_path / "copy", tmp_path / "moved"
    shutil.copytree(folder, copy)
    shutil.copytree(tree, moved)
    facts = json.loads((copy / "run.json").read_text())
    (copy / "run.json").write_text(json.dumps(facts | {"dataset": facts["dataset"] | {"path": str(tmp_path / "gone")}}))
    done = cli("refine", copy, "--data", moved)
    assert done.code == 0, done.err
    assert "ATE" in done.out


def test_a_failing_refinement_leaves_the_run_whole(tree, cli, tmp_path, monkeypatch):
    """Oracle: a pass that raises in the second thread: the sentence, and the files of a complete run."""

    def broken(*_):
        raise RuntimeError("no pass")

    monkeypatch.setattr(refiner.Refiner, "_pair", broken)
    done = cli("run", tree, "--refine", "--weights", "delo-base", "--out", tmp_path / "out")
    assert done.code == 0
    assert "delo: not refined: refinement: RuntimeError: no pass" in done.err
    assert json.loads((tmp_path / "out" / "run.json").read_text())["state"] == "complete"
    assert len(np.loadtxt(tmp_path / "out" / "trajectory.tum")) == 8
    assert not (tmp_path / "out" / "refined.tum").exists()


class Numbers(command.Scans):
    """Scans that are numbers, as far as loops are concerned."""

    def __init__(self, num):
        self.params = weights.load()
        self.frames = SimpleNamespace(rejected=np.zeros(num, bool))  # type: ignore[assignment]

    def again(self, number):  # type: ignore[override]
        """The number."""
        return number


def record_of(plan):
    """What a refiner would have kept of this odometry."""
    C, rows = np.zeros((6, 6)), plan.factors
    frames = [refiner.Tracked(0, plan.Ts_world_lidar[0], C, 0 * C, None)]
    for source, T_step, step in zip(rows.sources, rows.Ts_source_target, rows.covariances, strict=True):
        C = se3.compose_covariance(C, step, T_step)
        frames.append(refiner.Tracked(int(source), plan.Ts_world_lidar[source + 1], C, 0 * C, None))
    return refiner.Record(frames=frames)


def test_loops_are_aligned_there_and_back(monkeypatch):
    """Oracle: a circle driven twice: an alignment that knows where each scan was taken, without a prior, closes it."""
    Ts = round_trip()

    def align(params, source, target, T_init):
        np.testing.assert_array_equal(T_init, np.eye(4))
        return replace(Estimate.exact(se3.inverse(Ts[target]) @ Ts[source]), covariance=np.diag(SIGMAS**2))

    monkeypatch.setattr(inference, "align", align)
    kept = command._loops(Numbers(len(Ts)), record_of(graph(Ts)))
    assert len(kept.sources) > 4
    expected = se3.inverse(Ts[kept.sources]) @ Ts[kept.targets]
    np.testing.assert_allclose(kept.Ts_source_target, expected, atol=1e-9)


def test_the_other_backend_is_asked(folder, cli, tmp_path, monkeypatch):
    """Oracle: the plan reaches it, and its poses the files; both backends are compared elsewhere."""
    asked = []

    def stand_in(plan):
        asked.append(plan)
        return refinement.BACKENDS["gtsam"](plan)

    monkeypatch.setitem(refinement.BACKENDS, "jax", stand_in)
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy, ignore=shutil.ignore_patterns("refined*"))
    assert cli("refine", copy, "--backend", "jax", "--no-loops").code == 0
    assert len(asked) == 1
    np.testing.assert_allclose(np.loadtxt(copy / FILES[0]), np.loadtxt(folder / FILES[0]), atol=1e-5)


def test_eval_takes_the_refined_poses(folder, cli, tmp_path):
    """Oracle: poses that were moved by 10 m after the second frame."""
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    rows = np.loadtxt(copy / "refined_kitti.txt")
    rows[2:, 11] += 10.0
    np.savetxt(copy / "refined_kitti.txt", rows)
    plain, refined = cli("eval", copy), cli("eval", copy, "--refined")
    assert (plain.code, refined.code) == (0, 0)
    assert " 4.3" in refined.out  # ATE: two frames of eight are 10 m off the others, sqrt(2 * 6) / 8 * 10
    assert " 4.3" not in plain.out


def test_what_cannot_be_refined_is_said(folder, cli, tmp_path):
    """Oracle: exit code and sentence; no run, a simulated one, scans that are gone, files that are gone."""
    assert "expected the folder of a run" in cli("refine", tmp_path).err
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    facts = json.loads((copy / "run.json").read_text())
    for path, says in ((None, "expected a run on stored scans"), (str(tmp_path / "gone"), "got nothing")):
        (copy / "run.json").write_text(json.dumps(facts | {"dataset": facts["dataset"] | {"path": path}}))
        done = cli("refine", copy)
        assert done.code == 2
        assert says in done.err
    (copy / "run.json").write_text(json.dumps(facts | {"weights": facts["weights"] | {"sha256": "0"}}))
    assert "expected the weights that it was made with" in cli("refine", copy).err
    (copy / "run.json").write_text(json.dumps(facts))
    (copy / "local_covariances.npy").unlink()
    done = cli("refine", copy)
    assert done.code == 2
    assert "expected the files of a run" in done.err
