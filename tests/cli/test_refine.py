import json
import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

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
    assert np.linalg.norm(cam[:, :3, 3] - true[:, :, 3], axis=1).max() < 0.05
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
    ours, first = (np.load(path / FILES[2]) for path in (copy, folder))
    np.testing.assert_allclose(ours, first, rtol=1e-2, atol=1e-9)


def test_the_other_backend_gives_the_same_poses(folder, cli, tmp_path):
    """Oracle: GTSAM's."""
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy, ignore=shutil.ignore_patterns("refined*"))
    assert cli("refine", copy, "--backend", "jax", "--no-loops").code == 0
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
    (copy / "run.json").write_text(json.dumps(facts))
    (copy / "local_covariances.npy").unlink()
    done = cli("refine", copy)
    assert done.code == 2
    assert "expected the files of a run" in done.err
