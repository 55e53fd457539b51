"""Other methods as a streaming odometry: the same calls and frames as `LidarOdometry`, without uncertainty."""

import time
from typing import NamedTuple

import numpy as np

from delo_jax.baselines.protocols import MIN_POINTS, Aligned, Sweep, Tracker, too_few, usable
from delo_jax.geometry.deskew import deskew
from delo_jax.inference import Estimate
from delo_jax.pipeline.lidar_odometry import Frame
from delo_jax.pipeline.motion_model import NANOSECOND, ConstantVelocity
from delo_jax.pipeline.stamps import checked_stamp, checked_times
from delo_jax.pipeline.trajectory import Trajectory
from delo_jax.preprocess import check_points


class Last(NamedTuple):
    """The last scan that the method has seen."""

    T_world_lidar: np.ndarray
    stamp_ns: int
    number: int  # of its frame


class BaselineOdometry:
    """A method of `delo_jax.baselines` along a drive. Not thread-safe; one instance per sensor stream.

    Scans are de-skewed with the last motion, unless the method does that itself, and expected where constant velocity says. A scan
    that cannot be used is a frame of status `rejected` at the predicted pose, and the method never sees it. Covariances, variances
    and confidence are NaN.

    Args:
        tracker: the method, fresh.
        deskew: undo the motion within a sweep where points carry times.
    """

    def __init__(self, tracker: Tracker, *, deskew: bool = True):
        self._tracker, self._deskew, self._motion_model = tracker, deskew, ConstantVelocity()
        self._last: Last | None = None
        self._num_frames, self._last_stamp_ns = 0, 0
        self._trajectory = Trajectory()

    def register(self, points: np.ndarray, stamp_ns: int | None = None, times_s: np.ndarray | None = None) -> Frame:
        """Pose of the sensor at this scan; the first usable scan defines the world frame.

        Args:
            points: (n, 3) in the sensor frame [m].
            stamp_ns: time of the scan; 0.1 s after the last one when None.
            times_s: (n,) time of each point relative to the stamp, for the de-skew; one that is not finite counts as 0. None when already
                compensated.

        Raises:
            ScanError: wrong shape or dtype, or a stamp that does not rise; the state is as if the scan never arrived.
        """
        points, stamp_ns = check_points(points), self._check_stamp(stamp_ns)
        times_s = checked_times(times_s if self._deskew else None, len(points))
        begin = time.perf_counter()
        points, times_s = usable(points, np.nan_to_num(times_s, posinf=0.0, neginf=0.0) if self._deskew and times_s is not None else None)
        if len(points) < MIN_POINTS:
            return self._finish(Aligned.of(self._guess(stamp_ns), too_few(len(points)), status="rejected"), stamp_ns, {})
        points = points.astype(np.float64)
        if times_s is not None and not self._tracker.deskews and self._motion_model.velocity is not None:
            points = deskew(points, times_s, self._motion_model.velocity)
        prepared = time.perf_counter()
        found = self._tracker.track(Sweep(points, times_s, self._elapsed_s(stamp_ns)), self._guess(stamp_ns))
        timing = {"prepare": prepared - begin, "solve": time.perf_counter() - prepared}
        if not np.isfinite(found.T_target_source).all():
            found = Aligned.of(self._guess(stamp_ns), "the pose found is not a number", status="rejected")
        return self._finish(found, stamp_ns, timing)

    def reject(self, reason: str, stamp_ns: int | None = None) -> Frame:
        """Frame of a scan that could not be read: carried by the motion model, status `rejected`."""
        stamp_ns = self._check_stamp(stamp_ns)
        return self._finish(Aligned.of(self._guess(stamp_ns), reason, status="rejected"), stamp_ns, {})

    def trajectory(self) -> Trajectory:
        """All frames so far."""
        return self._trajectory

    @property
    def velocity(self) -> np.ndarray | None:
        """Of the last motion, (6,) [omega rad/s, v m/s], to de-skew its scan with; None where that is not known or not wanted."""
        return self._motion_model.velocity if self._deskew else None

    def _check_stamp(self, stamp_ns: int | None) -> int:
        return checked_stamp(stamp_ns, self._last_stamp_ns if self._num_frames else None)

    def _elapsed_s(self, stamp_ns: int) -> float:
        return 0.0 if self._last is None else (stamp_ns - self._last.stamp_ns) * NANOSECOND

    def _guess(self, stamp_ns: int) -> np.ndarray:
        """T_last_current as constant velocity has it."""
        return self._motion_model.predict(self._elapsed_s(stamp_ns))

    def _finish(self, found: Aligned, stamp_ns: int, timing: dict[str, float]) -> Frame:
        """Advance the state unless the scan was rejected, and record the frame."""
        last, number, motion = self._last, self._num_frames, found.T_target_source
        T_world_lidar = motion.copy() if last is None else last.T_world_lidar @ motion
        if found.status != "rejected":
            if last is not None:
                self._motion_model.update(motion, self._elapsed_s(stamp_ns))
            self._last = Last(T_world_lidar, stamp_ns, number)
        self._num_frames, self._last_stamp_ns = number + 1, stamp_ns
        unknown = np.full((6, 6), np.nan)
        estimate = Estimate(
            T_target_source=motion,
            covariance=unknown,
            aleatoric=unknown[0],
            epistemic=unknown[0],
            status=found.status,
            confidence=np.nan,
            reason=found.reason,
        )
        since = number if last is None else last.number
        frame = Frame(T_world_lidar.copy(), unknown, unknown, estimate, since, found.status, stamp_ns, timing)
        self._trajectory.append(frame)
        return frame
