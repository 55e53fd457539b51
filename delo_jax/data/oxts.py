"""Truth of KITTI raw drives: GPS/INS packets projected and interpolated at the stamps of the scans."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int64
from scipy.spatial.transform import Rotation

from delo_jax.data.poses import read_text
from delo_jax.errors import DatasetError

EARTH_RADIUS = 6378137.0  # m, of the devkit's projection
_LONGEST_GAP = 0.3  # s between samples; normal is 0.1
_FARTHEST = 0.15  # s from a stamp to the nearest sample, at the ends
_TIMESTAMP = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d{1,9})?")


def oxts_truth(folder: Path, stamps_ns: Int64[np.ndarray, " n"], notes: list[str]) -> Float[np.ndarray, "n 4 4"] | None:
    """T_world_imu at each stamp; world is the devkit's Mercator plane, x east, y north, z up.

    A sample stored with a frame is up to 10 ms off its scan: 5 cm and more in a single step at 11 m/s. So positions are interpolated
    linearly and rotations along the shortest arc between the samples around the stamp.

    Args:
        folder: the drive's `oxts`.
        stamps_ns: of the scans.
        notes: gets a line where there is no truth or where it is doubtful.

    Returns:
        Poses, or None where the samples do not cover the stamps.

    Raises:
        DatasetError: damaged packets or timestamps.
    """
    times_ns, poses = _read_packets(folder)
    if len(times_ns) < 2:
        notes.append(f"no truth: {folder} has less than two packets")
        return None
    # seconds from the first sample: float64 is exact to 0.1 us there
    times, stamps = (times_ns - times_ns[0]) / 1e9, (stamps_ns - times_ns[0]) / 1e9
    if stamps.min() < times[0] - _FARTHEST or stamps.max() > times[-1] + _FARTHEST:
        notes.append(f"no truth: {folder} does not cover the time of the scans")
        return None
    before = np.clip(np.searchsorted(times, stamps, side="right") - 1, 0, len(times) - 2)
    gap = times[before + 1] - times[before]
    if gap.max() > _LONGEST_GAP:
        notes.append(f"truth interpolated over a gap of {gap.max():.1f} s at scan {gap.argmax()}")
    fraction = (stamps - times[before]) / gap
    Ts_before, Ts_after = poses[before], poses[before + 1]
    R_before, R_after = Rotation.from_matrix(Ts_before[:, :3, :3]), Rotation.from_matrix(Ts_after[:, :3, :3])
    turn = (R_before.inv() * R_after).as_rotvec()
    Ts_world_imu = Ts_before.copy()
    Ts_world_imu[:, :3, :3] = (R_before * Rotation.from_rotvec(fraction[:, None] * turn)).as_matrix()
    Ts_world_imu[:, :3, 3] += fraction[:, None] * (Ts_after - Ts_before)[:, :3, 3]
    return Ts_world_imu


def mercator_poses(packets: Float[np.ndarray, "m 6"]) -> Float[np.ndarray, "m 4 4"]:
    """T_world_imu of packets by the devkit's formula; its scale is that of the first latitude.

    Args:
        packets: latitude, longitude [deg], altitude [m], roll, pitch, yaw [rad; 0 is east, counter-clockwise].
    """
    latitude, longitude, altitude = packets[:, 0], packets[:, 1], packets[:, 2]
    scale = np.cos(np.deg2rad(latitude[0])) * EARTH_RADIUS
    T = np.tile(np.eye(4), (len(packets), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("ZYX", packets[:, :2:-1]).as_matrix()
    T[:, 0, 3] = scale * np.deg2rad(longitude)
    T[:, 1, 3] = scale * np.log(np.tan(np.deg2rad(90.0 + latitude) / 2))
    T[:, 2, 3] = altitude
    return T


def read_timestamps(path: Path) -> Int64[np.ndarray, " n"]:
    """Nanoseconds since 1970 of lines `YYYY-MM-DD hh:mm:ss.fffffffff`; 0 for a blank line (a frame that is missing).

    Raises:
        DatasetError: unreadable, empty, or another format; the message has the line's number.
    """
    stamps_ns = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        text = line.strip()
        try:
            if text and not _TIMESTAMP.fullmatch(text):
                raise ValueError
            stamps_ns.append(int(np.datetime64(text.replace(" ", "T"), "ns").astype(np.int64)) if text else 0)
        except ValueError:
            raise DatasetError(f"{path}, line {number}: expected 'YYYY-MM-DD hh:mm:ss.fffffffff', got {text[:40]!r}; mend it") from None
    if not any(stamps_ns):
        raise DatasetError(f"{path}: expected at least one time, got none; copy the file again")
    return np.array(stamps_ns, np.int64)


def _read_packets(folder):
    """Times [ns], increasing, and T_world_imu of all packets that have a time."""
    stamps_ns = read_timestamps(folder / "timestamps.txt")
    files = [file for file in sorted((folder / "data").glob("*.txt")) if file.stem.isdecimal()]
    if len(files) == len(stamps_ns):
        rows = np.arange(len(files))
    else:  # packets may be missing like scans: the number of the file is that of the line
        files = [file for file in files if int(file.stem) < len(stamps_ns)]
        rows = np.array([int(file.stem) for file in files], dtype=np.int64)
    packets = np.array([_read_packet(file) for file in files]).reshape(-1, 6)
    times_ns, first = np.unique(stamps_ns[rows], return_index=True)
    if len(times_ns) == 0 or times_ns[0] == 0:
        raise DatasetError(f"{folder}: expected a packet and a time for each other, got one without; copy the folder again")
    return times_ns, mercator_poses(packets)[first]


def _read_packet(file):
    try:
        values = np.array([float(word) for word in read_text(file).split()[:6]])
    except ValueError:
        values = np.empty(0)
    if values.shape != (6,) or not np.isfinite(values).all() or not -89.0 < values[0] < 89.0:
        raise DatasetError(f"{file}: expected latitude, longitude, altitude, roll, pitch, yaw, got something else; copy the file again")
    return values
