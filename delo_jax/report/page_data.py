"""The numbers of a run's page as JSON: short, without NaN, safe inside an HTML page."""

import base64
import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from delo_jax.geometry import se3
from delo_jax.report.cloud import PlacedCloud

STATUSES = ("ok", "low_confidence", "degenerate", "rejected")
NANOSECOND = 1e-9
NOTHING = 1e-12


class Frames(NamedTuple):
    """What is shown of n frames; NaN where a method does not say."""

    stamps_ns: Int64[np.ndarray, " n"]
    statuses: Sequence[str]
    reasons: Sequence[str]
    confidences: Float[np.ndarray, " n"]
    since: Int64[np.ndarray, " n"]
    """Number of the frame that each motion starts from."""
    Ts_world_lidar: Float[np.ndarray, "n 4 4"]
    motion_covariances: Float[np.ndarray, "n 6 6"]
    pose_covariances: Float[np.ndarray, "n 6 6"]
    timing_s: Mapping[str, Float[np.ndarray, " n"]]
    """Stage to seconds per frame."""


class Refined(NamedTuple):
    """The track after a pose graph."""

    Ts_world_lidar: Float[np.ndarray, "n 4 4"]
    covariances: Float[np.ndarray, "n 6 6"]


def encode(frames: Frames, cloud: PlacedCloud, *, truth: np.ndarray | None = None, refined: Refined | None = None) -> str:
    """One JSON object; "<" is written as an escape, so that nothing in it ends the script element that it stands in."""
    Ts, stamps_ns = frames.Ts_world_lidar, frames.stamps_ns
    seconds = (stamps_ns - stamps_ns[:1]) * NANOSECOND
    table = {
        "n": len(Ts),
        "stamp_ns": str(stamps_ns[0]) if len(stamps_ns) else "",
        "t": _rounded(seconds, 6),
        "statuses": STATUSES,
        "status": [STATUSES.index(status) for status in frames.statuses],
        "reason": {number: reason for number, reason in enumerate(frames.reasons) if reason},
        "since": frames.since.tolist(),
        "confidence": _rounded(frames.confidences, 4),
        "track": _track(Ts),
        "yaw": _rounded(np.arctan2(Ts[:, 1, 0], Ts[:, 0, 0]), 4),
        "ellipse": _ellipses(Ts, frames.pose_covariances),
        "speed": _short(speeds(frames)),
        "timing": {name: _rounded(1e3 * values, 3) for name, values in frames.timing_s.items()},
        "truth": None if truth is None else _track(truth),
        "refined": None if refined is None else _track(refined.Ts_world_lidar),
        "sigmas": _sigmas(frames, truth, refined),
        "cloud": _cloud(cloud),
    }
    return json.dumps(table, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def motions(Ts: Float[np.ndarray, "n 4 4"], since: Int64[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
    """T_since_current of every frame."""
    return se3.inverse(Ts[since]) @ Ts


def errors(Ts: Float[np.ndarray, "n 4 4"], Ts_true: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 6"]:
    """Twists of T_true^-1 T, order [omega, v]: the perturbation that covariances are given in."""
    return se3.log(se3.inverse(Ts_true) @ Ts)


def speeds(frames: Frames) -> Float[np.ndarray, " n"]:
    """Mean over each motion [m/s]; NaN where no time went by."""
    elapsed_s = (frames.stamps_ns - frames.stamps_ns[frames.since]) * NANOSECOND
    steps_m = np.linalg.norm(motions(frames.Ts_world_lidar, frames.since)[:, :3, 3], axis=1)
    return np.divide(steps_m, elapsed_s, out=np.full(len(steps_m), np.nan), where=elapsed_s > 0)


def sigmas_of(covariances: Float[np.ndarray, "n 6 6"]) -> Float[np.ndarray, "n 6"]:
    """Standard deviations, order [omega (rad), v (m)]; NaN stays."""
    return np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))


def _sigmas(frames: Frames, truth: np.ndarray | None, refined: Refined | None) -> list[dict[str, Any]]:
    """Poses, motions and refined poses: standard deviations and errors, six rows of n each [deg, m]."""
    Ts, since = frames.Ts_world_lidar, frames.since
    sets = [("pose in the world", frames.pose_covariances, Ts, truth)]
    true_motions = None if truth is None else motions(truth, since)
    sets.append(("motion since the last frame", frames.motion_covariances, motions(Ts, since), true_motions))
    if refined is not None:
        sets.insert(1, ("refined pose", refined.covariances, refined.Ts_world_lidar, truth))
    units = np.repeat([np.rad2deg(1.0), 1.0], 3)
    result = []
    for name, covariances, found, true in sets:
        rows = None if true is None else [_short(row) for row in (units * errors(found, true)).T]
        result.append({"name": name, "sigma": [_short(row) for row in (units * sigmas_of(covariances)).T], "error": rows})
    return result


def _ellipses(Ts: np.ndarray, covariances: np.ndarray) -> list[list[float | None]]:
    """Covariances of x, x and y, and y of the positions in the world [m^2]."""
    R = Ts[:, :3, :3]
    C = R @ covariances[:, 3:, 3:] @ R.transpose(0, 2, 1)
    return [_short(C[:, i, j]) for i, j in ((0, 0), (0, 1), (1, 1))]


def _cloud(cloud: PlacedCloud) -> dict[str, Any]:
    """Points as int16, x y z of one after the other, the lowest first, heights as uint8 between their own 2nd and 98th percentile."""
    order = np.argsort(cloud.heights, kind="stable")  # what is high is drawn on top
    points, heights = cloud.points[order], cloud.heights[order]
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(3), np.zeros(3))
    middle, step = (low + high) / 2.0, np.maximum((high - low) / 65_534.0, 1e-4)
    bottom, top = np.percentile(heights, [2.0, 98.0]) if len(heights) else (0.0, 1.0)
    levels = np.clip((heights - bottom) / max(top - bottom, 0.1), 0.0, 1.0)
    return {
        "count": len(points),
        "middle": _rounded(middle, 4),
        "step": step.tolist(),
        "points": _base64(np.round((points - middle) / step).astype("<i2")),
        "levels": _base64(np.round(255.0 * levels).astype(np.uint8)),
        "heights": _rounded(np.array([bottom, top]), 2),
    }


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(array.tobytes()).decode("ascii")


def _track(Ts: np.ndarray) -> list[list[float | None]]:
    return [_rounded(Ts[:, axis, 3], 3) for axis in range(3)]


def _rounded(values: np.ndarray, digits: int) -> list[float | None]:
    """To that many digits after the point; None for what is not finite."""
    return [value if np.isfinite(value) else None for value in np.round(np.asarray(values, np.float64), digits).tolist()]


def _short(values: np.ndarray) -> list[float | None]:
    """To four significant digits, to 0 what is nothing but rounding; None for what is not finite."""
    values = np.where(np.abs(values) < NOTHING, 0.0, values)
    return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values.tolist()]
