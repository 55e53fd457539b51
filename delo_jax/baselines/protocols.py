"""The two protocols of the baselines: two scans in, a pose out; and the scans of a drive one by one, each motion out."""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from delo_jax.geometry import se3
from delo_jax.inference import check_pose
from delo_jax.preprocess import check_points

FAR_M = 1e4  # sum of a point's coordinates, by their size, that no sensor reaches
MIN_POINTS = 100  # a scan with fewer is not given to any method
NUM_THREADS = 2  # of the packages that can be told


class Aligned(NamedTuple):
    """What a method says of two scans."""

    T_target_source: np.ndarray
    """(4, 4) float64; the start where the status is rejected."""
    covariance: np.ndarray
    """(6, 6), right perturbation, order [omega, v]; NaN where the method has none."""
    status: str
    """ok; low_confidence: the method doubts itself; rejected: it found nothing."""
    reason: str
    """Why the status is not ok; empty when it is."""

    @classmethod
    def of(cls, T_target_source: ArrayLike, doubt: str = "", *, status: str = "low_confidence") -> "Aligned":
        """A pose without uncertainty; `doubt` is what the method says against it."""
        return cls(np.array(T_target_source, np.float64), np.full((6, 6), np.nan), status if doubt else "ok", doubt)


class PairMethod:
    """Two scans and a start in, a pose out: `method(source, target, T_target_source_init)`.

    Who aligns a scan more than once prepares it once, and calls `align`.
    """

    def __call__(self, source: ArrayLike, target: ArrayLike, T_target_source_init: ArrayLike | None = None) -> Aligned:
        """Pose of two scans.

        Args:
            source: (n, 3) points [m].
            target: (m, 3) points [m].
            T_target_source_init: start; the identity by default.

        Raises:
            ScanError: wrong shape or dtype of a scan or of the start.
        """
        start = np.eye(4) if T_target_source_init is None else check_pose(T_target_source_init)
        clouds = [usable(check_points(points, name))[0] for points, name in ((source, "source"), (target, "target"))]
        fewest = min(map(len, clouds))
        if fewest < MIN_POINTS:
            return Aligned.of(start, too_few(fewest), status="rejected")
        return self.align(self.prepare(clouds[0]), self.prepare(clouds[1]), start)

    def prepare(self, points: np.ndarray) -> Any:
        """What `align` wants of a scan.

        Args:
            points: (n, 3) [m], finite, at least `MIN_POINTS` of them.
        """
        return points

    def align(self, source: Any, target: Any, T_target_source_init: np.ndarray) -> Aligned:
        """Pose of two prepared scans from a start."""
        raise NotImplementedError


class Sweep(NamedTuple):
    """The next scan of a drive."""

    points: np.ndarray
    """(n, 3) float64 [m], finite."""
    times_s: np.ndarray | None
    """(n,) relative to the stamp; None where there is nothing to de-skew."""
    elapsed_s: float
    """Since the last scan; 0 at the first."""


@runtime_checkable
class Tracker(Protocol):
    """A method along a drive; it knows the scans it was given before."""

    deskews: bool
    """Whether points come as measured, since it undoes the motion within a sweep itself or needs not; else they are de-skewed with the
    last motion."""

    def track(self, sweep: Sweep, T_last_guess: np.ndarray) -> Aligned:
        """Motion since the last scan, T_last_current, the new scan being the source; the identity at the first scan.

        Args:
            sweep: the new scan.
            T_last_guess: constant velocity's prediction of the motion.
        """
        ...


class ScanToScan:
    """A pair method along a drive: each scan is aligned with the last one, from constant velocity's prediction."""

    deskews = False

    def __init__(self, method: PairMethod):
        self._method, self._last = method, None

    def track(self, sweep: Sweep, T_last_guess: np.ndarray) -> Aligned:
        """T_last_current; where the method finds nothing, the prediction."""
        cloud, last = self._method.prepare(sweep.points), self._last
        self._last = cloud
        if last is None:
            return Aligned.of(np.eye(4))
        found = self._method.align(cloud, last, T_last_guess)
        if found.status == "rejected":
            return Aligned.of(T_last_guess, f"{found.reason}; carried on by constant velocity")
        return found._replace(T_target_source=se3.orthonormal(found.T_target_source))  # or rounding grows from scan to scan


def usable(points: np.ndarray, times_s: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    """Points that are finite, within reach of a sensor and not its origin, which is a ray without a return, and their times."""
    with np.errstate(over="ignore", invalid="ignore"):
        sizes = np.abs(points) @ np.ones(3, points.dtype)
        kept = (sizes > 0) & (sizes < FAR_M)  # NaN compares False
    if kept.all():
        return points, times_s
    return points[kept], None if times_s is None else times_s[kept]


def too_few(num_points: int) -> str:
    """Why a scan cannot be used."""
    return f"{num_points} usable points, fewer than {MIN_POINTS}"
