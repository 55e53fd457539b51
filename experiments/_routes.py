"""Official poses of KITTI's odometry sequences, from the data tree."""

from pathlib import Path

import numpy as np

from delo_jax.data import camera_to_lidar
from delo_jax.errors import DatasetError

SEQUENCES = tuple(f"{number:02d}" for number in range(11))
POSES, CALIBRATIONS = "kitti_poses.npz", "kitti_calib_tr.npz"


def whole(rows: np.ndarray) -> np.ndarray:
    """(..., 4, 4) float64 of (..., 3, 4)."""
    Ts = np.zeros((*rows.shape[:-2], 4, 4))
    Ts[..., :3, :], Ts[..., 3, 3] = rows, 1.0
    return Ts


def official(data: Path, sequence: str, frame: str = "lidar") -> np.ndarray:
    """(n, 4, 4) poses in the first frame of the LiDAR, x forward, or of the camera.

    Raises:
        DatasetError: no such poses in the data tree.
    """
    Ts = whole(_entry(data / POSES, sequence))
    return Ts if frame == "camera" else camera_to_lidar(Ts, calibration(data, sequence))


def calibration(data: Path, sequence: str) -> np.ndarray:
    """(4, 4) T_cam_lidar.

    Raises:
        DatasetError: no such calibration in the data tree.
    """
    return whole(_entry(data / CALIBRATIONS, sequence))


def _entry(path: Path, sequence: str) -> np.ndarray:
    if not path.exists():
        raise DatasetError(f"{path.parent}: expected {POSES} and {CALIBRATIONS}, got no {path.name}; check --data")
    with np.load(path) as file:
        if sequence not in file.files:
            raise DatasetError(f"{path}: expected one of the sequences {', '.join(file.files)}, got {sequence}")
        return file[sequence]
