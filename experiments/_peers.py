"""Drives, and peer odometries behind one call: two threads, settings tried on simulated drives of other seeds."""

import os
from pathlib import Path
from typing import NamedTuple, Protocol

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read at load: idle threads of one method must not run into the time of the next

import _harness
import numpy as np
import small_gicp
from kiss_icp.config import load_config
from kiss_icp.kiss_icp import KissICP
from rich.progress import Progress

import delo_jax
from delo_jax.data import camera_to_lidar, read_kitti_poses
from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.geometry import se3
from delo_jax.geometry.deskew import deskew
from delo_jax.pipeline.motion_model import NANOSECOND, ConstantVelocity
from delo_jax.sim import simulate_drive

NUM_THREADS = 2
FAR_M = 1e6  # beyond the range that KISS-ICP keeps


class Sweep(NamedTuple):
    """A scan, and when its points were measured."""

    points: np.ndarray  # (n, 3) [m]; float64 for the peers
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


class Odometry(Protocol):
    """What is compared."""

    def register(self, sweep: Sweep) -> np.ndarray:
        """T_world_lidar at the stamp."""
        ...


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


class Kiss:
    """KISS-ICP 1.3.0, default settings.

    Its de-skew maps a point at time t by exp((s - 1) xi), s running from 0 to 1 over the times of the sweep and xi being the last
    motion: its pose is that at the sweep's end, and the stamp's is the same formula away. It takes the sweep to last from scan to
    scan. Where scans are left out, a point out of range, stamped one spacing before the end, tells it how long the motion took.
    """

    def __init__(self, *, deskew: bool = True):
        config = load_config(None)
        config.data.deskew = deskew
        config.registration.max_num_threads = NUM_THREADS
        self._deskew, self._odometry, self._stamp_ns = deskew, KissICP(config), 0

    def register(self, sweep: Sweep) -> np.ndarray:
        """T_world_lidar at the stamp."""
        kiss, (points, times_s, stamp_ns) = self._odometry, sweep
        spacing_s, self._stamp_ns = (stamp_ns - self._stamp_ns) * NANOSECOND, stamp_ns
        if times_s is None or not self._deskew:
            kiss.register_frame(points, np.empty(0))
            return kiss.last_pose
        begin_s, end_s = float(times_s.min()), float(times_s.max())
        if spacing_s > 1.5 * (end_s - begin_s):
            begin_s = end_s - spacing_s
            points, times_s = np.append(points, [[FAR_M, 0.0, 0.0]], axis=0), np.append(times_s, begin_s)
        motion = kiss.last_delta
        kiss.register_frame(points, times_s)
        return kiss.last_pose @ se3.exp(-end_s / (end_s - begin_s) * se3.log(motion))


class _SmallGicp:
    """What the odometries of small_gicp share: scans de-skewed with the last motion, and constant velocity as the start."""

    voxel_m: float

    def __init__(self):
        self._motion, self._T_world_lidar, self._stamp_ns = ConstantVelocity(), np.eye(4), 0

    def register(self, sweep: Sweep) -> np.ndarray:
        """T_world_lidar at the stamp."""
        velocity, points = self._motion.velocity, sweep.points
        if sweep.times_s is not None and velocity is not None:
            points = deskew(points, sweep.times_s, velocity)
        cloud, tree = small_gicp.preprocess_points(points, downsampling_resolution=self.voxel_m, num_threads=NUM_THREADS)
        elapsed_s, self._stamp_ns = (sweep.stamp_ns - self._stamp_ns) * NANOSECOND, sweep.stamp_ns
        motion = self._align(cloud, tree, self._motion.predict(elapsed_s))
        if motion is not None:
            motion = se3.orthonormal(motion)  # or rounding grows from scan to scan
            self._T_world_lidar = self._T_world_lidar @ motion
            self._motion.update(motion, elapsed_s)
        self._keep(cloud, tree)
        return self._T_world_lidar

    def _align(self, cloud, tree, guess: np.ndarray) -> np.ndarray | None:
        """T_last_current, from a guess of it; None at the first scan."""
        raise NotImplementedError

    def _keep(self, cloud, tree) -> None:
        """Take in the scan, at the newest pose."""
        raise NotImplementedError


class Vgicp(_SmallGicp):
    """VGICP to a map of Gaussian voxels; a voxel not seen for 100 scans is dropped.

    Points of 0.25 m drift 8 % less for several times the time, voxels of 0.5 m 5 to 12 % less from a narrower basin.
    """

    voxel_m, map_voxel_m = 0.5, 1.0

    def __init__(self):
        super().__init__()
        self._map = small_gicp.GaussianVoxelMap(self.map_voxel_m)
        self._map.set_lru(horizon=100, clear_cycle=10)

    def _align(self, cloud, tree, guess: np.ndarray) -> np.ndarray | None:
        if not self._map.size():
            return None
        start = self._T_world_lidar @ guess
        return se3.inverse(self._T_world_lidar) @ small_gicp.align(self._map, cloud, start, num_threads=NUM_THREADS).T_target_source

    def _keep(self, cloud, tree) -> None:
        self._map.insert(cloud, self._T_world_lidar)


class Gicp(_SmallGicp):
    """GICP from scan to scan. Matches up to 2 m are as accurate as up to 1 m, and hold at every third scan where those fail."""

    voxel_m, gate_m = 0.25, 2.0

    def __init__(self):
        super().__init__()
        self._last: tuple | None = None

    def _align(self, cloud, tree, guess: np.ndarray) -> np.ndarray | None:
        if self._last is None:
            return None
        target, target_tree = self._last
        gate = {"max_correspondence_distance": self.gate_m, "num_threads": NUM_THREADS}
        return small_gicp.align(target, cloud, target_tree, guess, **gate).T_target_source

    def _keep(self, cloud, tree) -> None:
        self._last = cloud, tree
