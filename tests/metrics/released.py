"""Released trajectories and official poses of KITTI odometry, read from the data tree."""

import numpy as np

SEQUENCES = [f"{sequence:02d}" for sequence in range(11)]
METHODS = ["delo", "delo_puepe", "pwclo_2k", "simple_online"]


def released(data_dir, method, sequence):
    """Poses of a method as it released them, float64."""
    with np.load(data_dir / "released_trajectories" / f"{method}.npz") as file:
        return as_4x4(file[sequence])


def truth(data_dir, sequence, frame):
    """Official poses in the frame of the camera, as they are published, or of the LiDAR."""
    with np.load(data_dir / "kitti_poses.npz") as poses, np.load(data_dir / "kitti_calib_tr.npz") as calibration:
        Ts, T_cam_lidar = as_4x4(poses[sequence]), as_4x4(calibration[sequence])
    return Ts if frame == "camera" else np.linalg.inv(T_cam_lidar) @ Ts @ T_cam_lidar


def as_4x4(rows):
    """(..., 3, 4) rows with the last row of a pose."""
    rows = np.asarray(rows, dtype=np.float64)
    Ts = np.zeros((*rows.shape[:-2], 4, 4))
    Ts[..., :3, :], Ts[..., 3, 3] = rows, 1.0
    return Ts
