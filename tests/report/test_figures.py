import subprocess
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from delo_jax.report.figures import scene_figure, trajectory_figure


def drive(num_frames, *, step_m=1.2, yaw_step=0.02):
    yaw = yaw_step * np.arange(num_frames)
    Ts = np.tile(np.eye(4), (num_frames, 1, 1))
    Ts[:, :3, :3] = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    Ts[1:, :2, 3] = np.cumsum(step_m * np.stack([np.cos(yaw), np.sin(yaw)], axis=1), axis=0)[:-1]
    return Ts


def sigmas_of(num_frames):
    sigmas = np.tile([5e-4, 5e-4, 2e-4, 0.01, 0.01, 0.02], (num_frames, 1)) * (1.0 + 0.3 * np.sin(np.arange(num_frames)))[:, None]
    sigmas[0] = 0.0
    return sigmas


def is_a_picture(path):
    """Oracle of every test here: matplotlib's own reader finds a picture that is large enough and not of one colour."""
    image = matplotlib.image.imread(path)
    return min(image.shape[:2]) > 500 and np.std(image[..., :3]) > 0.01


@pytest.mark.parametrize("num_frames", [1, 2, 150])
@pytest.mark.parametrize("step_m", [0.0, 1.2], ids=["standing", "driving"])
def test_trajectory_of_any_length_and_extent(num_frames, step_m, tmp_path):
    """Oracle: is_a_picture, without a warning."""
    Ts = drive(num_frames, step_m=step_m)
    trajectory_figure(tmp_path / "t.png", Ts, ["ok"] * num_frames, sigmas=sigmas_of(num_frames), confidences=np.full(num_frames, 0.9))
    assert is_a_picture(tmp_path / "t.png")


def test_trajectory_with_truth_and_every_status(tmp_path):
    """Oracle: is_a_picture; and the same bytes from the same input."""
    Ts = drive(120)
    statuses = ["ok"] * 120
    statuses[30:33], statuses[70], statuses[71] = ["low_confidence"] * 3, "rejected", "degenerate"
    for name in ("first.png", "second.png"):
        trajectory_figure(tmp_path / name, Ts, statuses, sigmas=sigmas_of(120), truth=drive(118, yaw_step=0.021), title="drive")
    assert is_a_picture(tmp_path / "first.png")
    assert (tmp_path / "first.png").read_bytes() == (tmp_path / "second.png").read_bytes()


def test_trajectory_alone(tmp_path):
    """Oracle: is_a_picture."""
    trajectory_figure(tmp_path / "t.png", drive(20), ["ok"] * 20)
    assert is_a_picture(tmp_path / "t.png")


@pytest.mark.parametrize("num_points", [0, 1, 3000])
def test_scene_of_a_few_scans(num_points, tmp_path):
    """Oracle: is_a_picture, without a warning."""
    rng = np.random.default_rng(0)
    scans = [rng.uniform([-40, -20, -2], [40, 20, 4], size=(num_points, 3)).astype(np.float32) for _ in range(3)]
    scene_figure(tmp_path / "s.png", scans, drive(30), scan_indices=[0, 14, 29], max_points=5000, title="map")
    assert is_a_picture(tmp_path / "s.png")


def test_no_display_and_no_pyplot():
    """Oracle: the modules of a fresh interpreter; pyplot would look for a display and keep every figure alive."""
    code = "import sys, delo_jax.report.figures; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2]).returncode == 0
