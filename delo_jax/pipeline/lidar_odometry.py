"""Streaming odometry: the one place where "the source came before the target" is true."""

import dataclasses
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from delo_jax import inference
from delo_jax.geometry import se3
from delo_jax.inference import Estimate, PreparedScan
from delo_jax.model.delo import Model
from delo_jax.pipeline.compiled import compile_odometry
from delo_jax.pipeline.motion_model import NANOSECOND, ConstantVelocity, is_near
from delo_jax.pipeline.scan_to_map import Located, MapTracker, Steps
from delo_jax.pipeline.stamps import checked_stamp, checked_times
from delo_jax.pipeline.trajectory import Trajectory
from delo_jax.preprocess import check_points
from delo_jax.uncertainty import covariance, stream

STAMP_SIGMA_S = 1e-3
"""Of the stamps of recorded scans, where nothing better is known; a simulator's are exact."""


class Frame(NamedTuple):
    """One registered scan.

    Poses on a map do not chain: what one motion has too much of, the next has too little. With weights calibrated for it, covariances of
    successive motions are therefore of correlated errors, and that of a pose is less than that of their product.
    """

    T_world_lidar: np.ndarray
    """(4, 4) float64; the world is the sensor frame of the first usable scan."""
    covariance: np.ndarray
    """(6, 6) of T_world_lidar, right perturbation, order [omega, v]: the drift, which grows along the drive, and the error on the map."""
    local: np.ndarray
    """(6, 6) the part of that covariance which the next pose on the same map does not inherit; zeros from scan to scan."""
    motion: Estimate
    """Of the sensor's motion since frame `since`: its pose is T_since_current. On a map that is calibrated for, the error of both ends
    on the map is its aleatoric part, the drift in between its epistemic one."""
    since: int
    """Number of the frame that the motion starts from: the one before, or the last good one before bad scans."""
    status: str
    """That of the motion."""
    stamp_ns: int
    timing: dict[str, float]
    """Seconds per stage."""


class Source(NamedTuple):
    """A scan that later ones may be aligned with."""

    scan: PreparedScan
    stamp_ns: int
    number: int  # of its frame

    def seconds_until(self, stamp_ns: int) -> float:
        """From its stamp to another one."""
        return (stamp_ns - self.stamp_ns) * NANOSECOND


class Anchor(NamedTuple):
    """A source and where it was."""

    source: Source
    T_world_lidar: np.ndarray
    standing: stream.Standing


class Answer(NamedTuple):
    """What was found of a scan."""

    motion: Estimate  # T_since_current
    target: Source | None = None  # as it was registered; None where the scan could not be read
    noise: stream.OnMap | None = None  # calibrated, of a scan on the map; without it the motion's covariance stands


class LidarOdometry:
    """LiDAR odometry on a local map, or from scan to scan. Not thread-safe; one instance per sensor stream.

    On the map, a scan goes this way: prepared; predicted and de-skewed by the motion model; the map cropped in the predicted body
    frame; learned steps of the fine stage; robust classical steps; once more with the velocity of the sweep free, where points
    carry times; inserted. Where that fails, at the first pair, after a gap and after a surprise, the network aligns the scan with
    the last good one, from the identity's hypothesis and the prediction's, and the map judges its proposal beside others.

    A bad scan never stops a drive: its pose is the motion model's, its status `rejected`, its covariance honest about it.
    The last good scan stays the source, so that the next pair bridges the gap; when it has gone out of reach, two
    consecutive scans that fit each other take over, at the predicted pose and with its wide covariance.

    Args:
        params: weights, from `delo_jax.load`.
        use_map: register to a local map of what was seen lately, rather than to the last scan; presets without a fine stage cannot.
        deskew: undo the motion within a sweep where points carry times.
        steps: how a scan is registered to the map.
        stamp_sigma_s: standard deviation of the stamps [s]; what moves meanwhile is in the covariance of a pose on the map.
        prepare: raw points and their times to a scan; `inference.prepare` by default.
        align: two scans and a start to an estimate; `inference.align` by default.

    Raises:
        ConfigError: a map is asked for, and the network has no fine stage.
    """

    def __init__(
        self,
        params: Model,
        *,
        use_map: bool = True,
        deskew: bool = True,
        steps: Steps | None = None,
        stamp_sigma_s: float = STAMP_SIGMA_S,
        prepare: Callable[[Model, np.ndarray, np.ndarray | None], PreparedScan] = inference.prepare,
        align: Callable[[Model, PreparedScan, PreparedScan, np.ndarray], Estimate] = inference.align,
    ):
        self._params, self._deskew, self._prepare, self._align = params, deskew, prepare, align
        self._motion_model = ConstantVelocity()
        self._map = MapTracker(params, steps or Steps(), stamp_sigma_s) if use_map else None
        self._anchor: Anchor | None = None  # the last good scan
        self._doubtful: Anchor | None = None  # the newest usable scan that did not fit it
        self._map_refused = False  # the map refused the last scan, though it fits the one before it
        self._num_frames, self._last_stamp_ns, self._num_rejected = 0, 0, 0
        self._last_scan: PreparedScan | None = None
        self._trajectory = Trajectory()

    def compile(self) -> float:
        """Compiles now what would be compiled at the second scan, and returns how long it took [s]: no scan waits for a compiler."""
        return compile_odometry(self._params, use_map=self._map is not None)

    def register(self, points: np.ndarray, stamp_ns: int | None = None, times_s: np.ndarray | None = None) -> Frame:
        """Pose of the sensor at this scan; the first usable scan defines the world frame.

        Args:
            points: (n, 3) in the sensor frame [m].
            stamp_ns: time of the scan; 0.1 s after the last one when None.
            times_s: (n,) time of each point relative to the stamp, for the de-skew; None when already compensated.

        Raises:
            ScanError: wrong shape or dtype, times of another kind, or a stamp that does not rise; the state is as if the
                scan never arrived.
        """
        points, stamp_ns = check_points(points), self._check_stamp(stamp_ns)
        times_s = checked_times(times_s if self._deskew else None, len(points))
        begin = time.perf_counter()
        self._look_ahead(stamp_ns)
        scan = self._prepare(self._params, points, times_s).still(self._motion_model.velocity)
        target = Source(scan, stamp_ns, self._num_frames)
        prepared = time.perf_counter()
        answer = self._locate(target) if self._map is None else self._locate_on_map(target, self._map)
        timing = {"prepare": prepared - begin, "solve": time.perf_counter() - prepared}
        return self._finish(answer, stamp_ns, timing)

    def reject(self, reason: str, stamp_ns: int | None = None) -> Frame:
        """Frame of a scan that could not be read: carried by the motion model, status `rejected`."""
        stamp_ns = self._check_stamp(stamp_ns)
        return self._finish(Answer(self._unmeasured(stamp_ns, reason)), stamp_ns, {})

    @property
    def last_scan(self) -> PreparedScan | None:
        """The scan of the last frame, as it was registered; None where it was rejected."""
        return self._last_scan

    def trajectory(self) -> Trajectory:
        """All frames so far."""
        return self._trajectory

    def _look_ahead(self, stamp_ns: int) -> None:
        """What can be made of the map before the scan is prepared."""
        if self._map is None or self._anchor is None:
            return
        elapsed_s = self._anchor.source.seconds_until(stamp_ns)
        if self._motion_model.can_tell(elapsed_s):
            self._map.expect(self._anchor.T_world_lidar @ self._motion_model.predict(elapsed_s))

    def _check_stamp(self, stamp_ns: int | None) -> int:
        return checked_stamp(stamp_ns, self._last_stamp_ns if self._num_frames else None)

    def _locate(self, target: Source) -> Answer:
        """Motion to a new scan from the last good one, or from a doubtful one that it fits better."""
        if self._anchor is None:
            return Answer(self._first(target), target)
        motion, aligned = self._align_to(self._anchor.source, target)
        if motion.status == "rejected" and self._doubtful is not None:
            second, aligned_second = self._align_to(self._doubtful.source, target)
            if second.status != "rejected":
                self._anchor = self._doubtful
                return Answer(second, aligned_second)
        return Answer(motion, aligned)

    def _locate_on_map(self, target: Source, tracker: MapTracker) -> Answer:
        """Motion to a new scan by the map, from the motion model's prediction; where that is bad, from other hypotheses."""
        if self._anchor is None:
            return Answer(self._first(target), target)
        expected, elapsed_s = None, self._anchor.source.seconds_until(target.stamp_ns)
        if self._motion_model.can_tell(elapsed_s):
            guess = self._motion_model.predict(elapsed_s)
            expected = tracker.locate(target.scan, self._anchor.T_world_lidar, [guess], elapsed_s, recovering=False)
            if expected.motion.status in ("ok", "degenerate") and is_near(guess, expected.motion.T_target_source):
                return self._accept(expected, target, tracker)
        return self._recover(target, tracker, expected)

    def _accept(self, located: Located, target: Source, tracker: MapTracker) -> Answer:
        self._map_refused = False
        tracker.accept(located)
        return Answer(located.motion, target._replace(scan=located.scan), located.noise)

    def _restart(self, tracker: MapTracker, anchor: Anchor) -> None:
        """A new map, which begins with this scan."""
        self._anchor = anchor._replace(standing=anchor.standing.settled())
        tracker.restart(anchor.source.scan, anchor.T_world_lidar)

    def _recover(self, target: Source, tracker: MapTracker, expected: Located | None) -> Answer:
        """Motion to a scan that is not where it was expected, or of which nothing was expected: the best of several hypotheses.

        The network aligns it with the last good scan; the map judges that pose and the predicted ones, each from two subsets of
        points. Where the network is sure and the map has none that fits, the network's stands; the second time a new map begins.
        Where nothing fits the last good scan, but the scan fits a doubtful one, that one takes over, with a new map.
        """
        assert self._anchor is not None
        pair, aligned = self._align_to(self._anchor.source, target)
        since = self._anchor  # its scan may have been de-skewed by its first motion
        if self._motion_model.velocity is None:
            self._restart(tracker, since)
        elapsed_s = since.source.seconds_until(target.stamp_ns)
        guesses = self._motion_model.predictions(elapsed_s)
        if pair.status != "rejected":
            guesses.append(pair.T_target_source)
        found = tracker.locate(aligned.scan, since.T_world_lidar, guesses, elapsed_s, recovering=True)
        if expected is not None and expected.score > found.score:
            found = expected
        if found.motion.status != "rejected":
            return self._accept(found, aligned, tracker)
        if pair.status == "ok":
            if self._map_refused:
                self._restart(tracker, since)
            self._map_refused = not self._map_refused
            reason = f"the map does not fit ({found.motion.reason}); aligned with the last good scan alone"
            return Answer(dataclasses.replace(pair, status="low_confidence", reason=reason), aligned)
        self._map_refused = False
        if self._doubtful is not None:
            second, aligned = self._align_to(self._doubtful.source, target)
            if second.status == "ok":
                self._restart(tracker, self._doubtful)
                return Answer(second, aligned)
        return Answer(found.motion, target)

    def _first(self, target: Source) -> Estimate:
        """The first scan is the world, unless it is unusable."""
        minimum = self._params.cfg.status.min_points
        if target.scan.num_points < minimum:
            return self._unmeasured(target.stamp_ns, f"the first scan has {target.scan.num_points} usable points, fewer than {minimum}")
        return Estimate.exact(np.eye(4))

    def _align_to(self, source: Source, target: Source) -> tuple[Estimate, Source]:
        """Motion T_source_target of a pair, started from the motion model's prediction, and the target as it was aligned."""
        elapsed_s = source.seconds_until(target.stamp_ns)
        guess = se3.inverse(self._motion_model.predict(elapsed_s))
        estimate = self._align(self._params, source.scan, target.scan, guess)
        if self._motion_model.velocity is None and estimate.status != "rejected":
            # the first motion de-skews its own two scans, then is measured again
            velocity = se3.log(se3.inverse(estimate.T_target_source)) / elapsed_s
            scans = source.scan.still(velocity), target.scan.still(velocity)
            if scans[0] is not source.scan and scans[1] is not target.scan:
                again = self._align(self._params, *scans, estimate.T_target_source)
                if again.status != "rejected":
                    estimate, target = again, target._replace(scan=scans[1])
                    if self._anchor is not None and self._anchor.source is source:
                        self._anchor = self._anchor._replace(source=source._replace(scan=scans[0]))
        return estimate.inverted(), target

    def _unmeasured(self, stamp_ns: int, reason: str) -> Estimate:
        """What the motion model says of a motion that was not measured."""
        elapsed_s = 0.0 if self._anchor is None else self._anchor.source.seconds_until(stamp_ns)
        known = covariance.unknown(self._params.cfg.status)
        motion = Estimate.exact(self._motion_model.predict(elapsed_s))
        return dataclasses.replace(motion, **known._asdict(), status="rejected", confidence=0.0, reason=reason)

    def _finish(self, answer: Answer, stamp_ns: int, timing: dict[str, float]) -> Frame:
        """Advance the state unless the motion was rejected, and record the frame."""
        anchor, number, target, motion = self._anchor, self._num_frames, answer.target, answer.motion
        rejected = motion.status == "rejected"
        if rejected:  # nobody has measured for that many frames: standard deviations grow with them
            self._num_rejected += 1
            growth = self._num_rejected**2
            motion = dataclasses.replace(motion, covariance=growth * motion.covariance, epistemic=growth * motion.epistemic)
        T_world_since, before = (np.eye(4), stream.EXACT) if anchor is None else (anchor.T_world_lidar, anchor.standing)
        T_world_lidar = T_world_since @ motion.T_target_source
        if answer.noise is None:
            standing = before.alone(motion.covariance, motion.T_target_source)
        else:
            known, standing = before.on_map(answer.noise, motion.T_target_source)
            motion = dataclasses.replace(motion, **known._asdict())
        if target is not None and not rejected:
            if anchor is not None:
                self._motion_model.update(motion.T_target_source, anchor.source.seconds_until(stamp_ns))
            if self._map is not None and not self._map_refused:
                begin = time.perf_counter()
                if self._map.insert(target.scan, T_world_lidar) and answer.noise is None:
                    standing = standing.settled()  # the map goes on from where the network put the scan
                timing = {**timing, "insert": time.perf_counter() - begin}
            self._anchor, self._doubtful, self._num_rejected = Anchor(target, T_world_lidar, standing), None, 0
        elif target is not None and anchor is not None and target.scan.num_points >= self._params.cfg.status.min_points:
            self._doubtful = Anchor(target, T_world_lidar, standing)
        self._num_frames, self._last_stamp_ns = number + 1, stamp_ns
        since = number if anchor is None else anchor.source.number
        local = standing.local.copy() if self._map is not None and self._map.calibrated else np.zeros((6, 6))
        frame = Frame(T_world_lidar.copy(), standing.covariance, local, motion, since, motion.status, stamp_ns, timing)
        self._last_scan = None if rejected or target is None else target.scan
        self._trajectory.append(frame)
        return frame
