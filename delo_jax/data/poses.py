"""Trajectory files: KITTI rows and TUM lines, and the way between the camera's and the sensor's frame."""

import math
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int64
from scipy.spatial.transform import Rotation

from delo_jax.errors import DatasetError

_ORTHONORMAL = 1e-2  # files of seven digits are within 1e-6


def lidar_to_camera(poses: Float[np.ndarray, "n 4 4"], T_cam_lidar: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n 4 4"]:
    """T_firstcam_cam of T_firstlidar_lidar: the same motion, seen from the camera."""
    return T_cam_lidar @ poses @ np.linalg.inv(T_cam_lidar)


def camera_to_lidar(poses: Float[np.ndarray, "n 4 4"], T_cam_lidar: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n 4 4"]:
    """T_firstlidar_lidar of T_firstcam_cam, the inverse of `lidar_to_camera`."""
    return np.linalg.inv(T_cam_lidar) @ poses @ T_cam_lidar


def relative_to_first(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
    """Poses in the frame of the first one."""
    return np.linalg.inv(poses[0]) @ poses


def format_kitti_pose(T: Float[np.ndarray, "4 4"]) -> str:
    """One line of a KITTI pose file: the upper three rows, with the line break."""
    return " ".join(f"{value:.12e}" for value in T[:3].ravel()) + "\n"


def write_kitti_poses(path: str | Path, poses: Float[np.ndarray, "n 4 4"]) -> None:
    """Writes one line of 12 numbers per pose; the frame is the caller's (KITTI's own files: the camera's)."""
    Path(path).write_text("".join(format_kitti_pose(T) for T in poses))


def read_kitti_poses(path: str | Path) -> Float[np.ndarray, "n 4 4"]:
    """Poses of a KITTI file, 12 numbers a line, in the frame in which the file has them.

    Raises:
        DatasetError: unreadable, empty, or a line that is no pose; the message has its number.
    """
    poses = []
    for where, words in _lines(path):
        T = np.eye(4)
        T[:3] = np.reshape(_numbers(where, words, 12), (3, 4))
        error = np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max()
        if error > _ORTHONORMAL or np.linalg.det(T[:3, :3]) < 0:
            raise DatasetError(f"{where}: expected a rotation in the left 3x3 block, got one off by {error:.3g}; mend that line")
        poses.append(T)
    return np.stack(_not_empty(path, poses))


def write_tum(path: str | Path, stamps_ns: Int64[np.ndarray, " n"], poses: Float[np.ndarray, "n 4 4"]) -> None:
    """Writes `stamp x y z qx qy qz qw` lines, stamp in seconds with nine digits."""
    lines = []
    for stamp_ns, T in zip(stamps_ns, poses, strict=True):
        values = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        lines.append(" ".join([format_seconds(int(stamp_ns)), *(f"{value:.9f}" for value in values)]) + "\n")
    Path(path).write_text("".join(lines))


def read_tum(path: str | Path) -> tuple[Int64[np.ndarray, " n"], Float[np.ndarray, "n 4 4"]]:
    """Stamps [ns] and poses of a TUM file; lines that start with # are comments.

    Raises:
        DatasetError: unreadable, empty, or a line that is no stamped pose; the message has its number.
    """
    stamps_ns, poses = [], []
    for where, words in _lines(path):
        values = _numbers(where, words, 8)
        if abs(np.linalg.norm(values[4:]) - 1.0) > _ORTHONORMAL:
            raise DatasetError(f"{where}: expected a unit quaternion, got norm {np.linalg.norm(values[4:]):.3g}; mend that line")
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_quat(values[4:]).as_matrix(), values[1:4]
        stamps_ns.append(parse_seconds(words[0], where))
        poses.append(T)
    return np.array(_not_empty(path, stamps_ns), np.int64), np.stack(poses)


def read_times(path: str | Path) -> Int64[np.ndarray, " n"]:
    """Stamps [ns] of a file with one time in seconds a line (KITTI `times.txt`).

    Raises:
        DatasetError: unreadable, empty, or a line that is no time; the message has its number.
    """
    stamps_ns = []
    for where, words in _lines(path):
        _numbers(where, words, 1)
        stamps_ns.append(parse_seconds(words[0], where))
    return np.array(_not_empty(path, stamps_ns), np.int64)


def format_seconds(stamp_ns: int) -> str:
    """Seconds with nine digits, exact."""
    sign, stamp_ns = "-" if stamp_ns < 0 else "", abs(stamp_ns)
    return f"{sign}{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def parse_seconds(text: str, where: str) -> int:
    """Nanoseconds of a decimal number of seconds, without the rounding of a float.

    Raises:
        DatasetError: no number, or beyond what 64 bits hold.
    """
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        seconds = Decimal("nan")
    if not (seconds.is_finite() and abs(seconds) < 9_000_000_000):
        raise DatasetError(f"{where}: expected a time in seconds, got {text[:40]!r}; mend that line")
    return round(seconds * 10**9)


def read_text(path: str | Path) -> str:
    """Text of a small file.

    Raises:
        DatasetError: missing, unreadable or not text.
    """
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "bytes that are no text"
        raise DatasetError(f"{path}: expected a readable text file, got {reason}; check the path and its permissions") from None


def _lines(path) -> Iterator[tuple[str, list[str]]]:
    """(place for messages, words) of every line that is neither blank nor a comment."""
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.replace(",", " ").split()
        if words and not words[0].startswith("#"):
            yield f"{path}, line {number}", words


def _numbers(where, words, count):
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = [math.nan]
    if len(words) != count or not all(map(math.isfinite, values)):
        raise DatasetError(f"{where}: expected {count} finite numbers, got {' '.join(words)[:60]!r}; mend that line")
    return values


def _not_empty(path, rows):
    if not rows:
        raise DatasetError(f"{path}: expected at least one line, got an empty file; write it again or remove it")
    return rows
