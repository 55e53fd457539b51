"""Whether two trajectories are of the same sensor frame, told by the direction in which their bodies move."""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from delo_jax.metrics._poses import checked_pair

SEGMENT_M = 2.0  # long enough that the noise of single steps does not turn its direction
MIN_SEGMENTS = 3
OTHER_DEG, OPPOSITE_DEG = 45.0, 135.0  # half-way to another axis, and to the opposite one
_ALIKE_DEG = 30.0  # of directions that are the same but for the naming of the axes
_AXES = ("+x", "+y", "+z", "-x", "-y", "-z")
_SENSORS = {"x": "lidar", "z": "camera"}


class FrameMatch(NamedTuple):
    """What the motions of an estimate and of the truth say of their frames."""

    agree: bool
    """False where the estimate moves along another axis of its body than the truth, steadily; True also where nothing can be told."""
    opposite: bool
    """The estimate moves backward where the truth moves forward: inverted poses, or a method that failed."""
    estimated_axis: str
    """Axis of its body along which the estimate mostly moves, "+x" to "-z"; empty where it hardly moves."""
    true_axis: str
    """The same of the truth."""
    angle_deg: float
    """Median angle between the two directions of motion, each in its own body frame; NaN where one of them hardly moves."""


def compare_frames(Ts_estimated: Float[np.ndarray, "n 4 4"], Ts_true: Float[np.ndarray, "m 4 4"]) -> FrameMatch:
    """Whether estimated and true poses can be of the same sensor frame.

    A LiDAR's poses move along x of their body, those of KITTI's cameras along z. Compared are the directions of motion over 2 m of
    the true path, each in the body frame of its start: world frames do not matter, nor does a vehicle that stands, turns or reverses,
    since both then do. The frames differ where the median angle is beyond 45 deg *and* another naming of the axes brings it below
    30 deg: a method that is merely bad moves in all directions. The opposite direction alone is no other frame.

    Args:
        Ts_estimated: estimated poses, in any fixed world frame.
        Ts_true: true poses, row i beside row i.

    Returns:
        The verdict and what it rests on.

    Raises:
        DeloError: wrong shape, unequal lengths, NaN or infinity.
    """
    estimated, true = checked_pair(Ts_estimated, Ts_true)
    starts, ends = _segments(true)
    moved_estimated, moved_true = _moves(estimated, starts, ends), _moves(true, starts, ends)
    both = _far(moved_estimated) & _far(moved_true)
    axes = _main_axis(moved_estimated), _main_axis(moved_true)
    if both.sum() < MIN_SEGMENTS:
        return FrameMatch(True, False, *axes, np.nan)
    directions = _unit(moved_estimated[both]), _unit(moved_true[both])
    angle_deg = _median_angle_deg(*directions)
    renamed_deg = min(_median_angle_deg(directions[0] @ R.T, directions[1]) for R in _axis_namings())
    opposite = angle_deg > OPPOSITE_DEG
    agree = opposite or angle_deg <= OTHER_DEG or renamed_deg > _ALIKE_DEG
    return FrameMatch(agree, opposite, *axes, angle_deg)


def sensor_of(axis: str) -> str:
    """The kind of sensor whose poses move along an axis of their body: "lidar" (x), "camera" (z), else empty."""
    return _SENSORS.get(axis[1:], "")


def _segments(Ts_true: Float64[np.ndarray, "n 4 4"]):
    """First and last frames of the pieces of 2 m of the path, one from every frame."""
    steps = np.linalg.norm(np.diff(Ts_true[:, :3, 3], axis=0), axis=-1)
    distance = np.concatenate([[0.0], np.cumsum(steps)])[: len(Ts_true)]
    last = np.searchsorted(distance, distance + SEGMENT_M)
    first = np.flatnonzero(last < len(Ts_true))
    return first, last[first]


def _moves(Ts: Float64[np.ndarray, "n 4 4"], starts: np.ndarray, ends: np.ndarray) -> Float64[np.ndarray, "s 3"]:
    """Displacements [m] in the body frame of their start."""
    moved = Ts[ends, :3, 3] - Ts[starts, :3, 3]
    return np.einsum("sij,si->sj", Ts[starts, :3, :3], moved)


def _far(moves: Float64[np.ndarray, "s 3"]) -> Bool[np.ndarray, " s"]:
    return np.linalg.norm(moves, axis=-1) > SEGMENT_M / 2


def _unit(moves: Float64[np.ndarray, "s 3"]) -> Float64[np.ndarray, "s 3"]:
    return moves / np.linalg.norm(moves, axis=-1, keepdims=True)


def _main_axis(moves: Float64[np.ndarray, "s 3"]) -> str:
    moves = moves[_far(moves)]
    if len(moves) < MIN_SEGMENTS:
        return ""
    along = np.argmax(np.concatenate([moves, -moves], axis=-1), axis=-1)
    return _AXES[np.argmax(np.bincount(along, minlength=6))]


def _median_angle_deg(a: Float64[np.ndarray, "s 3"], b: Float64[np.ndarray, "s 3"]) -> float:
    return float(np.median(np.rad2deg(np.arccos(np.clip(np.sum(a * b, axis=-1), -1.0, 1.0)))))


def _axis_namings() -> list[Float64[np.ndarray, "3 3"]]:
    """The 24 rotations that map axes onto axes."""
    signs = list(itertools.product((1.0, -1.0), repeat=3))
    namings = (np.eye(3)[list(order)] * sign for order in itertools.permutations(range(3)) for sign in signs)
    return [R for R in namings if np.linalg.det(R) > 0]
