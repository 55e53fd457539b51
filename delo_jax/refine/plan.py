"""The plan of a pose graph: which frames are held to which, and how firmly. Pure functions on NumPy arrays."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from delo_jax.errors import DeloError
from delo_jax.geometry import se3

KINDS = ("odometry", "multi-frame", "loop")
ODOMETRY, MULTI_FRAME, LOOP = range(len(KINDS))
CAUCHY_SCALE = 6.0  # of the length of a whitened residual; factors of honest noise keep 86 % of their weight
GAUGE_SIGMA = 1e-8  # of the first pose, which defines the world [rad, m]
STILL = np.repeat([1e-5, 1e-4], 3)  # a pose is handed on no better than this [rad, m]
_ORTHONORMAL = 1e-6
_SMALLEST_SHARE = 1e-10  # smallest eigenvalue of a correlation matrix that can be inverted


class Factors(NamedTuple):
    """Measured motions between frames, row by row."""

    sources: np.ndarray  # (k,) int: number of the frame that the motion starts from
    targets: np.ndarray  # (k,) int
    Ts_source_target: np.ndarray  # (k, 4, 4)
    covariances: np.ndarray  # (k, 6, 6) of a right perturbation, order [omega, v]
    kinds: np.ndarray  # (k,) int: place in KINDS

    @property
    def robust(self) -> np.ndarray:
        """(k,) which may be wrong altogether: all but the odometry's."""
        return self.kinds != ODOMETRY

    def rows(self, which: np.ndarray) -> "Factors":
        """Some of them."""
        return Factors(*(array[which] for array in self))


class Plan(NamedTuple):
    """A pose graph that any backend can solve; the first pose stays where it is."""

    Ts_world_lidar: np.ndarray  # (n, 4, 4) where to begin
    factors: Factors


class Refined(NamedTuple):
    """A solved plan."""

    Ts_world_lidar: np.ndarray  # (n, 4, 4)
    covariances: np.ndarray  # (n, 6, 6) marginals: of a right perturbation of each pose, given the first
    error_before: float  # half the sum of squared whitened residuals, robust ones damped
    error_after: float
    num_iterations: int
    converged: bool


def factors(
    sources: Sequence[int] | np.ndarray,
    targets: Sequence[int] | np.ndarray,
    Ts_source_target: np.ndarray,
    covariances: np.ndarray,
    kind: int,
) -> Factors:
    """Factors of one kind."""
    count = len(sources)
    Ts, Cs = np.asarray(Ts_source_target, np.float64), np.asarray(covariances, np.float64)
    index = np.asarray(sources, np.int64).reshape(count), np.asarray(targets, np.int64).reshape(count)
    return Factors(*index, Ts.reshape(-1, 4, 4), Cs.reshape(-1, 6, 6), np.full(count, kind))


def joined(parts: Sequence[Factors]) -> Factors:
    """All factors of several lots."""
    return Factors(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def odometry_factors(Ts_world_lidar: np.ndarray, since: np.ndarray, covariances: np.ndarray, local: np.ndarray) -> Factors:
    """One factor per frame from the second on: its motion since the frame that the odometry measured it from.

    The graph is about what errors are handed on from frame to frame. What is wrong with a single pose, its place on the map, is nothing
    that a chain of motions adds up: it goes to the factors that are measured from that frame, see `between_frames`.

    Args:
        Ts_world_lidar: (n, 4, 4) poses of the odometry.
        since: (n,) number of the frame that each motion starts from; a frame's own number where there is none.
        covariances: (n, 6, 6) of the poses.
        local: (n, 6, 6) the part of them that is not handed on.

    Raises:
        DeloError: covariances that are not finite.
    """
    bad = np.flatnonzero(~(np.isfinite(covariances) & np.isfinite(local)).all(axis=(1, 2)))
    if len(bad):
        raise DeloError(f"pose {bad[0]}: expected a finite covariance, got numbers that are not; give it a wide one")
    targets = np.arange(1, len(Ts_world_lidar))
    sources = np.where(since[1:] >= targets, targets - 1, since[1:])  # before the first usable frame there is no motion
    steps = se3.inverse(Ts_world_lidar[sources]) @ Ts_world_lidar[targets]
    handed_on = covariances - local
    grown = handed_on[targets] - carried(handed_on[sources], steps)
    values, vectors = np.linalg.eigh(0.5 * (grown + grown.transpose(0, 2, 1)) / (STILL[:, None] * STILL))
    halves = STILL[:, None] * vectors * np.sqrt(values.clip(min=0.0) + 1.0)[:, None, :]
    return factors(sources, targets, steps, halves @ halves.transpose(0, 2, 1), ODOMETRY)


def carried(covariances: np.ndarray, Ts_step: np.ndarray) -> np.ndarray:
    """Covariances (k, 6, 6) of poses as those of what lies a step (k, 4, 4) further on."""
    Ad = se3.adjoint(se3.inverse(Ts_step))
    return Ad @ covariances @ Ad.transpose(0, 2, 1)


def between_frames(pairs: np.ndarray, Ts_source_target: np.ndarray, covariances: np.ndarray, local: np.ndarray, kind: int) -> Factors:
    """Measured motions as factors between what the odometry hands on.

    Args:
        pairs: (k, 2) frames.
        Ts_source_target: (k, 4, 4).
        covariances: (k, 6, 6) of the measurements.
        local: (n, 6, 6) of all frames, as in `odometry_factors`.
        kind: place in KINDS.
    """
    sources, targets = np.asarray(pairs).reshape(-1, 2).T
    if len(sources) == 0:
        return factors([], [], np.zeros((0, 4, 4)), np.zeros((0, 6, 6)), kind)
    total = covariances + carried(local[sources], Ts_source_target) + local[targets]
    return factors(sources, targets, Ts_source_target, total, kind)


def check(plan: Plan) -> Plan:
    """The plan, if a backend can solve it.

    Raises:
        DeloError: numbers that are none, rotations that are not orthonormal, covariances that cannot be inverted, factors between frames
            that do not exist, or frames that nothing holds.
    """
    Ts, rows = plan
    count = len(Ts)
    if Ts.shape != (count, 4, 4) or count < 2:
        raise DeloError(f"poses: expected at least two, of shape (n, 4, 4), got shape {Ts.shape}")
    _check_poses(Ts, lambda i: f"pose {i}")
    ends = check_factors(rows, count)
    _check_connected(ends, count)
    return plan


def check_factors(rows: Factors, count: int) -> np.ndarray:
    """(k, 2) sources and targets of factors that a graph of `count` frames can hold.

    Raises:
        DeloError: as `check`.
    """
    if len({len(array) for array in rows}) != 1:
        raise DeloError(f"factors: expected as many of everything, got {', '.join(str(len(array)) for array in rows)}")
    ends = np.stack([rows.sources, rows.targets], 1)
    outside = np.flatnonzero((ends < 0).any(1) | (ends >= count).any(1) | (ends[:, 0] == ends[:, 1]))
    if len(outside):
        source, target = ends[outside[0]]
        raise DeloError(f"factor {outside[0]}: expected two different frames of 0 to {count - 1}, got {source} and {target}")

    def name(i: int) -> str:
        return f"factor {i} (frame {ends[i, 0]} to {ends[i, 1]}, {KINDS[rows.kinds[i]]})"

    _check_poses(rows.Ts_source_target, name)
    _check_covariances(rows.covariances, name)
    return ends


def _check_poses(Ts: np.ndarray, name: Any) -> None:
    bad = np.flatnonzero(~np.isfinite(Ts).all(axis=(1, 2)))
    if len(bad):
        raise DeloError(f"{name(int(bad[0]))}: expected finite numbers, got {np.sum(~np.isfinite(Ts[bad[0]]))} that are not; leave it out")
    R = Ts[:, :3, :3]
    off = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max(axis=(1, 2))
    off = np.maximum(off, np.abs(Ts[:, 3] - np.array([0.0, 0.0, 0.0, 1.0])).max(axis=1))
    off = np.where(np.linalg.det(R) > 0.0, off, np.inf)
    bad = np.flatnonzero(off > _ORTHONORMAL)
    if len(bad):
        how = "a reflection" if np.isinf(off[bad[0]]) else f"one that is off by {off[bad[0]]:.2g}"
        raise DeloError(f"{name(int(bad[0]))}: expected an orthonormal rotation over [0 0 0 1], got {how}; see geometry.se3.orthonormal")


def _check_covariances(Cs: np.ndarray, name: Any) -> None:
    finite = np.isfinite(Cs).all(axis=(1, 2))
    sizes = np.sqrt(np.diagonal(Cs, axis1=1, axis2=2).clip(min=0.0))
    usable = finite & (sizes > 0.0).all(axis=1)
    scale = np.where(usable[:, None], sizes, 1.0)
    shares = np.where(usable[:, None, None], Cs / (scale[:, :, None] * scale[:, None, :]), np.eye(6))
    lopsided = np.abs(shares - shares.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0) > 1e-6
    smallest = np.linalg.eigvalsh(0.5 * (shares + shares.transpose(0, 2, 1)))[:, 0]
    for wrong, what in (
        (~finite, "numbers that are not finite"),
        (lopsided, "one that is not symmetric"),
        (~usable | (smallest < _SMALLEST_SHARE), "a singular one"),
    ):
        bad = np.flatnonzero(wrong)
        if len(bad):
            raise DeloError(f"{name(int(bad[0]))}: expected a positive definite covariance, got {what}; widen it or leave the factor out")


def _check_connected(ends: np.ndarray, count: int) -> None:
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    parts, labels = connected_components(graph, directed=False)
    if parts > 1:
        alone = np.flatnonzero(labels != labels[0])
        what = f"got {parts}: nothing holds frame {alone[0]} to frame 0; join them by a factor, or refine each part alone"
        raise DeloError(f"graph: expected one part of {count} frames, {what}")
