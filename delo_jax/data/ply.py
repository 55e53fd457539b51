"""PLY files: the vertex element of an ASCII or binary file."""

from typing import NamedTuple

import numpy as np

from delo_jax.data.fields import parse_ascii
from delo_jax.errors import ScanError

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 16


class _Element(NamedTuple):
    name: str
    num_rows: int
    properties: dict[str, np.dtype]


def parse_ply(data: bytes) -> dict[str, np.ndarray]:
    """Columns of the vertices by property name.

    Elements before the vertices are skipped, those after them not looked at. Nothing is allocated on the header's word.

    Raises:
        ScanError: damaged header, list properties up to the vertices, or fewer data than the header announces.
    """
    kind, elements, body = _split(data)
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise ScanError(f"expected an element 'vertex', got {', '.join(names) or 'none'}; this PLY holds no points")
    skipped, vertex = elements[: names.index("vertex")], elements[names.index("vertex")]
    if vertex.num_rows == 0 or not vertex.properties:
        raise ScanError("expected at least one vertex with properties, got none; the scan is empty")
    if kind == "ascii":
        first = sum(element.num_rows * len(element.properties) for element in skipped)
        columns = parse_ascii(body.split()[first:], list(vertex.properties.values()), num_rows=vertex.num_rows)
        return dict(zip(vertex.properties, columns, strict=True))
    first = sum(element.num_rows * sum(dtype.itemsize for dtype in element.properties.values()) for element in skipped)
    dtype = np.dtype(list(vertex.properties.items()))
    if first + vertex.num_rows * dtype.itemsize > len(body):
        needed = first + vertex.num_rows * dtype.itemsize
        raise ScanError(f"expected {needed} bytes of vertices, got {len(body)}; the file is cut short or its header wrong")
    vertices = np.frombuffer(body, dtype, vertex.num_rows, first)
    return {name: vertices[name] for name in vertex.properties}


def _split(data):
    """Format, elements and the bytes after the header."""
    lines: list[list[str]] = []
    start = 0
    while not lines or lines[-1] != ["end_header"]:
        end = data.find(b"\n", start, _LONGEST_HEADER)
        if end < 0:
            raise ScanError("expected a PLY header up to end_header, got none; the file is damaged or no PLY")
        lines.append(data[start:end].decode("latin-1").split())
        start = end + 1
    kind = next((words[1] for words in lines if words[:1] == ["format"] and len(words) > 1), "no format")
    if lines[0] != ["ply"] or kind not in _ORDERS:
        raise ScanError(f"expected a PLY file in format {', '.join(_ORDERS)}, got {kind[:40]!r}; the file is damaged or no PLY")
    elements: list[_Element] = []
    for words in lines:
        if words[:1] == ["element"]:
            elements.append(_element(words))
        elif words[:1] == ["property"]:
            _add_property(elements, words, _ORDERS[kind])
    return kind, elements, data[start:]


def _element(words):
    if len(words) != 3 or not (words[2].isascii() and words[2].isdigit() and len(words[2]) <= 18):
        raise ScanError(f"expected 'element NAME COUNT', got {' '.join(words)[:80]!r}; the header is damaged")
    return _Element(words[1], int(words[2]), {})


def _add_property(elements, words, order):
    if not elements:
        raise ScanError("expected an element before its properties, got none; the header is damaged")
    if any(element.name == "vertex" for element in elements[:-1]):
        return  # after the vertices: faces and the like
    if len(words) != 3 or words[1] not in _TYPES or words[2] in elements[-1].properties:
        raise ScanError(f"expected 'property TYPE NAME', got {' '.join(words)[:80]!r}; save the cloud as plain points")
    elements[-1].properties[words[2]] = np.dtype(order + _TYPES[words[1]])
