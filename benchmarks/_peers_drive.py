"""Odometries along one drive, scan by scan, taking turns: `delo run`, and those of other packages."""

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from _peers_turns import PAUSE_S, Timed, collected, order

from delo_jax.baselines.gicp import Vgicp
from delo_jax.baselines.protocols import NUM_THREADS, Aligned, ScanToScan, Tracker
from delo_jax.baselines.protocols import Sweep as TrackedSweep
from delo_jax.baselines.registry import METHODS
from delo_jax.bench.timing import Timing
from delo_jax.data.dataset import open_dataset
from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.geometry import se3
from delo_jax.metrics.ate import relative_errors
from delo_jax.model.delo import Model
from delo_jax.pipeline.baseline_odometry import BaselineOdometry
from delo_jax.pipeline.lidar_odometry import LidarOdometry
from delo_jax.pipeline.trajectory import RunWriter
from delo_jax.report.cloud import DriveCloud
from delo_jax.sim import simulate_drive
from delo_jax.sim.drive import DRIVE_SEED

KIND, SEED, NUM_SCANS = "urban", DRIVE_SEED + 10, 220
"""Chosen by its motion: the first drive of the kind that begins below 6 m/s, where methods without a start of their own do not get lost at
once, and then covers 180 m or more at up to 19 m/s. The number of scans is part of what is drawn: fewer are its first ones."""
OURS, KISS = "delo run", "KISS-ICP"
NETWORK = "delo run --map none (network alone, scan to scan)"
STAGES = ("prepare", "solve", "insert")


class Sweep(NamedTuple):
    """A scan, and when its points were measured."""

    points: np.ndarray  # (n, 3) float32 [m]
    times_s: np.ndarray | None  # (n,) relative to the stamp; None where the motion is already compensated
    stamp_ns: int


class Drive(NamedTuple):
    """Scans, and where they were taken."""

    name: str
    sweeps: list[Sweep]
    Ts_world_lidar: np.ndarray | None  # (n, 4, 4); None where that is not known


class Odometry(Protocol):
    """One that is timed."""

    def __call__(self, sweep: Sweep) -> tuple[np.ndarray, float]:
        """T_world_lidar of the next scan, and the seconds that it took."""


class DeloRun:
    """What `delo run` does with a scan that it has read: the pose, a row in every file of the run, the cloud of the report.

    Args:
        params: weights.
        folder: for the files; None: the pose alone.
        use_map: as of `LidarOdometry`.
    """

    def __init__(self, params: Model, folder: Path | None = None, *, use_map: bool = True):
        self._odometry, self._cloud = LidarOdometry(params, use_map=use_map), DriveCloud()
        self._writer = None if folder is None else RunWriter(folder, timing_names=STAGES)
        self._count = 0

    def __call__(self, sweep: Sweep) -> tuple[np.ndarray, float]:
        """T_world_lidar and seconds."""
        begin = time.perf_counter()
        frame = self._odometry.register(sweep.points, sweep.stamp_ns, sweep.times_s)
        if self._writer is not None:
            self._writer.append(frame)
            if (scan := self._odometry.last_scan) is not None:
                self._cloud.add_scan(self._count, frame.T_world_lidar, scan)
        self._count += 1
        return frame.T_world_lidar, time.perf_counter() - begin

    def close(self) -> None:
        """Closes the files."""
        if self._writer is not None:
            self._writer.close()


class Peer:
    """Another package along the drive. Its own calls are timed alone: float64 numbers, and the de-skew of those that have none, are not."""

    def __init__(self, tracker: Tracker):
        self._odometry = BaselineOdometry(tracker)

    def __call__(self, sweep: Sweep) -> tuple[np.ndarray, float]:
        """T_world_lidar and seconds."""
        frame = self._odometry.register(sweep.points, sweep.stamp_ns, sweep.times_s)
        return frame.T_world_lidar, frame.timing["solve"]


class GicpToMap:
    """GICP of small_gicp to the points of a voxel map.

    Its Python `align` takes a tree of points and no incremental map, so that the tree and the covariances of the map's points are made
    anew for each scan.

    Args:
        voxel_m: points are thinned to one per voxel, in the scan and in the map [m].
        gate_m: a match farther apart is none [m].
    """

    deskews = False

    def __init__(self, *, voxel_m: float = 0.5, gate_m: float = 2.0):
        import small_gicp

        self._voxel_m, self._gate_m, self._T_world_lidar = voxel_m, gate_m, np.eye(4)
        self._map = small_gicp.GaussianVoxelMap(voxel_m)  # keeps the mean of the points in each voxel
        self._map.set_lru(horizon=100, clear_cycle=10)

    def track(self, sweep: TrackedSweep, T_last_guess: np.ndarray) -> Aligned:
        """T_last_current."""
        import small_gicp

        cloud, _ = small_gicp.preprocess_points(sweep.points, downsampling_resolution=self._voxel_m, num_threads=NUM_THREADS)
        found = Aligned.of(np.eye(4))
        if self._map.size():
            target = small_gicp.PointCloud(self._map.voxel_points())
            tree = small_gicp.KdTree(target, num_threads=NUM_THREADS)
            small_gicp.estimate_covariances(target, tree, num_threads=NUM_THREADS)
            gate = {"max_correspondence_distance": self._gate_m, "num_threads": NUM_THREADS}
            result = small_gicp.align(target, cloud, tree, self._T_world_lidar @ T_last_guess, **gate)
            motion = se3.orthonormal(se3.inverse(self._T_world_lidar) @ result.T_target_source)
            found = Aligned.of(motion, "" if result.converged else f"not converged after {result.iterations} iterations")
            self._T_world_lidar = self._T_world_lidar @ motion
        self._map.insert(cloud, self._T_world_lidar)
        return found


PEERS: dict[str, Callable[[], Tracker]] = {
    KISS: METHODS["kiss-icp"].open_tracker,
    "GICP, scan to scan": METHODS["gicp"].open_tracker,
    "VGICP, scan to scan": lambda: ScanToScan(Vgicp()),
    "GICP, scan to model": GicpToMap,
    "VGICP, scan to model": METHODS["vgicp"].open_tracker,
    "KISS-Matcher, from the identity": METHODS["kiss-matcher"].open_tracker,  # scan to scan; it takes no start
}


def odometries(params: Model, folder: Path) -> dict[str, Odometry]:
    """All that take turns, fresh; the run of `delo run` is written to the folder.

    Raises:
        ConfigError: a package is missing.
    """
    for name in ("kiss-icp", "gicp", "kiss-matcher"):
        METHODS[name].check()
    peers = {name: Peer(open_tracker()) for name, open_tracker in PEERS.items()}
    return {OURS: DeloRun(params, folder), NETWORK: DeloRun(params, use_map=False), **peers}


def close(methods: Mapping[str, Odometry]) -> None:
    """Closes the files of those that write some."""
    for method in methods.values():
        if isinstance(method, DeloRun):
            method.close()


def simulated(num_scans: int, advance: Callable[[], None] = lambda: None) -> Drive:
    """The first scans of an HDL-64E, as measured, on a simulated street, with exact truth; `advance` is called after each."""
    sweeps, Ts = [], []
    scans = itertools.islice(simulate_drive(KIND, SEED, NUM_SCANS, rolling_shutter=True), num_scans)
    for k, scan in enumerate(scans):
        sweeps.append(Sweep(scan.points, scan.times_s, k * FRAME_PERIOD_NS))
        Ts.append(scan.T_world_lidar)
        advance()
    return Drive(f"simulated {KIND} drive {SEED}", sweeps, np.stack(Ts))


def recorded(tree: Path, sequence: str, num_scans: int, advance: Callable[[], None] = lambda: None) -> Drive:
    """The first scans of a recorded sequence; those of a raw drive carry times by azimuth.

    Raises:
        DatasetError: no such sequence.
    """
    dataset = open_dataset(tree, sequence=sequence, azimuth_times=sequence.startswith("raw_"))
    sweeps = []
    for k in range(min(num_scans, len(dataset))):
        scan = dataset[k]
        stamp_ns = k * FRAME_PERIOD_NS if dataset.stamps_ns is None else int(dataset.stamps_ns[k])
        sweeps.append(Sweep(scan.points, scan.times, stamp_ns))
        advance()
    truth = None if dataset.truth is None else dataset.truth[: len(sweeps)]
    return Drive(dataset.name, sweeps, truth)


def follow(
    drive: Drive, methods: Mapping[str, Odometry], warm_up: int, advance: Callable[[], None] = lambda: None
) -> tuple[dict[str, Timing], dict[str, np.ndarray]]:
    """Times of each method and its poses; all see a scan before any sees the next."""
    times, names = [], list(methods)
    poses: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for turn, sweep in enumerate(drive.sweeps):
        for name in order(names, turn):
            time.sleep(PAUSE_S)
            T_world_lidar, seconds = methods[name](sweep)
            times.append(Timed(name, seconds))
            poses[name].append(T_world_lidar)
        advance()
    return collected(times, warm_up), {name: np.stack(Ts) for name, Ts in poses.items()}


def step_errors(drive: Drive, poses: Mapping[str, np.ndarray], skipped: int) -> dict[str, str]:
    """Median and largest error of a step [m], of each method: a time is worth something where the pose is right."""
    if drive.Ts_world_lidar is None:
        return {}
    found = {}
    for name, Ts in poses.items():
        errors_m = relative_errors(Ts[skipped:], drive.Ts_world_lidar[skipped:]).translation_m
        found[name] = f"{100 * np.median(errors_m):.1f} / {100 * errors_m.max():.1f}"
    return found


def pairs(drive: Drive, num: int) -> Sequence[tuple[Sweep, Sweep]]:
    """Pairs of successive scans all along the drive, the older one first."""
    starts = np.linspace(0, len(drive.sweeps) - 2, num).astype(int)
    return [(drive.sweeps[k], drive.sweeps[k + 1]) for k in starts]
