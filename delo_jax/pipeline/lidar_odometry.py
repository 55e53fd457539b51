"""Streaming odometry: the one place where "the source came before the target" is true."""

import dataclasses
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from delo_jax import inference
from delo_jax.errors import ScanError
from delo_jax.geometry import se3
from delo_jax.inference import EncodedScan, Estimate
from delo_jax.model.delo import Model
from delo_jax.pipeline.motion_model import NANOSECOND, ConstantVelocity
from delo_jax.pipeline.trajectory import Trajectory
from delo_jax.preprocess import check_points
from delo_jax.uncertainty import covariance

MAX_SWEEP_S = 1.0  # a point measured farther from the stamp has a time of another kind
DEFAULT_PERIOD_NS = 100_000_000  # when no stamps are given: 10 scans a second


class Frame(NamedTuple):
    """One registered scan."""

    T_world_lidar: np.ndarray
    """(4, 4) float64; the world is the sensor frame of the first scan."""
    covariance: np.ndarray
    """(6, 6) of T_world_lidar, right perturbation, order [omega, v]; grows along the drive."""
    motion: Estimate
    """Of the sensor's motion since the last scan that was not rejected: its pose is T_previous_current."""
    status: str
    """That of the motion."""
    stamp_ns: int
    timing: dict[str, float]
    """Seconds per stage."""


class Source(NamedTuple):
    """The last good scan and where it was."""

    scan: EncodedScan
    points: np.ndarray  # as measured, kept until a first motion is known
    times_s: np.ndarray | None
    stamp_ns: int


class LidarOdometry:
    """Scan-to-scan LiDAR odometry. Not thread-safe; one instance per sensor stream.

    A bad scan never stops a drive: its pose is the motion model's, its status `rejected`, its covariance honest about it,
    and the last good scan stays the source, so that the next pair bridges the gap.

    Args:
        params: weights, from `delo_jax.load`.
        deskew: undo the motion within a sweep where points carry times.
        prepare: raw points to an encoded scan; `inference.prepare` by default.
        align: two encoded scans and a start to an estimate; `inference.align` by default.
    """

    def __init__(
        self,
        params: Model,
        *,
        deskew: bool = True,
        prepare: Callable[[Model, np.ndarray], EncodedScan] = inference.prepare,
        align: Callable[[Model, EncodedScan, EncodedScan, np.ndarray], Estimate] = inference.align,
    ):
        self._params, self._deskew, self._prepare, self._align = params, deskew, prepare, align
        self._motion_model = ConstantVelocity()
        self._source: Source | None = None
        self._T_world_source, self._covariance = np.eye(4), np.zeros((6, 6))
        self._num_frames, self._last_stamp_ns, self._num_rejected = 0, 0, 0
        self._trajectory = Trajectory()

    def register(self, points: np.ndarray, stamp_ns: int | None = None, times_s: np.ndarray | None = None) -> Frame:
        """Pose of the sensor at this scan; the first scan defines the world frame.

        Args:
            points: (n, 3) in the sensor frame [m].
            stamp_ns: time of the scan; 0.1 s after the last one when None.
            times_s: (n,) time of each point relative to the stamp, for the de-skew; None when already compensated.

        Raises:
            ScanError: wrong shape or dtype, or a stamp that does not rise; the state is as if the scan never arrived.
        """
        points = check_points(points)
        stamp_ns = self._check_stamp(stamp_ns)
        if times_s is not None and np.shape(times_s) != (len(points),):
            raise ScanError(f"times_s: expected one time per point, shape ({len(points)},), got {np.shape(times_s)}")
        if times_s is not None and np.any(np.abs(times_s) > MAX_SWEEP_S):
            raise ScanError(
                f"times_s: expected seconds relative to the stamp, within {MAX_SWEEP_S:g} s, got {np.nanmax(np.abs(times_s)):g} s"
            )
        begin = time.perf_counter()
        times_s = times_s if self._deskew else None
        target = Source(self._prepare_at(points, times_s), points, times_s, stamp_ns)
        prepared = time.perf_counter()
        motion, target = (self._first(target), target) if self._source is None else self._align_to(self._source, target)
        timing = {"prepare": prepared - begin, "solve": time.perf_counter() - prepared}
        return self._finish(target, motion, stamp_ns, timing)

    def reject(self, reason: str, stamp_ns: int | None = None) -> Frame:
        """Frame of a scan that could not be read: carried by the motion model, status `rejected`."""
        stamp_ns = self._check_stamp(stamp_ns)
        return self._finish(None, self._unmeasured(stamp_ns, reason), stamp_ns, {})

    def trajectory(self) -> Trajectory:
        """All frames so far."""
        return self._trajectory

    def _check_stamp(self, stamp_ns: int | None) -> int:
        if stamp_ns is None:
            return self._last_stamp_ns + DEFAULT_PERIOD_NS if self._num_frames else 0
        if self._num_frames and stamp_ns <= self._last_stamp_ns:
            raise ScanError(f"stamp_ns: expected more than the last stamp {self._last_stamp_ns}, got {stamp_ns}; sort the scans by time")
        return int(stamp_ns)

    def _prepare_at(self, points: np.ndarray, times_s: np.ndarray | None) -> EncodedScan:
        still = points if times_s is None else self._motion_model.deskew(points, times_s)
        return self._prepare(self._params, still)

    def _first(self, target: Source) -> Estimate:
        """The first scan is the world, unless it is unusable."""
        minimum = self._params.cfg.status.min_points
        if target.scan.num_points < minimum:
            return self._unmeasured(target.stamp_ns, f"the first scan has {target.scan.num_points} usable points, fewer than {minimum}")
        zero = np.zeros(6)
        return Estimate(
            T_target_source=np.eye(4), covariance=np.zeros((6, 6)), aleatoric=zero, epistemic=zero, status="ok", confidence=1.0, reason=""
        )

    def _align_to(self, source: Source, target: Source) -> tuple[Estimate, Source]:
        """Motion T_source_target of a pair, started from the motion model's prediction, and the target as it was aligned."""
        elapsed_s = (target.stamp_ns - source.stamp_ns) * NANOSECOND
        guess = se3.inverse(self._motion_model.predict(elapsed_s))
        estimate = self._align(self._params, source.scan, target.scan, guess)
        if self._motion_model.velocity is None and target.times_s is not None and estimate.status != "rejected":
            # the first motion de-skews its own two scans, then is measured again
            self._motion_model.update(se3.inverse(estimate.T_target_source), elapsed_s)
            source, target = (scan._replace(scan=self._prepare_at(scan.points, scan.times_s)) for scan in (source, target))
            estimate = self._align(self._params, source.scan, target.scan, estimate.T_target_source)
            self._source = source
        return estimate.inverted(), target

    def _unmeasured(self, stamp_ns: int, reason: str) -> Estimate:
        since = self._source.stamp_ns if self._source else stamp_ns
        known = covariance.unknown(self._params.cfg.status)
        return Estimate(
            T_target_source=self._motion_model.predict((stamp_ns - since) * NANOSECOND),
            covariance=known.covariance,
            aleatoric=known.aleatoric,
            epistemic=known.epistemic,
            status="rejected",
            confidence=0.0,
            reason=reason,
        )

    def _finish(self, target: Source | None, motion: Estimate, stamp_ns: int, timing: dict[str, float]) -> Frame:
        """Advance the state unless the motion was rejected, and record the frame."""
        if motion.status == "rejected":  # nobody has measured for that many frames: standard deviations grow with them
            self._num_rejected += 1
            growth = self._num_rejected**2
            motion = dataclasses.replace(motion, covariance=growth * motion.covariance, epistemic=growth * motion.epistemic)
        T_world_target = self._T_world_source @ motion.T_target_source
        covariance_world = se3.compose_covariance(self._covariance, motion.covariance, motion.T_target_source)
        if motion.status != "rejected" and target is not None:
            if self._source is not None:
                self._motion_model.update(motion.T_target_source, (stamp_ns - self._source.stamp_ns) * NANOSECOND)
            self._source, self._num_rejected = target, 0
            self._T_world_source, self._covariance = T_world_target, covariance_world
        self._num_frames, self._last_stamp_ns = self._num_frames + 1, stamp_ns
        frame = Frame(T_world_target, covariance_world, motion, motion.status, stamp_ns, timing)
        self._trajectory.append(frame)
        return frame
