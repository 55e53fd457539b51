import io
import struct
from pathlib import Path

import numpy as np
import pytest

from delo_jax.data.scans import read_scan
from delo_jax.errors import ScanError


def street(num_points, seed=0):
    """Points of a flat ground seen by turning rings: x, y wide, z narrow, neighbours alike."""
    rng = np.random.default_rng(seed)
    azimuth = np.linspace(-np.pi, np.pi, num_points)
    distance = 15 + 8 * np.sin(5 * azimuth) + rng.normal(0, 0.5, num_points)
    return np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), rng.normal(-1.2, 0.4, num_points)], axis=1)


def extra_columns(num_points, columns, seed=0):
    rng = np.random.default_rng(seed)
    every = [rng.gamma(1, 20, num_points).clip(0, 255).round(), np.arange(num_points) % 32, np.linspace(0, 0.1, num_points)]
    return np.stack(every[: columns - 3] or [np.empty(num_points)], axis=1)[:, : columns - 3]


def message_of(path):
    with pytest.raises(ScanError) as caught:
        read_scan(path)
    message = str(caught.value)
    assert str(path) in message
    assert "expected" in message
    assert "got" in message
    assert "\n" not in message
    return message


@pytest.mark.parametrize("columns", [3, 4, 5, 6])
@pytest.mark.parametrize("num_points", [600, 12_001, 60_000])
def test_bin_of_any_column_count(tmp_path, columns, num_points):
    """Oracle: the coordinates that went in; 600 and 60,000 points are whole rows under every column count."""
    points = street(num_points)
    (tmp_path / "0.bin").write_bytes(np.hstack([points, extra_columns(num_points, columns)]).astype("<f4").tobytes())
    scan = read_scan(tmp_path / "0.bin")
    np.testing.assert_array_equal(scan.points, points.astype(np.float32))
    assert scan.times is None


@pytest.mark.parametrize("seed", range(3))
def test_bin_of_unlike_intensities(tmp_path, seed):
    """Oracle: the coordinates that went in, with intensities in [0, 1], all 0, and points in random order."""
    points = np.random.default_rng(seed).permutation(street(3000, seed))
    for intensity in (np.zeros(3000), np.random.default_rng(seed).uniform(0, 1, 3000)):
        (tmp_path / "0.bin").write_bytes(np.column_stack([points, intensity]).astype("<f4").tobytes())
        np.testing.assert_array_equal(read_scan(tmp_path / "0.bin").points, points.astype(np.float32))


@pytest.mark.parametrize("columns", [2, 7, 8, 9, 10, 11, 12])
def test_bin_of_a_count_that_no_sensor_writes_is_refused(tmp_path, columns):
    """Oracle: the count that went in, of columns with units of their own: unit normals, reflectance, ring, time, constants."""
    points, rng = street(6000), np.random.default_rng(0)
    normals = rng.normal(size=(6000, 3)) / 2
    table = np.hstack([points, extra_columns(6000, 6), normals, rng.uniform(100, 200, (6000, 2)), np.full((6000, 1), 7.0)])
    (tmp_path / "0.bin").write_bytes(table[:, :columns].astype("<f4").tobytes())
    assert f"look like rows of {columns};" in message_of(tmp_path / "0.bin")


@pytest.mark.parametrize("columns", [3, 5, 6])
def test_bin_of_another_count_than_the_known_one(tmp_path, columns):
    """Oracle: the count that went in; 12,000 points are whole rows of four as well."""
    (tmp_path / "0.bin").write_bytes(np.hstack([street(12_000), extra_columns(12_000, columns)]).astype("<f4").tobytes())
    with pytest.raises(ScanError, match=f"0.bin: expected rows of 4 float32 values, got values that look like rows of {columns};"):
        read_scan(tmp_path / "0.bin", bin_columns=4)


def test_bin_without_a_return(tmp_path):
    """Oracle: the zeros that went in; they tell no count from another."""
    (tmp_path / "0.bin").write_bytes(bytes(16 * 600))
    np.testing.assert_array_equal(read_scan(tmp_path / "0.bin").points, np.zeros((600, 3)))


def test_few_points_are_read_as_kitti_rows(tmp_path):
    """Oracle: struct."""
    (tmp_path / "0.bin").write_bytes(struct.pack("<12f", *range(12)))
    np.testing.assert_array_equal(read_scan(tmp_path / "0.bin").points, [[0, 1, 2], [4, 5, 6], [8, 9, 10]])


@pytest.mark.parametrize("columns", [3, 5])
def test_few_points_of_another_count_are_not_taken_for_a_damaged_file(tmp_path, columns):
    """Oracle: the coordinates that went in; 23 rows are whole ones under this column count alone."""
    points = street(23)
    (tmp_path / "0.bin").write_bytes(np.hstack([points, extra_columns(23, columns)]).astype("<f4").tobytes())
    np.testing.assert_array_equal(read_scan(tmp_path / "0.bin").points, points.astype(np.float32))


def test_nan_infinite_and_zero_rows_are_kept(tmp_path):
    """Oracle: the array that went in, bit by bit."""
    rows = np.column_stack([street(600), np.ones(600)]).astype("<f4")
    rows[::7, :3], rows[1::7, 0], rows[2::7, :3] = 0, np.inf, np.nan
    (tmp_path / "0.bin").write_bytes(rows.tobytes())
    np.testing.assert_array_equal(read_scan(tmp_path / "0.bin").points, rows[:, :3])


@pytest.mark.parametrize("missing_bytes", [1, 3, 4, 8, 12])
def test_truncated_bin(tmp_path, missing_bytes):
    """Oracle: the size, which is no multiple of 16; with 4, 8 or 12 bytes less it may be one of another column count's rows."""
    rows = np.column_stack([street(3000), extra_columns(3000, 4)]).astype("<f4")
    (tmp_path / "0.bin").write_bytes(rows.tobytes()[:-missing_bytes])
    assert f"4 float32 values (16 bytes each), got {48000 - missing_bytes} bytes" in message_of(tmp_path / "0.bin")


def test_missing_empty_folder_suffix_and_text(tmp_path):
    """Oracle: one sentence that names the file and the reason."""
    (tmp_path / "empty.bin").touch()
    (tmp_path / "folder.bin").mkdir()
    (tmp_path / "0.las").write_bytes(b"LASF")
    (tmp_path / "text.bin").write_text("1.0 2.0 3.0 0.5\n" * 1000)
    assert "nothing at this path" in message_of(tmp_path / "missing.bin")
    assert "got 0" in message_of(tmp_path / "empty.bin")
    assert "a folder" in message_of(tmp_path / "folder.bin")
    assert "'.las'" in message_of(tmp_path / "0.las")
    assert "another format" in message_of(tmp_path / "text.bin")


def test_unreadable(tmp_path, monkeypatch):
    """Oracle: the error a file system without permission gives."""
    path = tmp_path / "0.bin"
    path.write_bytes(bytes(16))

    def refuse(self):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_bytes", refuse)
    assert "Permission denied" in message_of(path)


def test_npy_arrays(tmp_path):
    """Oracle: the array that numpy saved, as rows, in Fortran order and with named columns."""
    points = street(50)
    named = np.zeros(50, [("intensity", "u1"), ("z", "f8"), ("y", "f4"), ("x", ">f4"), ("t", "u4")])
    named["x"], named["y"], named["z"] = points[:, 0], points[:, 1], points[:, 2]
    named["t"] = np.linspace(0, 1e8, 50)
    for name, array in {"rows": np.hstack([points, points]), "fortran": np.asfortranarray(points), "named": named}.items():
        np.save(tmp_path / f"{name}.npy", array)
        scan = read_scan(tmp_path / f"{name}.npy")
        np.testing.assert_array_equal(scan.points, points.astype(np.float32))
        assert scan.points.flags.c_contiguous
        assert scan.points.flags.writeable
    np.testing.assert_allclose(scan.times, np.linspace(0, 0.1, 50), atol=1e-8)  # nanoseconds, whole ones


def test_bad_npy(tmp_path):
    """Oracle: one sentence for each; a header that announces 10^15 points must not allocate them."""
    np.save(tmp_path / "pickled.npy", np.array([{"x": 1}], dtype=object), allow_pickle=True)
    np.save(tmp_path / "transposed.npy", np.zeros((3, 1000)))
    np.save(tmp_path / "text.npy", np.array([["a", "b", "c"]]))
    np.save(tmp_path / "empty.npy", np.zeros((0, 3)))
    header = "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000000, 3)}".ljust(118)
    (tmp_path / "huge.npy").write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + header.encode() + bytes(120))
    (tmp_path / "nothing.npy").write_bytes((tmp_path / "huge.npy").read_bytes().replace(b"'<f4'", b"'<U0'"))
    (tmp_path / "garbage.npy").write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", 20) + b"{'descr': [[[[((((((" + bytes(120))
    assert "pickled" in message_of(tmp_path / "pickled.npy")
    assert "transpose" in message_of(tmp_path / "transposed.npy")
    assert "numeric" in message_of(tmp_path / "text.npy")
    assert "empty" in message_of(tmp_path / "empty.npy")
    assert "cut short" in message_of(tmp_path / "huge.npy")
    assert "values of type" in message_of(tmp_path / "nothing.npy")
    assert "header" in message_of(tmp_path / "garbage.npy")


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_npz_keys(tmp_path, save):
    """Oracle: the arrays that numpy saved; other members, even pickled ones, are not touched."""
    points, times = street(50), 12.0 + np.linspace(0, 0.1, 50)
    save(tmp_path / "xyz.npz", xyz=points, time=times, ring=np.arange(50), meta=np.array([{}], dtype=object))
    save(tmp_path / "columns.npz", x=points[:, 0], y=points[:, 1], z=points[:, 2], timestamp=times)
    for name in ("xyz", "columns"):
        scan = read_scan(tmp_path / f"{name}.npz")
        np.testing.assert_array_equal(scan.points, points.astype(np.float32))
        np.testing.assert_allclose(scan.times, np.linspace(-0.05, 0.05, 50), atol=1e-12)


def test_npz_with_a_stamp_beside_its_times(tmp_path):
    """Oracle: the arrays that numpy saved; a single time is that of the scan, under whatever name."""
    points, times = street(50), np.linspace(0, 0.1, 50)
    np.savez(tmp_path / "stamp.npz", xyz=points, timestamp=np.float64(1.7e9))
    np.savez(tmp_path / "both.npz", xyz=points, time=np.array([1.7e9]), offset_time=times)
    assert read_scan(tmp_path / "stamp.npz").times is None
    np.testing.assert_array_equal(read_scan(tmp_path / "both.npz").times, times)


def test_bad_npz(tmp_path):
    """Oracle: one sentence for each."""
    np.savez(tmp_path / "keys.npz", poses=np.eye(4))
    np.savez(tmp_path / "times.npz", xyz=street(50), time=np.arange(49))
    np.savez(tmp_path / "lengths.npz", x=np.zeros(3), y=np.zeros(3), z=np.zeros(2))
    (tmp_path / "zip.npz").write_bytes(b"PK\x03\x04" + bytes(100))
    assert "poses" in message_of(tmp_path / "keys.npz")
    assert "per point (50), got 49" in message_of(tmp_path / "times.npz")
    assert "one length" in message_of(tmp_path / "lengths.npz")
    assert "archive" in message_of(tmp_path / "zip.npz")


def test_a_member_that_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    """Oracle: the limit, lowered; nothing beyond it is unpacked."""
    monkeypatch.setattr("delo_jax.data.arrays._MAX_MEMBER", 1000)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, xyz=np.zeros((10_000, 3)))
    (tmp_path / "bomb.npz").write_bytes(buffer.getvalue())
    assert "at most 1000 bytes" in message_of(tmp_path / "bomb.npz")
