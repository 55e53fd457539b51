"""Reads one LiDAR scan from a file of any supported format."""

from pathlib import Path

import numpy as np

from delo_jax.data.arrays import parse_npy, parse_npz
from delo_jax.data.fields import RawScan, scan_from_fields
from delo_jax.data.pcd import parse_pcd
from delo_jax.data.ply import parse_ply
from delo_jax.errors import ScanError

BIN_COLUMNS = (4, 5, 3, 6)  # in order of preference
_BLOCK = 60  # their least common multiple: blocks of it keep every column in place
_SIX_COLUMN_HANDICAP = 0.8  # interleaved rings make x y z x y z unlike too: 0.5 on an HDL-32; six true columns differ by 1.1 and more
_MAX_BYTES = 1 << 31
_NEAREST, _FARTHEST = 1e-3, 1e4  # m


def read_scan(path: str | Path) -> RawScan:
    """Points, and their times where the file has them, of one scan.

    Formats, by suffix: .bin (float32 rows, see `parse_bin`), .pcd (ASCII, binary, binary_compressed), .ply (ASCII, binary), .npy
    ((n, 3 or more) or structured), .npz (`xyz` or `points`, and `time`).

    Args:
        path: the file.

    Returns:
        Points in the sensor frame [m], unfiltered, and times relative to the middle of the sweep [s].

    Raises:
        ScanError: missing, empty, unreadable, damaged or of another content; one sentence that names the file.
    """
    path = Path(path)
    parse = _PARSERS.get(path.suffix.lower())
    if parse is None:
        raise ScanError(f"{path}: expected a scan file ({', '.join(SUFFIXES)}), got {path.suffix!r}; convert it first")
    try:
        with np.errstate(all="ignore"):  # damaged values overflow; preprocessing drops what is not finite
            return parse(_read_bytes(path))
    except ScanError as error:
        raise ScanError(f"{path}: {error}") from None


def parse_bin(data: bytes) -> RawScan:
    """Scan of raw little-endian float32 rows: x y z, then 0 to 3 more columns (KITTI 4, nuScenes 5).

    The file does not say how many columns it has. We take the count that keeps unlike quantities apart: for the true count each column
    is one quantity, for a wrong one it is a mixture, whose log variance is larger (Jensen). Counts within the noise of the best are
    ties, and go to the first of 4, 5, 3, 6 of which the file is whole rows (six columns have to be clearly better than three). In
    files of less than 60 values all counts are ties.

    Raises:
        ScanError: empty, not whole rows of that count, or values that are no coordinates in metres.
    """
    values = np.frombuffer(data[: len(data) // 4 * 4], "<f4")
    columns = _num_columns(values, len(data))
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


def _num_columns(values, num_bytes):
    likely = BIN_COLUMNS if len(values) < _BLOCK else _likely_columns(values)
    return next((columns for columns in likely if num_bytes % (4 * columns) == 0), likely[0])


def _likely_columns(values):
    """Column counts whose score is within the noise of the best, in order of preference."""
    blocks = values[: len(values) // _BLOCK * _BLOCK].reshape(-1, _BLOCK)
    blocks = blocks[:: max(1, len(blocks) // 1000)]
    sample = np.clip(np.nan_to_num(blocks, nan=0.0), -_FARTHEST, _FARTHEST)
    scores = [float(np.mean(np.log(sample.reshape(-1, columns).var(axis=0, dtype=np.float64) + 1e-6))) for columns in BIN_COLUMNS]
    scores[BIN_COLUMNS.index(6)] += _SIX_COLUMN_HANDICAP
    noise = max(0.1, 4.0 / np.sqrt(sample.size / 4))  # of a log variance over that many rows
    return [columns for columns, score in zip(BIN_COLUMNS, scores, strict=True) if score <= min(scores) + noise]


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
    ".bin": parse_bin,
    ".pcd": lambda data: scan_from_fields(parse_pcd(data)),
    ".ply": lambda data: scan_from_fields(parse_ply(data)),
    ".npy": parse_npy,
    ".npz": parse_npz,
}
SUFFIXES = tuple(_PARSERS)
