"""Scans and sequences from disk and back: host NumPy only, no jax."""

from delo_jax.data.dataset import open_dataset
from delo_jax.data.fields import RawScan
from delo_jax.data.poses import (
    camera_to_lidar,
    lidar_to_camera,
    read_kitti_poses,
    read_times,
    read_tum,
    relative_to_first,
    write_kitti_poses,
    write_tum,
)
from delo_jax.data.scans import read_scan
from delo_jax.data.sequence import Dataset, azimuth_times, correct_elevation
from delo_jax.data.writers import KittiTreeWriter, write_bin

__all__ = [
    "Dataset",
    "KittiTreeWriter",
    "RawScan",
    "azimuth_times",
    "camera_to_lidar",
    "correct_elevation",
    "lidar_to_camera",
    "open_dataset",
    "read_kitti_poses",
    "read_scan",
    "read_times",
    "read_tum",
    "relative_to_first",
    "write_bin",
    "write_kitti_poses",
    "write_tum",
]
