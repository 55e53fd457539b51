"""Which primitives may be met by which tile of rays; conservative, on the host."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from delo_jax.sim.primitives import Primitives, take
from delo_jax.sim.raycast import Table, Work
from delo_jax.sim.sensors import COLUMNS_PER_GROUP


class Wedges(NamedTuple):
    """The space that each group of columns looks into, in the flat world from a local origin."""

    origin: Float[np.ndarray, "groups 2"]
    left: Float[np.ndarray, "groups 2"]
    """Unit normal of the left bounding line, pointing into the wedge."""
    right: Float[np.ndarray, "groups 2"]
    lowest: Float[np.ndarray, "groups blocks"]
    """Tangent of the lowest elevation of a block of rings."""
    highest: Float[np.ndarray, "groups blocks"]


def group_starts(num_columns: int) -> Int[np.ndarray, " groups"]:
    """First column of each group; the last group overlaps its neighbour to end with the sweep."""
    starts = np.arange(0, num_columns, COLUMNS_PER_GROUP)
    return np.minimum(starts, num_columns - COLUMNS_PER_GROUP).astype(np.int32)


def make_wedges(
    origin: Float[np.ndarray, "columns 3"],
    R_flat_lidar: Float[np.ndarray, "columns 3 3"],
    azimuth: Float[np.ndarray, " columns"],
    elevation: Float[np.ndarray, "blocks rings"],
    *,
    margin: float = 0.012,
) -> Wedges:
    """Bounding wedges of the column groups.

    Args:
        origin: of the rays of a column [m].
        R_flat_lidar: maps directions of the sensor frame to the flat world, about a rotation.
        azimuth: of the columns in the sensor frame [rad].
        elevation: of the rings, grouped in blocks [rad].
        margin: widens each wedge on both sides [rad]: covers beam errors and jitter.
    """
    starts = group_starts(len(azimuth))
    columns = starts[:, None] + np.array([0, COLUMNS_PER_GROUP - 1])[None]
    # Tilt bends a block's fan, so its corners bound it: both edge columns, both edge rings.
    ring = np.stack([elevation.max(axis=1) + margin, elevation.min(axis=1) - margin], axis=1)
    a = azimuth[columns][:, :, None, None] + margin * np.array([-1.0, 1.0])[None, :, None, None]
    d = np.stack(np.broadcast_arrays(np.cos(ring) * np.cos(a), np.cos(ring) * np.sin(a), np.sin(ring)), axis=-1)
    d = np.einsum("gcij,gcbkj->gcbki", R_flat_lidar[columns], d)
    tangent = d[..., 2] / np.hypot(d[..., 0], d[..., 1])
    middle = d[..., :2].mean(axis=(1, 2, 3))
    angle = np.arctan2(middle[:, None] @ np.array([[0.0], [1.0]]), middle[:, None] @ np.array([[1.0], [0.0]]))[:, 0]
    offset = np.arctan2(d[..., 1], d[..., 0]).reshape(len(starts), -1) - angle
    offset = np.mod(offset + np.pi, 2.0 * np.pi) - np.pi
    first, last = angle[:, 0] + offset.min(axis=1), angle[:, 0] + offset.max(axis=1)
    return Wedges(
        origin=origin[starts + COLUMNS_PER_GROUP // 2, :2],
        left=np.stack([np.sin(last), -np.cos(last)], axis=1),
        right=np.stack([-np.sin(first), np.cos(first)], axis=1),
        lowest=tangent.min(axis=(1, 3)),
        highest=tangent.max(axis=(1, 3)),
    )


def near(primitives: Primitives, origin: Float[np.ndarray, " 3"], max_range: float) -> np.ndarray:
    """Indices of what reaches into the horizontal disc of `max_range` around the origin."""
    reach = np.hypot(primitives.half_size[:, 0], primitives.half_size[:, 1])
    distance = np.hypot(primitives.center[:, 0] - origin[0], primitives.center[:, 1] - origin[1])
    return np.flatnonzero(distance - reach < max_range)


def find_work(
    primitives: Primitives,
    origin: Float[np.ndarray, " 3"],
    wedges: Wedges,
    starts: Int[np.ndarray, " groups"],
    *,
    slack_s: float,
    travel: float,
) -> Work:
    """Pairs of primitive and tile that may meet, sorted by shape.

    A box meets a wedge unless a bounding line of the wedge separates them; other bodies count as
    their boxes. Vertically, the elevations under which the box appears must overlap the block's.

    Args:
        primitives: sorted by shape, positions at the stamp, counted from the local origin.
        origin: of the sensor at the stamp.
        wedges: of the column groups.
        starts: first column of each group.
        slack_s: moving shapes are grown by what they travel in this time.
        travel: of the sensor within half a sweep [m].
    """
    cos, sin = np.cos(primitives.yaw), np.sin(primitives.yaw)
    half = primitives.half_size[:, :2] + (slack_s * np.hypot(*primitives.velocity.T) + 0.1)[:, None]
    axes = np.stack([np.stack([cos, sin], 1), np.stack([-sin, cos], 1)])

    def reaches(normal):
        depth = primitives.center[:, :2] @ normal.T - np.sum(wedges.origin * normal, axis=1)[None]
        for axis, size in zip(axes, half.T, strict=True):
            depth += size[:, None] * np.abs(axis @ normal.T)
        return depth > 0.0

    forward = wedges.left + wedges.right
    seen = reaches(wedges.left) & reaches(wedges.right) & reaches(forward)
    offset = primitives.center[:, :2] - origin[None, :2]
    outside = np.abs(np.einsum("akj,kj->ka", axes, offset)) - half
    nearest = np.maximum(np.linalg.norm(np.maximum(outside, 0.0), axis=1) - travel, 0.3)
    farthest = np.linalg.norm(offset, axis=1) + np.linalg.norm(half, axis=1) + travel
    bottom = primitives.center[:, 2] - primitives.half_size[:, 2] - origin[2] - 0.1
    top = primitives.center[:, 2] + primitives.half_size[:, 2] - origin[2] + 0.1
    lowest = np.minimum(bottom / nearest, bottom / farthest)[:, None, None]
    highest = np.maximum(top / nearest, top / farthest)[:, None, None]
    pairs = seen[:, :, None] & (wedges.highest[None] > lowest) & (wedges.lowest[None] < highest)
    primitive, group, block = np.nonzero(pairs)
    ends = np.searchsorted(primitives.shape[primitive], [0, 1, 2], side="right")
    return Work(primitive=_pad(primitive), block=_pad(block), start=_pad(starts[group]), ends=ends.astype(np.int32))


def _pad(index: np.ndarray, smallest: int = 16384) -> np.ndarray:
    """The index as int32, zeros appended up to a power of two, so that few shapes are compiled."""
    size = smallest
    while size < len(index):
        size *= 2
    return np.pad(index.astype(np.int32), (0, size - len(index)))


def make_table(primitives: Primitives, smallest: int = 4096) -> Table:
    """The primitives as padded float32 arrays for the device."""
    values = np.concatenate(
        [
            primitives.center,
            primitives.half_size,
            np.stack([np.cos(primitives.yaw), np.sin(primitives.yaw)], axis=1),
            primitives.velocity,
            np.stack([primitives.opacity, primitives.softness], axis=1),
        ],
        axis=1,
    )
    shape = _pad(primitives.shape, smallest)
    padding = np.ones((len(shape) - len(values), values.shape[1]))
    return Table(shape=shape, values=np.concatenate([values, padding]).astype(np.float32))


def sort_by_shape(primitives: Primitives) -> Primitives:
    """Boxes first, then cylinders, then ellipsoids."""
    return take(primitives, np.argsort(primitives.shape, kind="stable"))
