"""Raw points to a `Scan`: crop, voxels, plane fits, features, key points. Host code (NumPy, SciPy), deterministic."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from delo_jax.config import NUM_FEATURES, PreprocessConfig
from delo_jax.errors import ScanError
from delo_jax.geometry.deskew import Sweep, sweep_of, sweep_poses
from delo_jax.geometry.neighbors import meanwhile, nearest_in, tree_of
from delo_jax.geometry.normals import plane_fit

MIN_NEIGHBORS = 5  # a plane through fewer points says nothing
MAX_RADIUS_M = 1.5  # of a neighbourhood
HORIZONTAL = 0.85  # |n_z| above which a surface counts as ground-like


class Scan(NamedTuple):
    """One padded scan. Rows are in random order, so that the first N are an even subset; invalid rows come last.

    With raw sampling there are neither normals nor features (no rows), and every point is a key point.
    """

    points: Float[Array, "m 3"] | Float[np.ndarray, "m 3"]  # sensor frame [m]
    normals: Float[Array, "s 3"] | Float[np.ndarray, "s 3"]  # unit, towards the sensor; s = m or 0
    features: Float[Array, "s f"] | Float[np.ndarray, "s f"]  # invariant to yaw
    mask: Bool[Array, " m"] | Bool[np.ndarray, " m"]  # True: a real point
    keypoint_index: Int[Array, " k"] | Int[np.ndarray, " k"]  # rows of `points`
    keypoint_mask: Bool[Array, " k"] | Bool[np.ndarray, " k"]


def check_points(points: ArrayLike, name: str = "points") -> np.ndarray:
    """`points` as a float32 array of shape (n, 3).

    Raises:
        ScanError: not an array of numbers, or not of shape (n, 3).
    """
    try:
        array = np.asarray(points)
    except ValueError as error:
        raise ScanError(f"{name}: expected an array of shape (n, 3) in metres, got rows of different lengths: {error}") from error
    if array.ndim != 2 or array.shape[1] != 3:
        hint = "; pass points[:, :3]" if array.ndim == 2 and array.shape[1] > 3 else ""
        raise ScanError(f"{name}: expected an array of shape (n, 3) in metres, got shape {array.shape}{hint}")
    if array.dtype.kind not in "fiu":
        raise ScanError(f"{name}: expected numbers, got dtype {array.dtype}; convert to float32")
    with np.errstate(over="ignore"):  # beyond float32 is infinite, and dropped as such
        return array.astype(np.float32, copy=False)


def preprocess(points: np.ndarray, cfg: PreprocessConfig) -> Scan:
    """Scan of a sensor sweep.

    Args:
        points: (n, 3) in the sensor frame [m]; rows that are not finite or out of range are dropped.
        cfg: sizes and thresholds.

    Returns:
        A `Scan` of NumPy arrays padded to `cfg.max_points` and `cfg.num_keypoints`; possibly without a single valid point.

    Raises:
        ScanError: wrong shape or dtype.
    """
    return preprocess_timed(points, None, cfg)[0]


def preprocess_timed(points: np.ndarray, times_s: np.ndarray | None, cfg: PreprocessConfig) -> tuple[Scan, np.ndarray | None]:
    """Scan of a sensor sweep, and when each of its points was measured.

    Args:
        points: (n, 3) in the sensor frame [m]; rows that are not finite or out of range are dropped.
        times_s: (n,) relative to the stamp; one that is not finite counts as 0. None where there are none.
        cfg: sizes and thresholds.

    Returns:
        The scan, as measured, and (max_points,) float32 times [s], means over a voxel like the points; None without times.

    Raises:
        ScanError: wrong shape or dtype.
    """
    points, rng = check_points(points), np.random.default_rng(0)  # the same scan gives the same bytes
    rows = np.arange(len(points)) if cfg.sampling == "raw" else _thinned(len(points), cfg.max_raw_points, rng)
    columns = np.empty((len(rows), 3 if times_s is None else 4), np.float32)
    columns[:, :3] = points.take(rows, axis=0)
    if times_s is not None:
        times = times_s.take(rows)
        columns[:, 3] = times if np.isfinite(times).all() else np.where(np.isfinite(times), times, 0.0)
    columns = _crop(columns, cfg)
    if cfg.sampling == "raw":
        return _raw_scan(columns, cfg, rng)
    cloud = voxel_mean(columns, cfg.voxel_m)
    tree = meanwhile(tree_of, cloud[:, :3])
    rows = one_per_voxel(cloud, cfg.point_voxel_m, rng)[: 2 * cfg.max_points]
    centers, normals, features, valid = _describe(np.ascontiguousarray(cloud[:, :3]), tree, rows, cfg)
    kept = _select(normals, valid, cfg, rng)
    points, normals, features = centers[kept], normals[kept], features[kept]
    keypoints = _keypoints(points, normals, cfg, rng)
    scan = Scan(
        _pad(points, cfg.max_points),
        _pad(normals, cfg.max_points),
        _pad(features, cfg.max_points),
        _pad(np.ones(len(kept), bool), cfg.max_points),
        _pad(keypoints.astype(np.int32), cfg.num_keypoints),
        _pad(np.ones(len(keypoints), bool), cfg.num_keypoints),
    )
    return scan, None if times_s is None else _pad(cloud[rows[kept], 3], cfg.max_points)


def sweep_of_scan(scan: Scan, times_s: np.ndarray) -> Sweep:
    """When the points of a scan were measured, from their (m,) times relative to the stamp [s]; padding does not widen the sweep."""
    return sweep_of(np.where(scan.mask, times_s, times_s[0]) if scan.mask.any() else times_s)


def still(scan: Scan, sweep: Sweep, velocity: np.ndarray) -> Scan:
    """A scan as measured, de-skewed: points and normals in the sensor frame at the stamp.

    Features stay: what a surface is like does not change, and its range and height hardly do.

    Args:
        scan: of NumPy arrays.
        sweep: when its points were measured.
        velocity: (6,) of the body, [omega rad/s, v m/s].
    """
    poses = sweep_poses(sweep, velocity)
    points = np.einsum("nij,nj->ni", poses[:, :3, :3], scan.points) + np.where(scan.mask[:, None], poses[:, :3, 3], np.float32(0.0))
    normals = np.einsum("nij,nj->ni", poses[:, :3, :3], scan.normals) if len(scan.normals) else scan.normals
    return scan._replace(points=points, normals=normals)


def _raw_scan(columns: np.ndarray, cfg: PreprocessConfig, rng: np.random.Generator) -> tuple[Scan, np.ndarray | None]:
    """Evenly spaced rows, as they are, in random order, every one a key point (Ali et al. 2023, Sec. 4)."""
    num = min(len(columns), cfg.max_points)
    kept = columns[rng.permutation(np.linspace(0, len(columns), num, endpoint=False).astype(np.int64))]
    mask = _pad(np.ones(num, bool), cfg.max_points)
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, NUM_FEATURES), np.float32)
    scan = Scan(_pad(kept[:, :3], cfg.max_points), *nothing, mask, np.arange(cfg.max_points, dtype=np.int32), mask)
    return scan, _pad(kept[:, 3], cfg.max_points) if kept.shape[1] > 3 else None


def _thinned(num: int, most: int, rng: np.random.Generator) -> np.ndarray:
    """At most so many of `num` rows: of every few that follow each other one at random.

    An even step would drop whole rings of a scan whose rows run from ring to ring.
    """
    stride = max(1, -(-num // most))
    rows = np.arange(0, num, stride)
    if stride > 1:
        rows += rng.integers(stride, size=len(rows), dtype=np.uint16)
        rows[-1] = min(rows[-1], num - 1)
    return rows


def _crop(columns: np.ndarray, cfg: PreprocessConfig) -> np.ndarray:
    """Rows whose first three columns, a point, are in range."""
    with np.errstate(invalid="ignore", over="ignore"):
        x, y, z = columns[:, 0], columns[:, 1], columns[:, 2]
        squared_range = x * x + y * y + z * z
        kept = (squared_range >= cfg.min_range_m**2) & (squared_range < cfg.max_range_m**2)  # NaN compares False
    return columns.take(np.flatnonzero(kept), axis=0)


def voxel_keys(points: np.ndarray, size: float) -> np.ndarray:
    """One int64 per point, the same for all points of a voxel [m]; unique within 2^20 voxels of the origin."""
    cells = np.floor(points * np.float32(1.0 / size)).astype(np.int64) + (1 << 20)
    return (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]


def _by_voxel(points: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows in the order of their voxels, within one as they were, and the places where each voxel begins."""
    row_bits = len(points).bit_length()
    keys, key_bits = np.zeros(len(points), np.int64), 0
    for column in points.T if len(points) else ():
        cells = np.floor(column * np.float32(1.0 / size)).astype(np.int64)
        low, high = int(cells.min()), int(cells.max())
        bits = (high - low).bit_length()
        keys, key_bits = (keys << bits) | (cells - low), key_bits + bits
    if key_bits + row_bits < 64:  # key and row in one number: sorting numbers is several times faster than sorting rows by them
        packed = np.sort((keys << row_bits) | np.arange(len(keys)))
        rows, keys = packed & ((1 << row_bits) - 1), packed >> row_bits
    else:
        keys = voxel_keys(points, size)
        rows = np.argsort(keys, kind="stable")
        keys = keys[rows]
    return rows, np.r_[np.zeros(min(len(keys), 1), np.int64), np.flatnonzero(keys[1:] != keys[:-1]) + 1]


def voxel_mean(columns: np.ndarray, size: float) -> np.ndarray:
    """Mean of the rows in every occupied voxel, (v, c) float32; the first three columns are a point."""
    if len(columns) == 0:
        return columns
    rows, starts = _by_voxel(columns[:, :3], size)
    counts = np.diff(starts, append=len(rows)).astype(np.float32)
    return np.add.reduceat(columns.take(rows, axis=0), starts, axis=0) / counts[:, None]


def one_per_voxel(points: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    """Row of one random point per occupied voxel, in random order."""
    order = rng.permutation(len(points))
    places, starts = _by_voxel(points[order, :3], size)
    return order[np.sort(places[starts])]


def _describe(cloud: np.ndarray, tree: Callable[[], cKDTree], rows: np.ndarray, cfg: PreprocessConfig):
    """Plane fits around `cloud[rows]`: points (on their plane where there is one), normals, features, validity."""
    if len(cloud) < MIN_NEIGHBORS:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, NUM_FEATURES), np.float32), np.zeros(0, bool)
    points = cloud[rows]
    ranges = np.linalg.norm(points, axis=1)
    radius = np.minimum(0.5 + 0.04 * ranges, MAX_RADIUS_M)
    k = min(cfg.num_neighbors, len(cloud))
    order = np.argsort(rows)  # the cloud is sorted by voxel: neighbours are asked for one after the other
    back = np.empty_like(order)
    back[order] = np.arange(len(order))
    distances, index = (found.take(back, axis=0) for found in nearest_in(tree(), points[order], k, MAX_RADIUS_M))
    near = distances <= radius[:, None]
    center, normal, eigenvalues = plane_fit(cloud.take(np.where(near, index, rows[:, None]), axis=0), near)
    planar = eigenvalues[:, 0] < 0.1 * eigenvalues[:, 1]
    offset = np.einsum("ij,ij->i", points - center, normal)
    projected = points - np.where(planar, offset, 0.0)[:, None] * normal
    normal = np.where(np.einsum("ij,ij->i", normal, projected)[:, None] > 0, -normal, normal)
    count = near.sum(axis=1)
    mean_distance = np.where(near, distances, 0.0).sum(axis=1) / np.maximum(count, 1)
    features = _features(projected, normal, eigenvalues, ranges, count / cfg.num_neighbors, mean_distance)
    valid = (count >= MIN_NEIGHBORS) & (eigenvalues[:, 1] > 1e-6)
    return projected.astype(np.float32), normal.astype(np.float32), features, valid


def _features(points, normals, eigenvalues, ranges, fill, mean_distance) -> np.ndarray:
    """Eight numbers of order one that do not change when the sensor yaws: five of the surface, three of where it is seen from."""
    small, middle, large = np.maximum(eigenvalues, 1e-8).T
    surface = [
        np.sqrt(small / large),
        np.sqrt(middle / large),
        np.log10(small) / 2 + 1.5,  # thickness; 3 cm is 0
        fill,
        np.log(np.maximum(mean_distance, 1e-3)) + 1.0,
    ]
    return posed_features(np.stack(surface, axis=1), ranges, points, normals)


def posed_features(features: np.ndarray, ranges: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Features of points as a sensor at the origin sees them: the first five of `features`, then range, height, steepness.

    Args:
        features: (n, 5 or more), of which the first five belong to the surface.
        ranges: (n,) distances at which they are seen [m].
        points: (n, 3) in the sensor frame [m].
        normals: (n, 3) unit.
    """
    seen = [np.log(ranges) - 2.7, points[:, 2] / 3.0, np.abs(normals[:, 2])]
    return np.concatenate([features[:, :5], np.stack(seen, axis=1)], axis=1).astype(np.float32)


def _select(normals: np.ndarray, valid: np.ndarray, cfg: PreprocessConfig, rng: np.random.Generator) -> np.ndarray:
    """Rows to keep, in random order: everything upright, and ground-like surfaces up to their share."""
    horizontal = np.abs(normals[:, 2]) > HORIZONTAL
    ground, rest = np.flatnonzero(valid & horizontal), np.flatnonzero(valid & ~horizontal)
    num_ground = min(len(ground), int(cfg.ground_share * cfg.max_points))
    kept = np.r_[ground[:num_ground], rest[: cfg.max_points - num_ground]]
    return rng.permutation(kept)


def _keypoints(points: np.ndarray, normals: np.ndarray, cfg: PreprocessConfig, rng: np.random.Generator) -> np.ndarray:
    upright = np.flatnonzero((np.abs(normals[:, 2]) < HORIZONTAL) & (np.linalg.norm(points, axis=1) < cfg.keypoint_range_m))
    return upright[one_per_voxel(points[upright], cfg.keypoint_voxel_m, rng)][: cfg.num_keypoints]


def _pad(array: np.ndarray, length: int) -> np.ndarray:
    padded = np.zeros((length, *array.shape[1:]), array.dtype)
    padded[: len(array)] = array
    return padded
