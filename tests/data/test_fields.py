import numpy as np
import pytest

from delo_jax.data.fields import MAX_SWEEP_S, relative_times, scan_from_fields
from delo_jax.errors import ScanError

ALL = np.ones(101, dtype=bool)
EXPECTED = np.linspace(-0.05, 0.05, 101)


@pytest.mark.parametrize(
    "values",
    [
        1.7e9 + np.linspace(0, 0.1, 101),
        (17 * 10**17 + np.linspace(0, 1e8, 101)).astype(np.uint64),
        1.7e18 + np.linspace(0, 1e8, 101),
    ],
    ids=["s", "ns", "ns as float"],
)
def test_times_of_an_epoch_become_relative_to_mid_sweep(values):
    """Oracle: closed form, a sweep of 0.1 s; 1 us for what float64 keeps of an epoch."""
    np.testing.assert_allclose(relative_times(values, is_return=ALL), EXPECTED, atol=1e-6)


@pytest.mark.parametrize(
    ("values", "unit"),
    [
        (np.linspace(0, 0.1, 101), 1.0),
        (np.linspace(-0.1, 0, 101, dtype=np.float32), 1.0),
        (np.linspace(-0.02, 0.08, 101), 1.0),
        (np.linspace(0.01, 0.11, 101), 1.0),
        (np.linspace(0, 100, 101), 1e-3),
        (np.linspace(0, 1e5, 101).astype(np.float32), 1e-6),
        (np.linspace(0, 1e8, 101).astype(np.uint32), 1e-9),
    ],
    ids=["s", "s before", "s around", "s after", "ms", "us", "ns"],
)
def test_offsets_stay_as_stored(values, unit):
    """Oracle: the values themselves, in seconds, wherever in the sweep the stamp is."""
    np.testing.assert_allclose(relative_times(values, is_return=ALL), values * unit, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("smallest", [-1e-4, -1e-9, 0.0, 1e-9, 1e-4])
def test_jitter_around_zero_does_not_move_the_stamp(smallest):
    """Oracle: the values themselves; the sign of the smallest one decides nothing."""
    values = np.linspace(0, 0.1, 101)
    values[0] = smallest
    np.testing.assert_array_equal(relative_times(values, is_return=ALL), values)


@pytest.mark.parametrize("last", [MAX_SWEEP_S, MAX_SWEEP_S + 1e-3])
def test_the_farthest_offset(last):
    """Oracle: closed form on either side of the limit."""
    values = np.linspace(last - 0.1, last, 101)
    expected = values if last == MAX_SWEEP_S else EXPECTED
    np.testing.assert_allclose(relative_times(values, is_return=ALL), expected, atol=1e-12)


def test_rows_without_a_return_and_nan_times_get_zero():
    """Oracle: closed form; a 0 amid absolute times would be 54 years before the sweep."""
    values = 1.7e9 + np.linspace(0, 0.1, 101)
    is_return = ALL.copy()
    values[50], values[20], is_return[50] = 0.0, np.nan, False
    expected = EXPECTED.copy()
    expected[[20, 50]] = 0.0
    np.testing.assert_allclose(relative_times(values, is_return=is_return), expected, atol=1e-6)


@pytest.mark.parametrize("values", [np.full(101, 5.0), np.full(101, np.nan), np.linspace(0, 1e300, 101)])
def test_times_that_say_nothing(values):
    """Oracle: None, where all are one, none is finite, or no unit fits."""
    with np.errstate(over="ignore"):
        assert relative_times(values, is_return=ALL) is None


def test_names_in_any_case_and_order():
    """Oracle: the columns themselves."""
    scan = scan_from_fields({"Z": np.array([3.0]), "intensity": np.array([9]), "X": np.array([1]), "y": np.array([2.0])})
    np.testing.assert_array_equal(scan.points, [[1, 2, 3]])
    assert scan.points.dtype == np.float32
    with pytest.raises(ScanError, match="expected fields x, y, z, got x, y;"):
        scan_from_fields({"x": np.array([1.0]), "y": np.array([1.0])})
