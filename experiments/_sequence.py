"""Odometry and its pose graph on a drive that is simulated along official KITTI motions: everything they say, beside the exact truth."""

from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from _routes import official
from rich.progress import Progress

import delo_jax
from delo_jax import inference
from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.errors import ConfigError
from delo_jax.geometry import se3
from delo_jax.inference import Estimate, PreparedScan
from delo_jax.model.delo import Model
from delo_jax.pipeline.trajectory import Trajectory
from delo_jax.refine import gtsam_backend, loops
from delo_jax.refine.plan import Factors, Plan, Refined
from delo_jax.refine.refiner import Record, Refiner, Tracked
from delo_jax.sim import simulate_route
from delo_jax.uncertainty.gate import Verdict

SMALLEST_NUM_FRAMES = 10


class Judged(NamedTuple):
    """A pair of key frames, and what the gate said."""

    source: int
    target: int
    verdict: Verdict


class Followed(NamedTuple):
    """A drive of n frames; poses are in the frame of the first scan."""

    Ts_true: np.ndarray  # (n, 4, 4)
    trajectory: Trajectory
    refined: Refined  # covariances with the part that no other pose inherits
    plan: Plan  # with loops
    judged: list[Judged]
    counts: Counter  # verdicts, and pairs without a factor
    num_proposed: int  # loops that were looked at
    clouds: list[np.ndarray]  # (m, 3) points of each scan as registered [m]; none where it was rejected


class Noting(Refiner):
    """A refiner that also keeps what the gate said of each pair."""

    def __init__(self, params: Model):
        self.judged: list[Judged] = []
        self._ends = 0, 0  # of the last pair
        super().__init__(params)

    def _pair(self, number: int, gap: int) -> tuple[Factors | None, Estimate | None]:
        self._ends = number - gap, number
        return super()._pair(number, gap)

    def _verdict(self, estimate: Estimate) -> Verdict:
        verdict = super()._verdict(estimate)
        self.judged.append(Judged(*self._ends, verdict))
        return verdict


def official_poses(data: Path, sequence: str, frames: tuple[int, int]) -> np.ndarray:
    """(n, 4, 4) LiDAR poses of frames a to b - 1 of a sequence of the odometry benchmark.

    Raises:
        DatasetError: no such poses in the data tree.
        ConfigError: frames that the sequence does not have, or too few.
    """
    Ts = official(data, sequence)
    first, last = frames
    if first < 0 or not first + SMALLEST_NUM_FRAMES <= last <= len(Ts):
        what = f"two numbers of 0 to {len(Ts)}, {SMALLEST_NUM_FRAMES} or more apart"
        raise ConfigError(f"--frames: expected {what}, for sequence {sequence}, got {first} {last}")
    return se3.orthonormal(Ts[first:last])


def follow(Ts_route: np.ndarray, kind: str, seed: int, params: Model, bar: Progress, title: str) -> Followed:
    """Odometry on the map over a simulated drive, passes, gate, loops, and the solved graph."""
    odometry = delo_jax.LidarOdometry(params, stamp_sigma_s=0.0)  # a simulator's stamps are exact
    scans: list[PreparedScan | None] = []
    truth = []
    refiner = Noting(params)
    with refiner:
        task = bar.add_task(title, total=len(Ts_route))
        for number, scan in enumerate(simulate_route(Ts_route, kind, seed, rolling_shutter=True)):
            frame = odometry.register(scan.points, number * FRAME_PERIOD_NS, scan.times_s)
            truth.append(scan.T_world_lidar)
            scans.append(odometry.last_scan)
            refiner.add(Tracked(frame.since, frame.T_world_lidar, frame.covariance, frame.local, odometry.last_scan))
            bar.advance(task)
    record = refiner.record
    kept, num_proposed = _loops(params, record, scans, bar)
    plan = record.plan(kept)
    refined = gtsam_backend.solve(plan)
    refined = refined._replace(covariances=refined.covariances + record.local)
    clouds = [np.zeros((0, 3)) if scan is None else np.asarray(scan.scan.points)[np.asarray(scan.scan.mask)] for scan in scans]
    Ts_true = se3.inverse(truth[0])[None] @ np.stack(truth)
    said = refiner.judged, record.counts, num_proposed
    return Followed(Ts_true, odometry.trajectory(), refined, plan, *said, clouds)


def _loops(params: Model, record: Record, scans: list[PreparedScan | None], bar: Progress) -> tuple[Factors, int]:
    """Factors of places that were seen again, and how many were looked at."""
    chain = loops.Chain.of(record.plan())
    pairs = loops.propose(chain, np.array([scan is not None for scan in scans]))
    there, back = [], []
    for a, b in bar.track(pairs.tolist(), description="loops"):
        earlier, later = scans[a], scans[b]
        if earlier is not None and later is not None:  # rejected frames are not proposed
            there.append(inference.align(params, earlier, later, np.eye(4)))
            back.append(inference.align(params, later, earlier, np.eye(4)))
    return loops.verify(chain, pairs, there, back, record.local), len(pairs)
