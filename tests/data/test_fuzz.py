"""Valid files of every format, damaged at random: a scan or a `ScanError`, never anything else."""

import io
import struct
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from delo_jax.data.poses import read_kitti_poses, read_times, read_tum
from delo_jax.data.scans import read_scan
from delo_jax.errors import DatasetError, ScanError

POINTS = np.random.default_rng(0).normal(0, 10, (20, 3)).astype("<f4")
PCD = "VERSION 0.7\nFIELDS x y z t\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 20\nHEIGHT 1\nPOINTS 20\nDATA {}\n"
PLY = "ply\nformat {} 1.0\nelement vertex 20\nproperty float x\nproperty float y\nproperty float z\nproperty int t\nend_header\n"


def _saved(save, *args, **kwargs):
    buffer = io.BytesIO()
    save(buffer, *args, **kwargs)
    return buffer.getvalue()


def valid_files():
    times = np.arange(20, dtype="<u4") * 5_000_000
    rows = b"".join(struct.pack("<fffI", *point, time) for point, time in zip(POINTS, times, strict=True))
    text = "".join(f"{x} {y} {z} {t}\n" for (x, y, z), t in zip(POINTS, times, strict=True)).encode()
    columns = POINTS.T.tobytes() + times.tobytes()
    packed = b"".join(bytes([31]) + columns[i : i + 32] for i in range(0, 320, 32))
    named = np.zeros(20, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("t", "u4")])
    return [
        (".bin", np.column_stack([POINTS, POINTS[:, 0]]).tobytes()),
        (".pcd", PCD.format("ascii").encode() + text),
        (".pcd", PCD.format("binary").encode() + rows),
        (".pcd", PCD.format("binary_compressed").encode() + struct.pack("<II", len(packed), 320) + packed),
        (".ply", PLY.format("ascii").encode() + text),
        (".ply", PLY.format("binary_little_endian").encode() + rows),
        (".ply", PLY.format("binary_big_endian").encode() + rows),
        (".npy", _saved(np.save, POINTS)),
        (".npy", _saved(np.save, named)),
        (".npz", _saved(np.savez, xyz=POINTS, time=times)),
        (".npz", _saved(np.savez_compressed, xyz=POINTS, time=times)),
    ]


@st.composite
def damaged(draw, data):
    """`data` with a few bytes overwritten, pieces removed or repeated, and the end cut off."""
    data = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data)))
        kind = draw(st.sampled_from(["overwrite", "header", "remove", "repeat", "cut"]))
        if kind == "overwrite":
            data[at : at + 1] = bytes([draw(st.integers(0, 255))])
        elif kind == "header":  # where a single byte does the most
            at = draw(st.integers(0, min(150, len(data))))
            data[at : at + 1] = draw(st.sampled_from([b"9", b"-", b"\n", b" ", b"\xff", b"(", b"'", b"x", b"e", b"\x00", b"."]))
        elif kind == "remove":
            del data[at : at + draw(st.integers(1, 30))]
        elif kind == "repeat":
            data[at:at] = data[at : at + draw(st.integers(1, 30))]
        else:
            del data[at:]
    return bytes(data)


def result_or_message(read, path, error_type):
    try:
        return read(path), ""
    except error_type as error:
        return None, str(error)


@pytest.mark.parametrize(("suffix", "content"), valid_files(), ids=lambda value: value if isinstance(value, str) else "")
def test_scan_files(suffix, content):
    """Oracle: the valid file is read; of a damaged one a scan of the promised types, or `ScanError` with one sentence."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"scan{suffix}"
        path.write_bytes(content)
        assert read_scan(path).points.shape == (20, 3)

        @settings(max_examples=120, deadline=None, derandomize=True, database=None)
        @given(damaged(content))
        def survives(data):
            path.write_bytes(data)
            scan, message = result_or_message(read_scan, path, ScanError)
            if scan is None:
                assert str(path) in message
                assert len(message) < 1000
                return
            points, times = scan
            assert points.dtype == np.float32
            assert points.ndim == 2
            assert points.shape[1] == 3
            assert times is None or (times.shape == points.shape[:1] and np.isfinite(times).all())

        survives()


@pytest.mark.parametrize(
    ("read", "content"),
    [
        (read_kitti_poses, b"1 0 0 0.5 0 1 0 1.5 0 0 1 2.5\n" * 3),
        (read_tum, b"# stamp pose\n1317013364.326110540 1 2 3 0 0 0 1\n" * 3),
        (read_times, b"0.0\n1.036140e-01\n2.073500e-01\n"),
    ],
)
def test_trajectory_files(read, content):
    """Oracle: `DatasetError` with one sentence, or finite rows."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rows.txt"

        @settings(max_examples=120, deadline=None, derandomize=True, database=None)
        @given(damaged(content))
        def survives(data):
            path.write_bytes(data)
            rows, message = result_or_message(read, path, DatasetError)
            if rows is None:
                assert str(path) in message
                return
            assert all(np.isfinite(array).all() for array in (rows if isinstance(rows, tuple) else (rows,)))

        survives()
