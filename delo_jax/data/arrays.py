"""NumPy files: .npy and .npz, read without pickle and without trusting their headers."""

import ast
import io
import zipfile
from pathlib import PurePosixPath

import numpy as np

from delo_jax.data.fields import TIME_NAMES, RawScan, relative_times, scan_from_fields
from delo_jax.errors import ScanError

POINT_KEYS = ("xyz", "points", "pts", "point_cloud", "pointcloud", "cloud", "pc", "scan", "lidar", "data", "arr_0")
_MAX_COLUMNS = 64
_MAX_MEMBER = 1 << 30
_MAX_HEADER = 1 << 14


def parse_npy(data: bytes) -> RawScan:
    """Scan of a .npy file: (n, 3 or more) numbers, the first three x y z, or a structured array with fields x, y, z.

    Raises:
        ScanError: damaged, pickled, or of another shape.
    """
    return _scan_from_array(_array(data))


def parse_npz(data: bytes) -> RawScan:
    """Scan of a .npz file: points under one of `POINT_KEYS` or as x, y, z; times under the first of `TIME_NAMES` with more than one value.

    Raises:
        ScanError: damaged, no such key, or times of another length than the points.
    """
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
        members = {PurePosixPath(name).stem.lower(): name for name in archive.namelist() if name.endswith(".npy")}
    except Exception as error:  # zipfile raises half a dozen types on damaged archives
        raise ScanError(f"expected a .npz archive, got {error}; the file is damaged") from None
    key = next((key for key in POINT_KEYS if key in members), None)
    if key is not None:
        scan = _scan_from_array(_array(_member(archive, members[key])))
    elif {"x", "y", "z"} <= members.keys():
        columns = {name: _array(_member(archive, members[name])).reshape(-1) for name in "xyz"}
        if len({len(column) for column in columns.values()}) != 1:
            raise ScanError("expected x, y, z of one length, got different ones; save them from the same scan")
        scan = scan_from_fields(columns)
    else:
        raise ScanError(f"expected points under a key such as 'xyz' or 'points', got {', '.join(members) or 'no arrays'}; rename it")
    candidates = ((key, _array(_member(archive, members[key])).reshape(-1)) for key in TIME_NAMES if key in members)
    time_key, times = next(((key, times) for key, times in candidates if len(times) > 1), (None, None))  # a single one is the scan's stamp
    if times is None:
        return scan
    if len(times) != len(scan.points) or times.dtype.kind not in "iuf":
        raise ScanError(f"expected one number in {time_key!r} per point ({len(scan.points)}), got {len(times)}; save them together")
    return RawScan(scan.points, relative_times(times, is_return=scan.points.any(axis=-1)))


def _member(archive, name):
    try:
        with archive.open(name) as stream:
            data = stream.read(_MAX_MEMBER + 1)
    except Exception as error:  # zlib, zipfile, lzma and struct errors alike
        raise ScanError(f"expected a readable array {name!r}, got {error}; the file is damaged") from None
    if len(data) > _MAX_MEMBER:
        raise ScanError(f"expected at most {_MAX_MEMBER} bytes in {name!r}, got more; this is no single scan")
    return data


def _array(data):
    """Array of the bytes of a .npy file; `np.load` would allocate whatever the header announces."""
    if data[:6] != b"\x93NUMPY" or len(data) < 12:
        raise ScanError("expected a .npy array, got other bytes; the file is damaged or of another format")
    start = 10 if data[6] == 1 else 12
    length = int.from_bytes(data[8:start], "little")
    try:
        if length > _MAX_HEADER:
            raise ValueError(f"a header of {length} bytes")
        header = ast.literal_eval(data[start : start + length].decode("utf-8").strip())
        dtype, shape = np.lib.format.descr_to_dtype(header["descr"]), tuple(header["shape"])
        num_values = int(np.prod(shape, dtype=object)) if all(type(size) is int and size >= 0 for size in shape) else -1
        fortran_order = bool(header["fortran_order"])
    except Exception as error:  # ast and dtype raise half a dozen types on garbage
        raise ScanError(f"expected a .npy header, got {error}; the file is damaged") from None
    if dtype.hasobject:
        raise ScanError("expected numbers, got pickled Python objects, which are never loaded; save a plain float32 array")
    if dtype.itemsize == 0 or dtype.subdtype is not None:
        raise ScanError(f"expected numbers, got values of type {dtype}; save a plain float32 array")
    available = len(data) - start - length
    if num_values <= 0 or num_values * dtype.itemsize > available:
        raise ScanError(f"expected {num_values} values of {dtype.itemsize} bytes, got {available} bytes; the scan is empty or cut short")
    values = np.frombuffer(data, dtype, num_values, start + length)
    return values.reshape(shape[::-1]).T if fortran_order else values.reshape(shape)


def _scan_from_array(array):
    if array.dtype.names is not None:
        flat = array.reshape(-1)
        return scan_from_fields({name: flat[name] for name in array.dtype.names if flat.dtype[name].kind in "iuf"})
    if array.ndim != 2 or not 3 <= array.shape[1] <= _MAX_COLUMNS or array.dtype.kind not in "iuf":
        expected = f"an array of n rows with 3 to {_MAX_COLUMNS} numeric columns"
        raise ScanError(f"expected {expected}, got {array.dtype} {array.shape}; reshape or transpose it")
    return RawScan(array[:, :3].astype(np.float32, order="C"), None)
