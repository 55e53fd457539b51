"""Reads one LiDAR scan from a file of any supported format."""

from pathlib import Path

import numpy as np

from delo_jax.data.arrays import parse_npy, parse_npz
from delo_jax.data.fields import RawScan, scan_from_fields
from delo_jax.data.pcd import parse_pcd
from delo_jax.data.ply import parse_ply
from delo_jax.errors import ScanError

BIN_COLUMNS = (4, 5, 3, 6)  # in order of preference
_COUNTS = range(2, 13)  # those told apart
_BLOCK = 60  # rows, or values where there are no rows yet
_SAMPLE = 8_000  # values looked at; a whole scan would cost more than reading it
# Two columns are no worse than four for a table of two, and 0.9 or more worse for a true four. Interleaved rings make x y z x y z
# unlike too, and x y z i x y z i: by up to 0.5 on an HDL-32; true columns differ by 1.1 and more.
_HANDICAPS = {columns: -0.3 if columns == 2 else 0.0 if columns < 6 else 0.8 for columns in _COUNTS}
_MAX_BYTES = 1 << 31
_NEAREST, _FARTHEST = 1e-3, 1e4  # m


def read_scan(path: str | Path, *, bin_columns: int | None = None) -> RawScan:
    """Points, and their times where the file has them, of one scan.

    Formats, by suffix: .bin (float32 rows, see `parse_bin`), .pcd (ASCII, binary, binary_compressed), .ply (ASCII, binary), .npy
    ((n, 3 or more) or structured), .npz (`xyz` or `points`, and `time`).

    Args:
        path: the file.
        bin_columns: columns that a .bin must have, where that is known.

    Returns:
        Points in the sensor frame [m], unfiltered, and times relative to the stamp [s].

    Raises:
        ScanError: missing, empty, unreadable, damaged or of another content; one sentence that names the file.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ScanError(f"{path}: expected a scan file ({', '.join(SUFFIXES)}), got {path.suffix!r}; convert it first")
    try:
        with np.errstate(all="ignore"):  # damaged values overflow; preprocessing drops what is not finite
            data = _read_bytes(path)
            return parse_bin(data, columns=bin_columns) if suffix == ".bin" else _PARSERS[suffix](data)
    except ScanError as error:
        raise ScanError(f"{path}: {error}") from None


def parse_bin(data: bytes, *, columns: int | None = None) -> RawScan:
    """Scan of raw little-endian float32 rows: x y z, then 0 to 3 more columns (KITTI 4, nuScenes 5).

    The file does not say how many columns it has. We take the count that keeps unlike quantities apart: for the true count each column
    is one quantity, for a wrong one it is a mixture, whose log variance is larger (Jensen). Counts within the noise of the best are
    ties, and go to the first of 4, 5, 3, 6 of which the file is whole rows (six columns have to be clearly better than three). A file
    that is clearly of another count, up to twelve, is refused. In files of less than 60 values all counts are ties.

    Args:
        data: the file.
        columns: the count, where it is known; a file that is clearly of another one is refused.

    Raises:
        ScanError: empty, not whole rows of that count, or values that are no coordinates in metres.
    """
    values = np.frombuffer(data[: len(data) // 4 * 4], "<f4")
    columns = _num_columns(values, len(data), BIN_COLUMNS if columns is None else (columns,))
    if len(data) % (4 * columns):
        raise ScanError(
            f"expected whole points of {columns} float32 values ({4 * columns} bytes each), got {len(data)} bytes; "
            "the file is cut short or no scan: copy it again"
        )
    points = values.reshape(-1, columns)[:, :3].astype(np.float32)
    sample = points[:: max(1, len(points) // 10_000)]
    sizes = np.abs(sample[np.isfinite(sample).all(axis=1)]).max(axis=1)
    sizes = sizes[sizes > 0]  # a zero row is a beam without return
    if len(sizes) and np.mean((sizes > _NEAREST) & (sizes < _FARTHEST)) < 0.9:
        reason = f"coordinates of 1 mm to 10 km, got {sizes.min():.3g} to {sizes.max():.3g} m"
        raise ScanError(f"expected {reason}; the file is damaged or of another format")
    return RawScan(points, None)


def _num_columns(values, num_bytes, accepted):
    """The first of the accepted counts that may be the true one and makes whole rows, else the first that may be the true one."""
    likely = _likely_columns(values)
    usable = [columns for columns in accepted if columns in likely]
    if not usable:
        wanted, got = " or ".join(map(str, sorted(accepted))), likely[0]
        raise ScanError(f"expected rows of {wanted} float32 values, got values that look like rows of {got}; write x y z reflectance")
    return next((columns for columns in usable if num_bytes % (4 * columns) == 0), usable[0])


def _likely_columns(values):
    """Column counts whose score is within the noise of the best, in order; all where there is nothing to tell them by."""
    if len(values) < _BLOCK or not (np.abs(values) > _NEAREST).any():
        return list(_COUNTS)
    every = max(1, len(values) // _SAMPLE)
    scores = {}
    for columns in _COUNTS:
        block = min(_BLOCK, len(values) // columns) * columns  # rows in a block take every phase of a wrong count
        blocks = values[: len(values) // block * block].reshape(-1, block)[::every]
        sample = np.clip(np.nan_to_num(blocks.reshape(-1, columns), nan=0.0), -_FARTHEST, _FARTHEST)
        scores[columns] = float(np.mean(np.log(sample.var(axis=0, dtype=np.float64) + 1e-6))) + _HANDICAPS[columns]
    noise = max(0.1, 8.0 / np.sqrt(min(len(values), _SAMPLE)))  # of a log variance over that many rows of four
    limit = min(scores.values()) + noise
    return [columns for columns in _COUNTS if scores[columns] <= limit]


def _read_bytes(path):
    try:
        if not path.exists():
            raise ScanError("expected a scan file, got nothing at this path; check the name")
        if not path.is_file():
            raise ScanError("expected a scan file, got a folder or device; give the path of one file")
        size = path.stat().st_size
        if not 0 < size <= _MAX_BYTES:
            raise ScanError(f"expected 1 to {_MAX_BYTES} bytes, got {size}; an empty file means that its copy or recording failed")
        return path.read_bytes()
    except OSError as error:
        raise ScanError(f"expected a readable file, got {error.strerror or error}; check its permissions") from None


_PARSERS = {
    ".pcd": lambda data: scan_from_fields(parse_pcd(data)),
    ".ply": lambda data: scan_from_fields(parse_ply(data)),
    ".npy": parse_npy,
    ".npz": parse_npz,
}
SUFFIXES = (".bin", *_PARSERS)
