"""Times of scans and of their points, as they come from outside."""

import numpy as np

from delo_jax.data.fields import FRAME_PERIOD_NS, MAX_SWEEP_S
from delo_jax.errors import ScanError


def checked_stamp(stamp_ns: int | None, last_stamp_ns: int | None) -> int:
    """The stamp of the next scan; 0.1 s after the last one when None, 0 for the first.

    Raises:
        ScanError: a stamp that does not rise.
    """
    if stamp_ns is None:
        return 0 if last_stamp_ns is None else last_stamp_ns + FRAME_PERIOD_NS
    if last_stamp_ns is not None and stamp_ns <= last_stamp_ns:
        raise ScanError(f"stamp_ns: expected more than the last stamp {last_stamp_ns}, got {stamp_ns}; sort the scans by time")
    return int(stamp_ns)


def checked_times(times_s: np.ndarray | None, num_points: int) -> np.ndarray | None:
    """Times of the points relative to the stamp [s]; None stays None.

    Raises:
        ScanError: another number of them, another kind, or too far from the stamp.
    """
    if times_s is None:
        return None
    times_s = np.asarray(times_s)
    if times_s.shape != (num_points,):
        raise ScanError(f"times_s: expected one time per point, shape ({num_points},), got {times_s.shape}")
    if times_s.dtype.kind not in "fiu":
        raise ScanError(f"times_s: expected numbers, got dtype {times_s.dtype}; convert to float64")
    farthest_s = np.max(np.abs(times_s), initial=0.0, where=np.isfinite(times_s))
    if farthest_s > MAX_SWEEP_S:
        raise ScanError(f"times_s: expected seconds relative to the stamp, within {MAX_SWEEP_S:g} s, got {farthest_s:g} s")
    return times_s
