import struct

import numpy as np
import pytest

from delo_jax.data.scans import read_scan
from delo_jax.errors import ScanError

ROWS = [(i % 256, 0.5 * i - 3, 1.5 * i, 2.0 - i, i / 1000) for i in range(101)]
POINTS = np.array([[row[2], row[1], row[3]] for row in ROWS], np.float32)
PROPERTIES = "property uchar red\nproperty double y\nproperty float32 x\nproperty float z\nproperty float time\n"
BEFORE = "element camera 2\nproperty float focal\nproperty short id\n"
AFTER = "element face 1\nproperty list uchar int vertex_indices\n"


def header(kind, count=101, properties=PROPERTIES, before=BEFORE, after=AFTER):
    return f"ply\nformat {kind} 1.0\ncomment made here\n{before}element vertex {count}\n{properties}{after}end_header\n".encode()


def body(order):
    rows = b"".join(struct.pack(order + "Bdfff", *row) for row in ROWS)
    return struct.pack(order + "fhfh", 1, 2, 3, 4) + rows + struct.pack(order + "Biii", 3, 0, 1, 2)


def files():
    text = "1 2\n3 4\n" + "".join(" ".join(map(str, row)) + "\n" for row in ROWS) + "3 0 1 2\n"
    return {
        "ascii": header("ascii") + text.encode(),
        "binary_little_endian": header("binary_little_endian") + body("<"),
        "binary_big_endian": header("binary_big_endian") + body(">"),
    }


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_every_encoding(tmp_path, kind):
    """Oracle: the rows that struct packed, between an element before and one after."""
    (tmp_path / "0.ply").write_bytes(files()[kind])
    scan = read_scan(tmp_path / "0.ply")
    np.testing.assert_array_equal(scan.points, POINTS)
    assert scan.points.dtype == np.dtype("=f4")
    np.testing.assert_allclose(scan.times, np.linspace(0, 0.1, 101), atol=1e-7)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (header("binary_little_endian", count=10**15) + body("<"), "cut short"),
        (header("ascii", count=10**15), "cut short"),
        (header("binary_little_endian", count="9" * 5000) + body("<"), "element NAME COUNT"),
        (header("binary_little_endian", count=-1) + body("<"), "element NAME COUNT"),
        (header("binary_little_endian", count=0) + body("<"), "empty"),
        (header("binary_little_endian") + body("<")[:-200], "cut short"),
        (header("binary_middle_endian") + body("<"), "format"),
        (header("ascii", properties="property float a\n") + b"1 " * 200, "fields x, y, z"),
        (header("ascii", properties="property list uchar int x\n"), "property TYPE NAME"),
        (header("ascii", before="property float x\n"), "element before"),
        (header("ascii", before="", after="").replace(b"vertex", b"points"), "element 'vertex'"),
        (header("ascii") + b"one two " * 500, "numbers"),
        (b"ply\nformat ascii 1.0\n", "end_header"),
        (b"\xff" * 100_000, "end_header"),
    ],
)
def test_damaged_files(tmp_path, content, reason):
    """Oracle: one sentence that names the file and the reason, and nothing allocated on the header's word."""
    (tmp_path / "0.ply").write_bytes(content)
    with pytest.raises(ScanError, match=reason) as caught:
        read_scan(tmp_path / "0.ply")
    assert "0.ply: expected" in str(caught.value)
    assert "\n" not in str(caught.value)
