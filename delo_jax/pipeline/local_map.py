"""The local map: surfaces seen lately, one per voxel, around the sensor. Host code."""

from typing import NamedTuple

import numpy as np

from delo_jax.config import NUM_FEATURES
from delo_jax.geometry import se3
from delo_jax.geometry.neighbors import Nearest, meanwhile, tree_of
from delo_jax.model.delo import Surfaces
from delo_jax.preprocess import Scan, posed_features, voxel_keys

SAME_SURFACE = 0.5  # cosine between normals above which two observations are of one surface
CROP_M = 60.0  # of the map around a predicted pose
MIN_TARGETS = 100  # surfaces there, for a scan to be registered to them
MUCH_NEARER = 0.5  # of the range at which a voxel was seen: a nearer observation replaces it


def surfaces_of(scan: Scan, rows: slice = slice(None)) -> Surfaces:
    """What a scan shows, in those rows."""
    return Surfaces(scan.points[rows], scan.normals[rows], scan.features[rows], scan.mask[rows])


class _Voxels(NamedTuple):
    """Occupied voxels, ascending by key."""

    keys: np.ndarray  # (v,) int64
    points: np.ndarray  # (v, 3) mean, world frame; float64, for far from its origin too
    normals: np.ndarray  # (v, 3) float32
    features: np.ndarray  # (v, f) float32
    ranges: np.ndarray  # (v,) float32, smallest distance from which it was seen [m]
    counts: np.ndarray  # (v,) float32, observations in the mean

    def rows(self, which: np.ndarray) -> "_Voxels":
        """Those voxels: their numbers."""
        return _Voxels(*(array.take(which, axis=0) for array in self))

    def merged(self, other: "_Voxels") -> "_Voxels":
        """These and others, which have other keys."""
        both = _Voxels(*(np.concatenate(arrays) for arrays in zip(self, other, strict=True)))
        return both.rows(np.argsort(both.keys, kind="stable"))


class LocalMap:
    """Running means of points, normals and features in voxels of the world, as far as the sensor reaches.

    Memory is bounded by the reach: what lies beyond it is forgotten by `prune`. A voxel holds one surface: observations whose
    normals agree with it are averaged; others are ignored, unless they were made from much nearer and take its place.

    Args:
        voxel_m: size of a voxel.
        reach_m: distance from the newest pose beyond which a voxel is forgotten.
        max_count: largest weight of a voxel's past; from then on its mean follows what is seen.
    """

    def __init__(self, voxel_m: float = 1.0, reach_m: float = 100.0, max_count: int = 10):
        self._voxel_m, self._reach_m, self._max_count = voxel_m, reach_m, max_count
        self._voxels: _Voxels | None = None

    def __len__(self) -> int:
        """Number of voxels."""
        return 0 if self._voxels is None else len(self._voxels.keys)

    def insert(self, seen: Surfaces, T_world_lidar: np.ndarray) -> None:
        """Take in what one scan shows, each voxel once: of several points in one, the nearest to the sensor."""
        new = self._observed(seen, T_world_lidar)
        if self._voxels is None or len(self) == 0:
            self._voxels = new
            return
        at = np.minimum(np.searchsorted(self._voxels.keys, new.keys), len(self) - 1)
        known = self._voxels.keys[at] == new.keys
        self._average(self._voxels, at[known], new.rows(np.flatnonzero(known)))
        self._voxels = self._voxels.merged(new.rows(np.flatnonzero(~known)))

    def _observed(self, seen: Surfaces, T_world_lidar: np.ndarray) -> _Voxels:
        """A scan as voxels seen once."""
        points, normals, features = (np.asarray(array)[np.asarray(seen.mask)] for array in seen[:3])
        world = se3.transform(T_world_lidar, points.astype(np.float64))
        normals = (normals @ T_world_lidar[:3, :3].T).astype(np.float32)
        ranges = np.linalg.norm(points, axis=1).astype(np.float32)
        keys = voxel_keys(world, self._voxel_m)
        order = np.lexsort((ranges, keys))
        first = order[np.flatnonzero(np.r_[True, keys[order][1:] != keys[order][:-1]])] if len(order) else order
        return _Voxels(keys, world, normals, features, ranges, np.ones(len(keys), np.float32)).rows(first)

    def _average(self, held: _Voxels, rows: np.ndarray, new: _Voxels) -> None:
        """Observations of voxels that are there already."""
        old = held.rows(rows)
        agrees = np.einsum("ij,ij->i", old.normals, new.normals) > SAME_SURFACE
        replaces = ~agrees & (new.ranges < MUCH_NEARER * old.ranges)
        counts = np.where(agrees, np.minimum(old.counts + 1.0, self._max_count), np.where(replaces, 1.0, old.counts))
        weight = np.where(agrees | replaces, np.where(agrees, 1.0 / counts, 1.0), 0.0)[:, None].astype(np.float32)
        normals = old.normals + weight * (new.normals - old.normals)
        held.points[rows] = old.points + weight * (new.points - old.points)
        held.normals[rows] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        held.features[rows] = old.features + weight * (new.features - old.features)
        held.ranges[rows] = np.where(agrees | replaces, np.minimum(old.ranges, new.ranges), old.ranges)
        held.counts[rows] = counts

    def prune(self, T_world_lidar: np.ndarray) -> None:
        """Forget what is out of reach of a pose."""
        if self._voxels is not None:
            self._voxels = self._voxels.rows(_near(self._voxels, T_world_lidar, self._reach_m))

    def crop(self, T_world_lidar: np.ndarray, reach_m: float) -> Surfaces:
        """The map within reach of a pose, in the sensor frame there, with the features that a sensor there would see."""
        if self._voxels is None:
            nothing = np.zeros((0, 3), np.float32)
            return Surfaces(nothing, nothing, np.zeros((0, NUM_FEATURES), np.float32), np.zeros(0, bool))
        rows, R = _near(self._voxels, T_world_lidar, reach_m), T_world_lidar[:3, :3]
        world, normals, features = (
            array.take(rows, axis=0) for array in (self._voxels.points, self._voxels.normals, self._voxels.features)
        )
        points = ((world - T_world_lidar[:3, 3]) @ R).astype(np.float32)
        normals = (normals @ R).astype(np.float32)
        normals = np.where(np.einsum("ij,ij->i", normals, points)[:, None] > 0, -normals, normals)
        ranges = np.maximum(np.linalg.norm(points, axis=1), 1e-3)
        return Surfaces(points, normals, posed_features(features, ranges, points, normals), np.ones(len(points), bool))


class Surroundings:
    """The map around a start, in the sensor frame there, so that its features are those that a sensor there would see.

    Neighbours are found by a tree on the host between jitted steps: less than a millisecond a round, where XLA on a CPU
    needs several.

    Args:
        local_map: the map.
        T_world_start: (4, 4) where the sensor is expected.
        reach_m: of `planes_in_reach`.
    """

    def __init__(self, local_map: LocalMap, T_world_start: np.ndarray, reach_m: float):
        self._seen, self._reach_m = local_map.crop(T_world_start, CROP_M), reach_m
        self.usable = len(self._seen.points) >= MIN_TARGETS
        self._tree = meanwhile(tree_of, np.asarray(self._seen.points))
        self._nearest: Nearest | None = None

    def matches(self, source: Surfaces, T: np.ndarray, rows: slice = slice(None)) -> Surfaces:
        """The nearest surface to each of those rows of a scan at T_start_lidar. The map must be usable."""
        _, index = self._matched(source, T, rows)
        return Surfaces(*(array.take(index, axis=0) for array in self._seen))

    def planes_in_reach(self, source: Surfaces, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Point and normal of the same, each (n, 3), for all of a scan; of some other surface where none is within reach."""
        moved, index = self._matched(source, T, slice(None))
        points, normals = (np.asarray(array) for array in self._seen[:2])
        offsets = moved - points.take(index, axis=0)
        index = np.where(np.einsum("ij,ij->i", offsets, offsets) < self._reach_m**2, index, len(points) - 1)
        return points.take(index, axis=0), normals.take(index, axis=0)

    def _matched(self, source: Surfaces, T: np.ndarray, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """Those rows in the map's frame, and the number of the surface nearest to each."""
        if self._nearest is None or self._nearest.num != len(source.points):
            self._nearest = Nearest(self._tree(), len(source.points))
        moved = np.asarray(source.points)[rows] @ T[:3, :3].T + T[:3, 3]
        return moved, self._nearest(moved, rows)


def _near(voxels: _Voxels, T_world_lidar: np.ndarray, reach_m: float) -> np.ndarray:
    offset = voxels.points - T_world_lidar[:3, 3]
    return np.flatnonzero(np.einsum("ij,ij->i", offset, offset) < reach_m**2)
