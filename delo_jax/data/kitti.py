"""KITTI's two layouts: odometry sequences and raw drives."""

from pathlib import Path

import numpy as np

from delo_jax.data.oxts import oxts_truth, read_timestamps
from delo_jax.data.poses import camera_to_lidar, read_kitti_poses, read_text, read_times, relative_to_first
from delo_jax.data.sequence import KITTI_ELEVATION_CORRECTION_DEG, Dataset
from delo_jax.errors import DatasetError


def open_odometry(folder: Path, *, elevation_correction: bool, azimuth_times: bool) -> Dataset:
    """KITTI odometry sequence: velodyne/*.bin, times.txt, calib.txt, and poses in ../../poses/<name>.txt or poses.txt.

    A calib.txt may say `elevation_correction_deg: 0` and `motion_compensated: 0` of scans that are not KITTI's own. Scans that are not
    compensated come with times by azimuth.

    Raises:
        DatasetError: a file that is there but cannot be used.
    """
    paths = scan_paths(folder / "velodyne")
    calib = read_calib(folder / "calib.txt")
    T_cam_lidar = next((rigid(calib, key, folder / "calib.txt") for key in ("Tr", "Tr_velo_to_cam") if key in calib), None)
    notes: list[str] = []
    truth, stamps_ns, source = None, None, "none"
    if (folder / "times.txt").exists():
        stamps_ns = _rows(read_times(folder / "times.txt"), paths, folder / "times.txt", notes)
        stamps_ns = increasing_or_none(stamps_ns, notes)
    poses_files = folder.parent.parent / "poses" / f"{folder.name}.txt", folder / "poses.txt"
    poses_file = next((file for file in poses_files if file.exists()), None)
    if poses_file is not None and T_cam_lidar is None:
        notes.append(f"{poses_file} not used: calib.txt with a row Tr is needed to bring it to the sensor's frame")
    elif poses_file is not None and T_cam_lidar is not None:
        poses = _rows(read_kitti_poses(poses_file), paths, poses_file, notes)
        if poses is not None:
            truth, source = relative_to_first(camera_to_lidar(poses, T_cam_lidar)), f"{poses_file} (camera frame, converted with Tr)"
    compensated = bool(calib.get("motion_compensated", [1.0])[0]) and not azimuth_times
    correction = float(calib.get("elevation_correction_deg", [KITTI_ELEVATION_CORRECTION_DEG])[0])
    return Dataset(
        name=folder.name,
        layout="KITTI odometry sequence",
        paths=tuple(paths),
        stamps_ns=stamps_ns,
        truth=truth,
        truth_source=source,
        T_cam_lidar=T_cam_lidar,
        elevation_correction_deg=correction if elevation_correction else 0.0,
        compensated=compensated,
        point_times="none" if compensated else "azimuth",
        bin_columns=4,
        notes=tuple(notes),
    )


def open_raw(folder: Path, *, elevation_correction: bool) -> Dataset:
    """KITTI raw drive: velodyne_points, oxts, and the calib_*.txt of its day beside or in it.

    Scans are as measured, so they come with times by azimuth. Truth is that of the GPS/INS at the scans' stamps.

    Raises:
        DatasetError: a file that is there but cannot be used.
    """
    paths = scan_paths(folder / "velodyne_points" / "data")
    notes: list[str] = []
    truth, stamps_ns, source = None, None, "none"
    stamps_file = folder / "velodyne_points" / "timestamps.txt"
    if stamps_file.exists():
        # rows of missing frames may be blank: 0 stands for them, and only the rows of scans that exist are used
        stamps_ns = _rows(read_timestamps(stamps_file), paths, stamps_file, notes)
        if stamps_ns is not None and not stamps_ns.all():
            raise DatasetError(f"{stamps_file}: expected a time for every scan, got blank lines; copy the file again")
    velo_imu_file = _day_file(folder, "calib_imu_to_velo.txt")
    if stamps_ns is None or velo_imu_file is None or not (folder / "oxts" / "data").is_dir():
        notes.append("no truth: it needs oxts/, velodyne_points/timestamps.txt and calib_imu_to_velo.txt of the same day")
    else:
        T_velo_imu = _rigid_RT(velo_imu_file)
        Ts_world_imu = oxts_truth(folder / "oxts", stamps_ns, notes)
        if Ts_world_imu is not None:
            truth = relative_to_first(Ts_world_imu @ np.linalg.inv(T_velo_imu))
            source = f"{folder / 'oxts'} (GPS/INS, interpolated at the scans' stamps)"
    return Dataset(
        name=folder.name,
        layout="KITTI raw drive",
        paths=tuple(paths),
        stamps_ns=increasing_or_none(stamps_ns, notes),
        truth=truth,
        truth_source=source,
        T_cam_lidar=_raw_T_cam_lidar(folder, notes),
        elevation_correction_deg=KITTI_ELEVATION_CORRECTION_DEG if elevation_correction else 0.0,
        compensated=False,
        point_times="azimuth",
        bin_columns=4,
        notes=tuple(notes),
    )


def scan_paths(folder: Path) -> list[Path]:
    """The .bin files of a folder in the order of their frame numbers."""
    paths = [path for path in folder.glob("*.bin") if not path.name.startswith(".")]
    return sorted(paths, key=lambda path: (len(path.stem), path.stem))


def read_calib(path: Path) -> dict[str, list[float]]:
    """Rows `key: numbers` of a KITTI calibration; rows of anything else (dates) are left out. Empty where the file is missing.

    Raises:
        DatasetError: unreadable.
    """
    calib = {}
    for line in read_text(path).splitlines() if path.exists() else ():
        key, _, text = line.partition(":")
        try:
            calib[key.strip()] = [float(word) for word in text.split()]
        except ValueError:
            continue
    return {key: values for key, values in calib.items() if values}


def rigid(calib: dict[str, list[float]], key: str, path: Path) -> np.ndarray:
    """4x4 pose of a row of 12 numbers.

    Raises:
        DatasetError: missing, of another length, or no pose.
    """
    values, T = np.array(calib.get(key, [])), np.eye(4)
    if values.shape != (12,) or not np.isfinite(values).all():
        raise DatasetError(f"{path}: expected a row '{key}:' of 12 numbers, got {len(values)}; copy the calibration again")
    T[:3] = values.reshape(3, 4)
    if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-2:
        raise DatasetError(f"{path}: expected a rotation in '{key}', got another matrix; copy the calibration again")
    return T


def increasing_or_none(stamps_ns: np.ndarray | None, notes: list[str]) -> np.ndarray | None:
    """The stamps, or None and a note where they do not increase strictly."""
    if stamps_ns is None:
        return None
    backward = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if len(backward) == 0:
        return stamps_ns
    notes.append(f"stamps not used: that of scan {backward[0] + 1} is not after the one before")
    return None


def _rows(rows, paths, where, notes):
    """Rows of a per-frame file that belong to the scans: by frame number where the file is long enough, else one a scan, else None."""
    numbers = np.array([int(path.stem) if path.stem.isdecimal() else len(rows) for path in paths])
    if numbers.max() < len(rows):
        return rows[numbers]
    if len(rows) == len(paths):
        return rows
    notes.append(f"{where} not used: it has {len(rows)} rows for {len(paths)} scans")
    return None


def _day_file(folder, name):
    return next((file for file in (folder.parent / name, folder / name) if file.exists()), None)


def _rigid_RT(path):
    """T of the rows `R:` (9 numbers) and `T:` (3 numbers)."""
    calib = read_calib(path)
    R, t = calib.get("R", []), calib.get("T", [])
    if len(R) != 9 or len(t) != 3:
        raise DatasetError(f"{path}: expected rows 'R:' of 9 and 'T:' of 3 numbers, got {len(R)} and {len(t)}; copy the file again")
    return rigid({"R, T": [*R[:3], t[0], *R[3:6], t[1], *R[6:], t[2]]}, "R, T", path)


def _raw_T_cam_lidar(folder, notes):
    """T_cam_lidar to the rectified camera 0, as in the odometry sequences; None without a calibration."""
    velo_file, cam_file = _day_file(folder, "calib_velo_to_cam.txt"), _day_file(folder, "calib_cam_to_cam.txt")
    if velo_file is None:
        return None
    T_rect_cam = np.eye(4)
    rectification = read_calib(cam_file).get("R_rect_00", []) if cam_file is not None else []
    if len(rectification) == 9:
        T_rect_cam[:3, :3] = np.reshape(rectification, (3, 3))
    else:
        notes.append("camera frame not rectified: calib_cam_to_cam.txt with a row R_rect_00 is missing")
    return T_rect_cam @ _rigid_RT(velo_file)
