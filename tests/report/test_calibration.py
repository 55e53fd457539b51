"""Pictures of calibration."""

import matplotlib.image
import numpy as np
import pytest

from delo_jax.report.calibration import cutoff_figure, error_figure, gap_figure, ratios_figure, reliability_figure

AXES = ("roll", "pitch", "yaw", "forward", "lateral", "vertical")


def is_a_picture(path):
    """Oracle of every test here: matplotlib's own reader finds a picture that is large enough and not of one colour."""
    image = matplotlib.image.imread(path)
    return min(image.shape[:2]) > 400 and np.std(image[..., :3]) > 0.01


def test_reliability_of_any_levels(tmp_path):
    """Oracle: is_a_picture, without a warning; and the same bytes from the same input."""
    observed = {level: np.clip(level + np.linspace(-0.1, 0.1, 6), 0.0, 1.0) for level in (0.95, 0.5, 0.68)}
    for name in ("first.png", "second.png"):
        reliability_figure(tmp_path / name, observed, AXES, title="pairs")
    assert is_a_picture(tmp_path / "first.png")
    assert (tmp_path / "first.png").read_bytes() == (tmp_path / "second.png").read_bytes()


@pytest.mark.parametrize(("num_pairs", "num_axes"), [(1, 1), (5, 4), (500, 6)])
def test_errors_of_any_number(num_pairs, num_axes, tmp_path):
    """Oracle: is_a_picture, without a warning, also where an error is 0."""
    rng = np.random.default_rng(0)
    sigmas = np.exp(rng.normal(size=(num_pairs, num_axes)))
    errors = sigmas * rng.normal(size=(num_pairs, num_axes))
    errors[0] = 0.0
    error_figure(tmp_path / "e.png", errors, sigmas, AXES[:num_axes], ["mrad"] * num_axes, title="pairs")
    assert is_a_picture(tmp_path / "e.png")


def test_ratios_of_conditions(tmp_path):
    """Oracle: is_a_picture."""
    ratios_figure(tmp_path / "r.png", {"rain": np.linspace(1.0, 5.0, 6), "gap 10": np.full(6, 30.0)}, AXES, bound=1.5)
    assert is_a_picture(tmp_path / "r.png")


def test_errors_by_confidence(tmp_path):
    """Oracle: is_a_picture."""
    cutoffs = np.linspace(0.0, 0.95, 20)
    curves = {f"gap {gap}": gap * (2.0 - cutoffs[:, None]) * np.arange(1.0, 7.0) for gap in (1, 2)}
    cutoff_figure(tmp_path / "c.png", cutoffs, curves, AXES, ["mrad"] * 6, thresholds=(0.2, 0.7), title="pairs")
    assert is_a_picture(tmp_path / "c.png")


def test_doubt_by_gap(tmp_path):
    """Oracle: is_a_picture; other numbers of pairs at each gap."""
    rng = np.random.default_rng(0)
    doubts = {gap: gap * np.exp(0.3 * rng.normal(size=(count, 6))) for gap, count in ((1, 30), (2, 20), (200, 5))}
    gap_figure(tmp_path / "g.png", doubts, AXES, ["mrad"] * 6, title="drives")
    assert is_a_picture(tmp_path / "g.png")
