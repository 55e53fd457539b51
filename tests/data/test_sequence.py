import numpy as np
import pytest

from delo_jax.data.sequence import Dataset, azimuth_times, correct_elevation


def test_elevation_is_raised_and_range_and_azimuth_kept():
    """Oracle: spherical coordinates in float64; tolerance is a float32 at 80 m."""
    rng = np.random.default_rng(0)
    distance, azimuth, elevation = rng.uniform(2, 80, 500), rng.uniform(-np.pi, np.pi, 500), rng.uniform(-0.45, 0.1, 500)

    def cartesian(elevation):
        horizontal = distance * np.cos(elevation)
        return np.stack([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), distance * np.sin(elevation)], axis=1)

    points = cartesian(elevation).astype(np.float32)
    lifted = correct_elevation(points, 0.205)
    assert lifted.dtype == np.float32
    np.testing.assert_allclose(lifted, cartesian(elevation + 0.205 * np.pi / 180), atol=2e-5)
    assert (lifted[:, 2] > points[:, 2]).all()


def test_elevation_of_points_without_azimuth():
    """Oracle: closed form; the origin stays, no row that is not finite becomes finite, no warning."""
    points = np.array([[0, 0, 0], [np.nan, 1, 2], [np.inf, 0, 0], [0, 0, 5]], np.float32)
    lifted = correct_elevation(points, 0.205)
    np.testing.assert_array_equal(lifted[0], 0)
    assert not np.isfinite(lifted[1:3]).all(axis=1).any()
    np.testing.assert_allclose(lifted[3, 2], 5 * np.cos(np.deg2rad(0.205)), rtol=1e-6)


def test_azimuth_times_of_a_clockwise_sweep():
    """Oracle: a sensor that starts behind, passes left, ahead (time 0) and right in 0.1035 s; NaN points get 0."""
    points = np.array([[-1, 1e-6, 0], [0, 3, 1], [5, 0, 0], [0, -2, 0], [-1, -1e-6, 0], [np.nan, 0, 0]], np.float32)
    expected = 0.1035 * np.array([-0.5, -0.25, 0.0, 0.25, 0.5, 0.0])
    np.testing.assert_allclose(azimuth_times(points), expected, atol=1e-6)
    np.testing.assert_allclose(azimuth_times(points, sweep_s=0.05), expected * 0.05 / 0.1035, atol=1e-6)


@pytest.mark.parametrize(
    ("stamps_ms", "sweep_s"),
    [
        (None, 0.1035),
        ([0], 0.1035),
        ([0, 100, 200, 300], 0.1),
        ([0, 50, 1000, 1050, 1100], 0.05),
        ([0, 1000, 2000], 0.1035),
        ([0, 10, 20], 0.1035),
    ],
    ids=["none", "one", "10 Hz", "20 Hz and a gap", "a scan a second", "packets"],
)
def test_a_sweep_lasts_as_long_as_scans_are_apart(stamps_ms, sweep_s):
    """Oracle: closed form; KITTI's sweep where stamps are missing or too far from those of a turning sensor."""
    stamps_ns = None if stamps_ms is None else np.array(stamps_ms) * 1_000_000
    assert Dataset(name="", layout="", paths=(), stamps_ns=stamps_ns).sweep_s == pytest.approx(sweep_s)
