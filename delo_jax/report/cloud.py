"""A thinned cloud of a whole drive, gathered on the way, in bounded memory."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from delo_jax.data.fields import RawScan
from delo_jax.geometry import se3
from delo_jax.geometry.deskew import deskew
from delo_jax.inference import PreparedScan

SLOT_BITS = 21
SLOTS = 1 << SLOT_BITS
"""Of the table that says which voxels are taken; voxels that share a slot count as one, 3 in 100 when the cloud is full."""
MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
"""Odd numbers that spread neighbouring voxels over the highest bits of their sum, modulo 2^64."""
SHIFT = np.uint64(64 - SLOT_BITS)
COARSER = np.sqrt(2.0)
"""Surfaces keep half of their points in voxels that are so much larger."""

SPACING_M, SPACING_DEG = 1.0, 5.0
"""Motion since the last scan that was taken in: what is seen in between is hardly new."""

MAX_RAW_POINTS = 4096
"""Of a raw scan."""


class PlacedCloud(NamedTuple):
    """Points of a drive in the world."""

    points: Float64[np.ndarray, "m 3"]
    """World frame [m]."""
    heights: Float64[np.ndarray, " m"]
    """Above the sensor, when it saw the point [m]: a street that climbs does not change them."""


class DriveCloud:
    """One point for every voxel that a drive has seen, the first; voxels grow as the drive does.

    Points are kept in the frame of the sensor with the number of their scan, so that other poses can place them later.

    Args:
        max_points: kept at the end; up to twice as many meanwhile.
        voxel_m: size of a voxel at first.
        range_m: points nearer or farther from the sensor than this are left out.
    """

    def __init__(self, *, max_points: int = 60_000, voxel_m: float = 0.25, range_m: tuple[float, float] = (2.5, 45.0)):
        self.voxel_m = voxel_m
        self._max_points, self._range_m = max_points, range_m
        self._taken = np.zeros(SLOTS, bool)
        self._parts: list[np.ndarray] = []  # (k, 7) float32 each: sensor frame, world frame, number of the scan
        self._count = 0
        self._taken_at: np.ndarray | None = None

    def __len__(self) -> int:
        """Points kept so far."""
        return self._count

    def add(self, number: int, points: Float[np.ndarray, "n 3"], T_world_lidar: Float[np.ndarray, "4 4"]) -> None:
        """Takes what is new in a scan.

        Args:
            number: of its frame, below 2^24.
            points: sensor frame [m]; those that are not finite are left out.
            T_world_lidar: where the scan was taken, as far as is known now.
        """
        points = np.asarray(points, np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.einsum("ij,ij->i", points, points)
        points = points[(squares > self._range_m[0] ** 2) & (squares < self._range_m[1] ** 2)]  # false for NaN
        world = points @ T_world_lidar[:3, :3].T.astype(np.float32) + T_world_lidar[:3, 3].astype(np.float32)
        fresh = self._take(world)
        self._parts.append(np.column_stack([points[fresh], world[fresh], np.full(fresh.sum(), number, np.float32)]))
        self._count += len(self._parts[-1])
        while self._count > 2 * self._max_points:
            self._coarsen(COARSER)

    def add_scan(self, number: int, T_world_lidar: np.ndarray, scan: PreparedScan | RawScan, velocity: np.ndarray | None = None) -> None:
        """Takes what is new in a scan as it was registered, or in an even share of a raw one; once a metre or so.

        Args:
            number: of its frame, below 2^24.
            T_world_lidar: where the scan was taken, as far as is known now.
            scan: prepared or raw.
            velocity: (6,) of the body, [omega rad/s, v m/s], that a raw scan is de-skewed with where it has times.
        """
        if self._taken_at is not None and se3.is_within(self._taken_at, T_world_lidar, SPACING_M, SPACING_DEG):
            return
        self._taken_at = T_world_lidar
        if isinstance(scan, RawScan):
            share = slice(None, None, 1 + len(scan.points) // MAX_RAW_POINTS)
            points = scan.points[share]
            if velocity is not None and scan.times is not None:
                points = deskew(points, scan.times[share], velocity)
            self.add(number, points, T_world_lidar)
        else:
            self.add(number, np.asarray(scan.scan.points)[np.asarray(scan.scan.mask)], T_world_lidar)

    def placed(self, Ts_world_lidar: Float[np.ndarray, "n 4 4"]) -> PlacedCloud:
        """The cloud at these poses of the frames; points of later frames are left out."""
        while self._count > self._max_points:
            self._coarsen(max((self._count / self._max_points) ** 0.33, 1.02))
        rows = np.concatenate([np.zeros((0, 7), np.float32), *self._parts]).astype(np.float64)
        rows = rows[rows[:, 6] < len(Ts_world_lidar)]
        Ts = Ts_world_lidar[rows[:, 6].astype(int)]
        points = np.einsum("nij,nj->ni", Ts[:, :3, :3], rows[:, :3]) + Ts[:, :3, 3]
        return PlacedCloud(points, points[:, 2] - Ts[:, 2, 3])

    def _take(self, world: Float32[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which points are the first of their voxel; the voxels are taken then."""
        slots = self._slots(world)
        free = np.flatnonzero(~self._taken[slots])
        first = np.zeros(len(world), bool)
        first[free[np.unique(slots[free], return_index=True)[1]]] = True
        self._taken[slots] = True
        return first

    def _slots(self, world: Float32[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
        voxels = np.floor(world / np.float32(self.voxel_m)).astype(np.int64).astype(np.uint64)
        return ((voxels @ MIX) >> SHIFT).astype(np.int64)

    def _coarsen(self, factor: float) -> None:
        """Larger voxels, filled anew in the order of the drive."""
        self.voxel_m *= factor
        self._taken[:] = False
        rows = np.concatenate(self._parts)
        self._parts = [rows[self._take(rows[:, 3:6])]]
        self._count = len(self._parts[0])
