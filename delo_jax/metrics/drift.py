"""Drift of a trajectory as the KITTI odometry benchmark measures it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int64

from delo_jax.errors import DeloError
from delo_jax.metrics._poses import checked_pair

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
SHORT_LENGTHS_M = (10.0, 20.0, 30.0, 40.0, 50.0)
"""On paths that are shorter than the benchmark's."""
KITTI_SPEEDS_MPS = tuple(np.arange(2.0, 25.0, 2.0).tolist())
"""Centres of the benchmark's classes of speed. A class reaches 2 m/s to either side, so that neighbours overlap."""
KITTI_FRAME_S = 0.1
KITTI_MIN_SEGMENTS = 3
"""Classes with fewer segments are not plotted by the benchmark."""
_SPEED_REACH_MPS = 2.0


class Segments(NamedTuple):
    """Errors of s segments of one track, or of several."""

    lengths_m: Float64[np.ndarray, " k"]
    """The segment lengths asked for."""
    which: Int64[np.ndarray, " s"]
    """Index of each segment's length."""
    speed_mps: Float64[np.ndarray, " s"]
    """Length over time, a frame lasting 0.1 s and a segment as many frames as it touches."""
    t_rel_percent: Float64[np.ndarray, " s"]
    r_rel_deg_per_100m: Float64[np.ndarray, " s"]


class Drift(NamedTuple):
    """Mean drift over all segments, and the same for each segment length."""

    t_rel_percent: float
    """Translation error per distance, mean over all segments."""
    r_rel_deg_per_100m: float
    """Rotation error per distance, mean over all segments."""
    num_segments: int
    lengths_m: Float64[np.ndarray, " k"]
    """The segment lengths asked for; the three tables below have one entry for each."""
    t_rel_percent_by_length: Float64[np.ndarray, " k"]
    """NaN where no segment of this length fits on the track."""
    r_rel_deg_per_100m_by_length: Float64[np.ndarray, " k"]
    """NaN where no segment of this length fits on the track."""
    num_segments_by_length: Int64[np.ndarray, " k"]


class SpeedDrift(NamedTuple):
    """Mean drift over all segments that were driven at about the same speed."""

    speeds_mps: Float64[np.ndarray, " k"]
    """Centres of the classes; the three tables below have one entry for each."""
    t_rel_percent: Float64[np.ndarray, " k"]
    """NaN where no segment was driven at this speed."""
    r_rel_deg_per_100m: Float64[np.ndarray, " k"]
    """NaN where no segment was driven at this speed."""
    num_segments: Int64[np.ndarray, " k"]


def kitti_drift(
    Ts_estimated: Float[np.ndarray, "n 4 4"],
    Ts_true: Float[np.ndarray, "m 4 4"],
    *,
    lengths_m: Sequence[float] = KITTI_LENGTHS_M,
    step: int = 10,
) -> Drift:
    """Mean drift of one track: `mean_drift` of its `segment_errors`, which see."""
    return mean_drift(segment_errors(Ts_estimated, Ts_true, lengths_m=lengths_m, step=step))


def segment_errors(
    Ts_estimated: Float[np.ndarray, "n 4 4"],
    Ts_true: Float[np.ndarray, "m 4 4"],
    *,
    lengths_m: Sequence[float] = KITTI_LENGTHS_M,
    step: int = 10,
) -> Segments:
    """Relative errors of all sub-sequences of given lengths (Geiger et al. 2012, the odometry devkit).

    From every `step`-th frame i and for every length L, frame j is the first whose distance along the *true* path from i is
    greater than L. The error of the segment is (E_i^-1 E_j)^-1 (G_i^-1 G_j): its translation and its angle are divided by L.
    Inverses are general and the angle is the arc cosine of the clamped trace, as in the devkit: published trajectories hold
    rotations that are not quite orthonormal, and their numbers depend on it. Angles of single poses, which may be tiny, are those of
    `registration.pose_errors`.

    Args:
        Ts_estimated: estimated sensor poses, in any fixed world frame.
        Ts_true: true poses of the same sensor frame (`frames.compare_frames` tells), row i beside row i.
        lengths_m: segment lengths; the benchmark's by default, shorter ones for short tracks.
        step: a segment starts at every `step`-th frame.

    Returns:
        Errors in percent and degrees per 100 m, start by start.

    Raises:
        DeloError: wrong shape, unequal lengths, NaN or infinity, or a track shorter than the shortest segment.
    """
    estimated, true = checked_pair(Ts_estimated, Ts_true)
    lengths = np.asarray(lengths_m, dtype=np.float64)
    if lengths.ndim != 1 or lengths.size == 0 or not np.all(lengths > 0.0):
        raise DeloError(f"lengths_m: expected one or more lengths above 0, got {lengths_m}")
    if step < 1:
        raise DeloError(f"step: expected at least 1, got {step}")
    starts, ends, which = _segments(true, lengths, step)
    if starts.size == 0:
        raise DeloError(
            f"Ts_true: expected a path longer than the shortest segment of {lengths.min():g} m, "
            f"got {np.sum(_steps(true)):.1f} m in {len(true)} poses; ask for shorter lengths"
        )
    translation_m, rotation_rad = _segment_errors(estimated, true, starts, ends)
    return Segments(
        lengths_m=lengths,
        which=which,
        speed_mps=lengths[which] / (KITTI_FRAME_S * (ends - starts + 1)),
        t_rel_percent=100.0 * translation_m / lengths[which],
        r_rel_deg_per_100m=100.0 * np.rad2deg(rotation_rad) / lengths[which],
    )


def segments_that_fit(Ts_estimated: Float[np.ndarray, "n 4 4"], Ts_true: Float[np.ndarray, "m 4 4"]) -> Segments | None:
    """Errors of the benchmark's segments, of 10 to 50 m on shorter paths (from every frame); None on paths below 10 m.

    Raises:
        DeloError: as of `segment_errors`.
    """
    length = float(np.sum(_steps(Ts_true)))
    if length > KITTI_LENGTHS_M[0]:
        return segment_errors(Ts_estimated, Ts_true)
    return segment_errors(Ts_estimated, Ts_true, lengths_m=SHORT_LENGTHS_M, step=1) if length > SHORT_LENGTHS_M[0] else None


def joined(sequences: Sequence[Segments]) -> Segments:
    """The segments of several tracks as one: their mean is the benchmark's number of a method, where long tracks count for more.

    Raises:
        DeloError: none at all, or segments of different lengths.
    """
    if not sequences or any(not np.array_equal(segments.lengths_m, sequences[0].lengths_m) for segments in sequences):
        raise DeloError(f"sequences: expected one or more with the same segment lengths, got {len(sequences)} that are not")
    columns = zip(*(segments[1:] for segments in sequences), strict=True)
    return Segments(sequences[0].lengths_m, *(np.concatenate(column) for column in columns))


def mean_drift(segments: Segments) -> Drift:
    """Mean over all segments with equal weight, as in the benchmark, and over those of each length."""
    counts = np.bincount(segments.which, minlength=segments.lengths_m.size)
    return Drift(
        t_rel_percent=float(np.mean(segments.t_rel_percent)),
        r_rel_deg_per_100m=float(np.mean(segments.r_rel_deg_per_100m)),
        num_segments=int(segments.which.size),
        lengths_m=segments.lengths_m,
        t_rel_percent_by_length=_means(segments.t_rel_percent, segments.which, counts),
        r_rel_deg_per_100m_by_length=_means(segments.r_rel_deg_per_100m, segments.which, counts),
        num_segments_by_length=counts,
    )


def drift_by_speed(segments: Segments, *, speeds_mps: Sequence[float] = KITTI_SPEEDS_MPS) -> SpeedDrift:
    """Mean over the segments within 2 m/s of each speed, as the benchmark plots it; the classes overlap.

    Args:
        segments: of one track or several.
        speeds_mps: centres of the classes.
    """
    speeds = np.asarray(speeds_mps, dtype=np.float64)
    belongs = np.abs(segments.speed_mps[:, None] - speeds) < _SPEED_REACH_MPS
    counts = belongs.sum(axis=0)
    t_rel, r_rel = (
        np.where(counts > 0, values @ belongs / np.maximum(counts, 1), np.nan)
        for values in (segments.t_rel_percent, segments.r_rel_deg_per_100m)
    )
    return SpeedDrift(speeds, t_rel, r_rel, counts)


def _steps(Ts: Float64[np.ndarray, "n 4 4"]) -> Float64[np.ndarray, " s"]:
    return np.linalg.norm(np.diff(Ts[:, :3, 3], axis=0), axis=-1)


def _segments(Ts_true: Float64[np.ndarray, "n 4 4"], lengths: Float64[np.ndarray, " k"], step: int):
    """First frame, last frame and index of the length of every segment that fits on the track."""
    distance = np.concatenate([[0.0], np.cumsum(_steps(Ts_true))])[: len(Ts_true)]
    starts = np.arange(0, len(Ts_true), step)
    first, which = np.meshgrid(starts, np.arange(lengths.size), indexing="ij")
    last = np.searchsorted(distance, distance[first] + lengths[which], side="right")  # strictly farther, as in the devkit
    fits = last < len(Ts_true)
    return first[fits], last[fits], which[fits]


def _segment_errors(Ts_estimated: np.ndarray, Ts_true: np.ndarray, starts: np.ndarray, ends: np.ndarray):
    """Translation [m] and rotation [rad] of (E_i^-1 E_j)^-1 (G_i^-1 G_j)."""
    motions_estimated, motions_true = (np.linalg.solve(Ts[starts], Ts[ends]) for Ts in (Ts_estimated, Ts_true))
    Ts_error = np.linalg.solve(motions_estimated, motions_true)
    cosine = 0.5 * (np.trace(Ts_error[:, :3, :3], axis1=1, axis2=2) - 1.0)
    return np.linalg.norm(Ts_error[:, :3, 3], axis=-1), np.arccos(np.clip(cosine, -1.0, 1.0))


def _means(values: Float64[np.ndarray, " s"], which: Int64[np.ndarray, " s"], counts: Int64[np.ndarray, " k"]) -> Float64[np.ndarray, " k"]:
    sums = np.bincount(which, weights=values, minlength=counts.size)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
