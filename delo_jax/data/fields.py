"""From named columns of a scan file to points and point times."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64

from delo_jax.errors import ScanError

TIME_NAMES = ("t", "time", "times", "timestamp", "timestamps", "offset", "offset_time", "time_offset", "point_time")
UNITS = (1.0, 1e-3, 1e-6, 1e-9)  # s, ms, us, ns
MAX_SWEEP_S = 1.0
"""Farthest from its stamp that a point of a scan is measured; a larger time is one of a clock."""
FRAME_PERIOD_NS = 100_000_000
"""Time between scans that carry no stamp."""


class RawScan(NamedTuple):
    """One sweep as its file holds it, nothing filtered.

    Stored times that are offsets are relative to the stamp, wherever in the sweep that is, and are delivered as they are. Times of a
    clock say nothing of the stamp: it is taken to be the middle of the sweep.
    """

    points: Float32[np.ndarray, "n 3"]
    """Sensor frame [m]; NaN, infinite and zero rows are kept, preprocessing drops them."""
    times: Float64[np.ndarray, " n"] | None
    """Seconds relative to the stamp, finite; None where the file has none."""


def scan_from_fields(fields: Mapping[str, np.ndarray]) -> RawScan:
    """Scan of columns x, y, z and, where there is one, a time column (one of `TIME_NAMES`); names in any case.

    Raises:
        ScanError: no x, y, z.
    """
    fields = {name.lower(): values for name, values in fields.items()}
    if not {"x", "y", "z"} <= fields.keys():
        raise ScanError(f"expected fields x, y, z, got {', '.join(fields) or 'none'}; rename the fields of the file")
    points = np.stack([np.asarray(fields[name]).astype(np.float32) for name in "xyz"], axis=-1)
    name = next((name for name in TIME_NAMES if name in fields), None)
    times = None if name is None else relative_times(np.asarray(fields[name]), is_return=(points != 0).any(axis=-1))
    return RawScan(points, times)


def relative_times(values: np.ndarray, *, is_return: Bool[np.ndarray, " n"]) -> Float64[np.ndarray, " n"] | None:
    """Point times in seconds relative to the stamp of the scan.

    The unit is the coarsest of s, ms, us, ns in which the sweep lasts at most 2 s; integers are never seconds. Times within 1 s of 0 are
    offsets from the stamp and stay as they are; larger ones count from an epoch and become relative to the middle of the sweep.

    Args:
        values: (n,) times of any unit and origin.
        is_return: rows that hold a measured point; others may carry a time of 0 amid absolute ones, and get the sweep's middle.

    Returns:
        Finite times [s], or None where the values do not differ or fit no unit.
    """
    units = UNITS[1:] if values.dtype.kind in "iu" else UNITS
    values = values.astype(np.float64)
    known = np.isfinite(values) & is_return
    if not known.any():
        return None
    low, high = values[known].min(), values[known].max()
    unit = next((unit for unit in units if (high - low) * unit <= 2 * MAX_SWEEP_S), None)
    if unit is None or low == high:
        return None
    middle = low + (high - low) / 2
    origin = 0.0 if max(-low, high) * unit <= MAX_SWEEP_S else middle
    return (np.where(known, values, middle) - origin) * unit


def parse_ascii(tokens: Sequence[bytes], dtypes: Sequence[np.dtype], *, num_rows: int) -> list[np.ndarray]:
    """Columns, one per dtype, of a table of numbers written as text, row after row.

    Raises:
        ScanError: fewer than `num_rows` whole rows, or something that is no number.
    """
    needed = num_rows * len(dtypes)
    if len(tokens) < needed:
        raise ScanError(
            f"expected {num_rows} points of {len(dtypes)} numbers, got {len(tokens)} numbers; the file is cut short or its header wrong"
        )
    try:
        table = np.array([float(token) for token in tokens[:needed]]).reshape(num_rows, len(dtypes))
    except ValueError as error:
        raise ScanError(f"expected numbers, got {error}; the file is damaged") from None
    return [table[:, column].astype(dtype) for column, dtype in enumerate(dtypes)]
