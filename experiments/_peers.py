"""Drives for all methods: simulated ones and recorded ones."""

import os
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read as packages load: idle threads of one must not run into the time of the next

import _harness
import numpy as np
from rich.progress import Progress

import delo_jax
from delo_jax.data import camera_to_lidar, read_kitti_poses
from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.sim import simulate_drive


class Sweep(NamedTuple):
    """A scan, and when its points were measured."""

    points: np.ndarray  # (n, 3) [m]
    times_s: np.ndarray | None  # (n,) relative to the stamp; None where the motion is already compensated
    stamp_ns: int


class Drive(NamedTuple):
    """Scans and where they were taken."""

    name: str
    sweeps: list[Sweep]  # points in float32
    Ts_world_lidar: np.ndarray

    @property
    def skewed(self) -> bool:
        """Whether the motion within a sweep is still to be undone."""
        return self.sweeps[0].times_s is not None

    def thinned(self, gap: int) -> "Drive":
        """Every `gap`-th scan."""
        return Drive(self.name, self.sweeps[::gap], self.Ts_world_lidar[::gap])


def simulated(name: str, seed: int, num_scans: int, bar: Progress) -> Drive:
    """An HDL-64E's scans as measured, with exact truth; the kind of the drive is the last word of its name."""
    drive = simulate_drive(name.split()[-1], seed, num_scans, rolling_shutter=True)
    scans = [
        (Sweep(scan.points, scan.times_s, k * FRAME_PERIOD_NS), scan.T_world_lidar)
        for k, scan in enumerate(bar.track(drive, total=num_scans, description=f"simulating {name}"))
    ]
    sweeps, Ts_world_lidar = zip(*scans, strict=True)
    return Drive(name, list(sweeps), np.stack(Ts_world_lidar))


def recorded(data: Path, name: str, num_scans: int | None, bar: Progress) -> Drive:
    """The first scans of a sequence of the tree, or all; raw drives carry times by azimuth, odometry sequences are motion-compensated."""
    dataset = delo_jax.open_dataset(data / "sequences" / name, azimuth_times=name.startswith("raw_"))
    T_cam_lidar = _harness.needed(dataset.T_cam_lidar, f"Tr in calib.txt of {name}")
    stamps_ns = _harness.needed(dataset.stamps_ns, f"times.txt of {name}")
    poses = camera_to_lidar(read_kitti_poses(data / "poses_boresight" / f"{name}.txt"), T_cam_lidar)
    sweeps = []
    for k in bar.track(range(len(dataset))[:num_scans], description=f"reading {name}"):
        scan = dataset[k]
        sweeps.append(Sweep(scan.points, scan.times, int(stamps_ns[k])))
    return Drive(name, sweeps, poses[: len(sweeps)])
