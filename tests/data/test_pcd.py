import struct

import numpy as np
import pytest

from delo_jax.data.pcd import lzf_decompress
from delo_jax.data.scans import read_scan
from delo_jax.errors import ScanError

# (name, TYPE, SIZE, COUNT, struct code): an order and types of no common writer
FIELDS = [
    ("intensity", "U", 2, 1, "H"),
    ("z", "F", 8, 1, "d"),
    ("x", "F", 4, 1, "f"),
    ("_", "U", 1, 3, "3B"),
    ("y", "F", 4, 1, "f"),
    ("t", "U", 4, 1, "I"),
]
ROWS = [(7 * i, 0.5 * i, 1.5 * i - 40, 1, 2, 3, 20 - 0.25 * i, 1_000_000 * i) for i in range(101)]
POINTS = np.array([[row[2], row[6], row[1]] for row in ROWS], np.float32)
TIMES = np.linspace(0, 0.1, 101)


def header(data, points=101, **changes):
    lines = {
        "VERSION": "0.7",
        "FIELDS": " ".join(field[0] for field in FIELDS),
        "SIZE": " ".join(str(field[2]) for field in FIELDS),
        "TYPE": " ".join(field[1] for field in FIELDS),
        "COUNT": " ".join(str(field[3]) for field in FIELDS),
        "WIDTH": str(points),
        "HEIGHT": "1",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": str(points),
        "DATA": data,
    }
    return b"# .PCD v0.7\n" + "".join(f"{key} {value}\n" for key, value in (lines | changes).items()).encode()


def packed_rows():
    code = "<" + "".join(field[4] for field in FIELDS)
    return b"".join(struct.pack(code, *row) for row in ROWS)


def packed_columns():
    """Field after field, as the compressed form has it."""
    blocks, at = [], 0
    for _, _, _, count, code in FIELDS:
        blocks += [struct.pack("<" + code, *row[at : at + count]) for row in ROWS]
        at += count
    return b"".join(blocks)


def lzf_literals(data):
    """LZF of runs of literals alone: a count minus one, then up to 32 bytes."""
    return b"".join(bytes([len(data[i : i + 32]) - 1]) + data[i : i + 32] for i in range(0, len(data), 32))


def compressed(packed, size):
    return header("binary_compressed") + struct.pack("<II", len(packed), size) + packed


def files():
    ascii_rows = "".join(" ".join(str(value) for value in row) + "\n" for row in ROWS).encode()
    columns = packed_columns()
    return {
        "ascii": header("ascii") + ascii_rows,
        "crlf": (header("ascii") + ascii_rows).replace(b"\n", b"\r\n"),
        "binary": header("binary") + packed_rows(),
        "binary_compressed": compressed(lzf_literals(columns), len(columns)),
    }


@pytest.mark.parametrize("kind", ["ascii", "crlf", "binary", "binary_compressed"])
def test_every_encoding(tmp_path, kind):
    """Oracle: the rows that struct packed, or str printed."""
    (tmp_path / "0.pcd").write_bytes(files()[kind])
    scan = read_scan(tmp_path / "0.pcd")
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_allclose(scan.times, TIMES, atol=1e-12)


@pytest.mark.parametrize("kind", ["ascii", "binary"])
def test_an_end_of_less_than_a_point_is_passed_over(tmp_path, kind):
    """Oracle: the rows that struct packed, or str printed, before a line break of some editor."""
    (tmp_path / "0.pcd").write_bytes(files()[kind] + b"\n\n")
    np.testing.assert_array_equal(read_scan(tmp_path / "0.pcd").points, POINTS)


def test_lzf_back_references():
    """Oracle: a stream made by hand after liblzf's description: a literal run, a copy, a repetition that overlaps, a long one."""
    stream = bytes([4]) + b"abcde"  # 5 literals
    stream += bytes([(1 << 5) | 0, 4])  # 3 bytes from 5 back: abc
    stream += bytes([(6 << 5) | 0, 1])  # 8 bytes from 2 back: bcbcbcbc
    stream += bytes([(7 << 5) | 0, 11, 0])  # 9 + 11 bytes from 1 back
    expected = b"abcde" + b"abc" + b"bcbcbcbc" + b"c" * 20
    assert lzf_decompress(stream, len(expected)) == expected


def test_lzf_distance_of_two_bytes():
    """Oracle: closed form; 300 literals, then 4 bytes from 300 back."""
    data = bytes(i % 251 for i in range(300))
    stream = lzf_literals(data) + bytes([(2 << 5) | (299 >> 8), 299 & 255])
    assert lzf_decompress(stream, 304) == data + data[:4]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (header("binary", points=10**15) + packed_rows(), "cut short"),
        (header("ascii", points=10**15), "cut short"),
        (header("binary", COUNT="1 1 1 999999999999 1 1") + packed_rows(), "cut short"),
        (header("ascii", COUNT="1 1 1 999999999999 1 1") + b"1 2 3", "cut short"),
        (header("binary", POINTS=0), "POINTS to be a positive integer"),
        (header("binary", POINTS="9" * 5000), "POINTS to be a positive integer"),
        (header("binary") + packed_rows()[:-1], "cut short"),
        (header("binary", SIZE="2 8 3 1 4 4") + packed_rows(), "TYPE and SIZE"),
        (header("binary", TYPE="U F F") + packed_rows(), "one length"),
        (header("binary", FIELDS="intensity z a _ y t") + packed_rows(), "fields x, y, z"),
        (header("zstd") + packed_rows(), "'zstd'"),
        (header("ascii") + b"1 2 three " * 270, "numbers"),
        (header("binary", POINTS=100) + packed_rows(), r"WIDTH x HEIGHT \(101\), got 100"),
        (header("binary", HEIGHT=2) + packed_rows(), r"WIDTH x HEIGHT \(202\), got 101"),
        (header("binary", points=100) + packed_rows(), "expected 100 points, got 101"),
        (header("ascii", points=1) + b"1 2 3 4 5 6 7 8\n" * 2, "expected 1 points, got 2"),
        (b"\x00" * 100, "DATA line"),
        (header("binary_compressed") + b"\x01", "cut short"),
        (compressed(b"\x00" * 10, 2**31), "decompression"),
        (compressed(b"\xff\xff\xff" * 100, 101 * 25), "before the start"),
        (compressed(lzf_literals(packed_columns())[:-40], len(packed_columns())), "LZF"),
        (header("binary_compressed") + struct.pack("<II", 2**31, 101 * 25), "cut short"),
    ],
)
def test_damaged_files(tmp_path, content, reason):
    """Oracle: one sentence that names the file and the reason, and nothing allocated on the header's word."""
    (tmp_path / "0.pcd").write_bytes(content)
    with pytest.raises(ScanError, match=reason) as caught:
        read_scan(tmp_path / "0.pcd")
    assert "0.pcd: expected" in str(caught.value)
    assert "\n" not in str(caught.value)
