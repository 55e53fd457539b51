"""PCD files: ASCII, binary and LZF-compressed, any fields."""

import itertools
from typing import NamedTuple

import numpy as np

from delo_jax.data.fields import parse_ascii
from delo_jax.errors import ScanError

_KINDS = {("F", 4): "<f4", ("F", 8): "<f8"} | {(kind, size): f"<{kind.lower()}{size}" for kind in "IU" for size in (1, 2, 4, 8)}
_LONGEST_HEADER = 1 << 16
_LZF_MAX_RATIO = 88  # 264 bytes for a back reference of 3


class _Field(NamedTuple):
    name: str
    dtype: np.dtype
    num_values: int


def parse_pcd(data: bytes) -> dict[str, np.ndarray]:
    """Columns by field name; fields with a COUNT other than 1 and padding (`_`) are left out.

    The header is never trusted for a size: what it announces has to be in the file before anything is allocated.

    Raises:
        ScanError: damaged header, fewer data than it announces, or more by a whole point.
    """
    header, body = _split(data)
    fields, num_points = _fields(header), _num_points(header)
    point_size = sum(field.dtype.itemsize * field.num_values for field in fields)
    kind = " ".join(header["DATA"]).lower()
    if kind == "ascii":
        _check_size(num_points * sum(field.num_values for field in fields), len(body))  # a number has a digit at least
        dtypes = [field.dtype for field in fields for _ in range(field.num_values)]
        tokens = body.split()
        _check_surplus(len(tokens) // len(dtypes), num_points)
        columns = parse_ascii(tokens, dtypes, num_rows=num_points)
        firsts = itertools.accumulate((field.num_values for field in fields[:-1]), initial=0)
        table = [columns[first] for first in firsts]
    elif kind == "binary":
        _check_size(num_points * point_size, len(body))
        _check_surplus(len(body) // point_size, num_points)
        dtype = np.dtype([(str(i), field.dtype, (field.num_values,)) for i, field in enumerate(fields)])
        points = np.frombuffer(body, dtype, num_points)
        table = [points[str(i)][:, 0] for i in range(len(fields))]
    elif kind == "binary_compressed":
        table = _split_columns(_decompress(body, num_points * point_size), fields, num_points)
    else:
        raise ScanError(f"expected DATA ascii, binary or binary_compressed, got {kind!r}; save the cloud again")
    return {field.name: column for field, column in zip(fields, table, strict=True) if field.num_values == 1 and field.name != "_"}


def _split(data):
    """Header as {KEY: words} and the bytes after its DATA line."""
    header, start = {}, 0
    while "DATA" not in header:
        end = data.find(b"\n", start, _LONGEST_HEADER)
        if end < 0:
            raise ScanError("expected a PCD header that ends with a DATA line, got none; the file is damaged or no PCD")
        words = data[start:end].decode("latin-1").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
    return header, data[start:]


def _fields(header):
    names = header.get("FIELDS", [])
    sizes, kinds = header.get("SIZE", []), header.get("TYPE", [])
    counts = header.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts) or not names:
        raise ScanError("expected FIELDS, SIZE, TYPE and COUNT of one length, got a header without; the file is damaged or no PCD")
    fields = []
    for name, size, kind, count in zip(names, sizes, kinds, counts, strict=True):
        dtype = _KINDS.get((kind.upper(), _integer(size, "SIZE")))
        if dtype is None:
            raise ScanError(f"expected TYPE and SIZE such as F 4 for field {name!r}, got {kind} {size}; save the cloud again")
        fields.append(_Field(name, np.dtype(dtype), _integer(count, "COUNT")))
    return fields


def _num_points(header):
    width, height = (_integer(" ".join(header.get(key, [])), key) for key in ("WIDTH", "HEIGHT"))
    points = _integer(" ".join(header.get("POINTS", [str(width * height)])), "POINTS")
    if points != width * height:
        raise ScanError(f"expected POINTS to be WIDTH x HEIGHT ({width * height}), got {points}; the header is wrong")
    return points


def _integer(text, key):
    """Positive integer; at most 18 digits, so that a damaged header cannot ask for the impossible."""
    if not (text.isascii() and text.isdigit() and len(text) <= 18 and int(text) > 0):
        raise ScanError(f"expected {key} to be a positive integer, got {text[:40]!r}; the scan is empty or its header damaged")
    return int(text)


def _check_size(needed, available):
    if needed > available:
        raise ScanError(f"expected {needed} bytes of points, got {available}; the file is cut short or its header wrong")


def _check_surplus(available, announced):
    if available > announced:
        raise ScanError(f"expected {announced} points, got {available}; the header is wrong or the file damaged")


def _split_columns(raw, fields, num_points):
    """Columns of the compressed form, which stores field after field."""
    table, offset = [], 0
    for field in fields:
        values = np.frombuffer(raw, field.dtype, num_points * field.num_values, offset)
        table.append(values.reshape(num_points, field.num_values)[:, 0])
        offset += values.nbytes
    return table


def _decompress(body, expected_size):
    if len(body) < 8:
        raise ScanError("expected the sizes of the compressed block, got the end of the file; it is cut short")
    packed_size, size = (int.from_bytes(body[at : at + 4], "little") for at in (0, 4))
    _check_size(packed_size, len(body) - 8)
    if size != expected_size or size > packed_size * _LZF_MAX_RATIO:
        raise ScanError(f"expected {expected_size} bytes of points after decompression, got {size}; the file is damaged")
    return lzf_decompress(body[8 : 8 + packed_size], size)


def lzf_decompress(packed: bytes, size: int) -> bytes:
    """Inverse of LZF compression (liblzf, as PCL uses it).

    A control byte below 32 starts a run of control + 1 literal bytes; any other is a back reference: length in the upper three bits
    (7: plus the next byte) plus 2, distance in the lower five and the byte that follows, plus 1.

    Args:
        packed: compressed bytes.
        size: bytes expected.

    Raises:
        ScanError: damaged stream, or not `size` bytes.
    """
    out, at = bytearray(), 0
    try:
        while at < len(packed) and len(out) <= size:
            control, at = packed[at], at + 1
            if control < 32:
                out += packed[at : at + control + 1]
                at += control + 1
                continue
            length = (control >> 5) + 2
            if length == 9:
                length, at = length + packed[at], at + 1
            distance, at = ((control & 31) << 8) + packed[at] + 1, at + 1
            if distance > len(out):
                raise ScanError("expected LZF data, got a reference before the start; the file is damaged")
            tail = out[len(out) - distance :]
            out += (tail * (length // distance + 1))[:length]  # an overlapping reference repeats the tail
    except IndexError:
        raise ScanError("expected more LZF data, got the end; the file is cut short") from None
    if len(out) != size:
        raise ScanError(f"expected {size} bytes of LZF data, got {len(out)}; the file is damaged")
    return bytes(out)
