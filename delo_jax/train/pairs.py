"""Training pairs from worlds: random frames of one world, augmented, with a start for the fine stage. Host code."""

import jax
import numpy as np

from delo_jax.config import TrainConfig
from delo_jax.geometry import se3
from delo_jax.model.delo import Surfaces
from delo_jax.pipeline.local_map import CROP_M, LocalMap, surfaces_of
from delo_jax.preprocess import Scan
from delo_jax.train.step import PairBatch
from delo_jax.train.worlds import World

MAX_IDENTITY_START_M = 2.5  # farther than this the identity is no start for a local method
MAP_FRAMES = 2, 5  # frames in a local map
MAP_POSE_SIGMA = np.repeat([np.radians(0.05), 0.01], 3)  # of the frames in a map: an odometry is never exact
WIDE_SHARE = 0.55  # of the predictions on a map, off by as much as after an outage; the others as in a stream
WIDE_M, WIDE_DEG = 3.5, 17.0


def _rotation_z(angle: float) -> np.ndarray:
    return se3.exp(np.array([0.0, 0.0, angle, 0.0, 0.0, 0.0]))


def _drawn(scan: Scan, num_points: int, rng: np.random.Generator) -> Scan:
    """Another draw of a raw scan: that many of its points, without replacement."""
    order = rng.permutation(int(scan.mask.sum()))[:num_points]
    mask = np.arange(num_points) < len(order)
    points = np.zeros((num_points, 3), np.float32)
    points[: len(order)] = scan.points[order]
    return scan._replace(points=points, mask=mask, keypoint_index=np.arange(num_points, dtype=np.int32), keypoint_mask=mask)


def _augment(scan: Scan, T: np.ndarray, mirror: bool, drop: float, rng: np.random.Generator) -> Scan:
    """The scan seen from a turned (and mirrored) sensor, rows reshuffled, some points dropped."""
    linear = T[:3, :3] @ np.diag([1.0, -1.0 if mirror else 1.0, 1.0])
    order = rng.permutation(len(scan.mask))
    keep = scan.mask[order] & (rng.random(len(order)) >= drop)
    order = np.concatenate([order[keep], order[~keep]])
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    mask = np.arange(len(order)) < keep.sum()
    raw = len(scan.normals) == 0
    index = scan.keypoint_index if raw else rank[scan.keypoint_index].astype(np.int32)
    return Scan(
        (scan.points[order] @ linear.T).astype(np.float32),
        scan.normals if raw else (scan.normals[order] @ linear.T).astype(np.float32),
        scan.features if raw else scan.features[order],
        mask,
        index,
        scan.keypoint_mask & mask[index],
    )


def _start(T_true: np.ndarray, T_identity: np.ndarray, kind: int, rng: np.random.Generator) -> np.ndarray:
    """Start of the fine stage: the identity (of the scans before augmentation), or the truth plus a disturbance."""
    if kind == 0 and np.linalg.norm(T_true[:3, 3]) < MAX_IDENTITY_START_M:
        return T_identity
    size = np.exp(rng.uniform(np.log(0.03), np.log(1.2)))
    xi = rng.normal(size=6)
    xi[:3] *= size * np.radians(3.0) / np.sqrt(3.0)
    xi[3:] *= size / np.sqrt(3.0)
    return T_true @ se3.exp(xi)


def _wrong_prediction(rng: np.random.Generator) -> np.ndarray:
    """T_predicted_source of a scan that is not where it was expected."""
    if rng.random() >= WIDE_SHARE:
        return _start(np.eye(4), np.eye(4), 1, rng)
    length, direction = WIDE_M * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
    roll, pitch, z = rng.normal(size=3) * [np.radians(0.5), np.radians(0.5), 0.05]
    yaw = np.radians(rng.uniform(-WIDE_DEG, WIDE_DEG))
    return se3.exp(np.array([roll, pitch, yaw, length * np.cos(direction), length * np.sin(direction), z]))


def _map_around(world: World, frame: int, T_predicted_source: np.ndarray, cfg: TrainConfig, rng: np.random.Generator) -> Surfaces:
    """What a local map of other frames shows of the surroundings of a frame, in the frame where that one was expected."""
    others = np.delete(np.arange(len(world.Ts_world_lidar)), frame)
    num = min(int(rng.integers(MAP_FRAMES[0], MAP_FRAMES[1] + 1)), len(others))
    local_map = LocalMap()
    for other in np.sort(rng.permutation(others)[:num]):
        local_map.insert(
            surfaces_of(Scan(*(array[other] for array in world.scans))),
            world.Ts_world_lidar[other] @ se3.exp(MAP_POSE_SIGMA * rng.normal(size=6)),
        )
    seen = local_map.crop(world.Ts_world_lidar[frame] @ se3.inverse(T_predicted_source), CROP_M)
    nearest = np.argsort(np.einsum("ij,ij->i", seen.points, seen.points), kind="stable")[: cfg.num_map_points]
    return Surfaces(*(array[nearest] for array in seen))


def _padded(seen: Surfaces, num: int) -> Surfaces:
    """As many rows as every pair has."""
    arrays = [np.zeros((num, *array.shape[1:]), array.dtype) for array in seen]
    for padded, array in zip(arrays, seen, strict=True):
        padded[: len(array)] = array
    return Surfaces(*arrays)


def random_frames(num_frames: int, cfg: TrainConfig, rng: np.random.Generator) -> tuple[int, int]:
    """Frames of source and target, any two that are at most `max_gap` apart; the source is earlier unless pairs are augmented."""
    gaps = np.arange(1, min(cfg.max_gap, num_frames - 1) + 1)
    gap = int(rng.choice(gaps, p=(num_frames - gaps) / (num_frames - gaps).sum()))
    first = int(rng.integers(num_frames - gap))
    return (first + gap, first) if cfg.augment and rng.random() < 0.5 else (first, first + gap)


def random_pair(world: World, cfg: TrainConfig, rng: np.random.Generator, *, evidence: bool = False) -> PairBatch:
    """One pair (no batch axis) of two frames of a world.

    Args:
        world: scans and poses.
        cfg: largest gap, whether to augment, and the number of points of raw scans.
        rng: randomness.
        evidence: for the evidence head that has to see failures: the start is mostly the identity however far the
            truth is, and some pairs have lost most of their points.
    """
    frames = random_frames(len(world.Ts_world_lidar), cfg, rng)
    scans = [Scan(*(array[frame] for array in world.scans)) for frame in frames]
    if cfg.model.preprocess.sampling == "raw":
        scans = [_drawn(scan, cfg.model.preprocess.max_points, rng) for scan in scans]
    T = se3.inverse(world.Ts_world_lidar[frames[1]]) @ world.Ts_world_lidar[frames[0]]
    if not cfg.augment:
        return _with_surfaces(scans, T, np.eye(4), from_coarse=True, cfg=cfg, evidence=evidence)
    on_map = cfg.fine_weight > 0 and not evidence and rng.random() < cfg.map_share
    return _augmented(world, frames[0], scans, T, cfg, rng, on_map=on_map, evidence=evidence)


def _with_surfaces(scans: list[Scan], T_true, T_init, *, from_coarse: bool, cfg: TrainConfig, evidence: bool) -> PairBatch:
    """A pair whose fine stage, where it is trained, aligns the source with the target."""
    used = cfg.fine_weight > 0 and not evidence
    target = surfaces_of(scans[1])
    surfaces = _padded(target, cfg.num_map_points) if used else Surfaces(*(array[:0] for array in target))
    T_true, T_init = T_true.astype(np.float32), T_init.astype(np.float32)
    return PairBatch(scans[0], scans[1], T_true, T_init, np.array(from_coarse), surfaces, T_true, T_init)


def _augmented(world, frame, scans, T, cfg: TrainConfig, rng: np.random.Generator, *, on_map: bool, evidence: bool) -> PairBatch:
    """The pair seen from turned, mirrored sensors, some points dropped, with a start for the fine stage.

    Args:
        world: of the pair.
        frame: of the source.
        scans: source and target.
        T: T_target_source.
        cfg: of the training.
        rng: randomness.
        on_map: the fine stage gets a local map instead of the target, started where the source was expected.
        evidence: see `random_pair`.
    """
    mirror, drop = rng.random() < 0.5, rng.choice([0.0, 0.0, 0.3])
    if evidence and rng.random() < 0.2:
        drop = rng.uniform(0.5, 0.97)
    yaw = rng.uniform(-np.pi, np.pi)
    relative = rng.normal() * np.radians(8.0) if rng.random() < 0.5 else 0.0
    A_source, A_target = _rotation_z(yaw), _rotation_z(yaw + relative)
    M = np.diag([1.0, -1.0 if mirror else 1.0, 1.0, 1.0])
    T_true = A_target @ (M @ T @ M) @ se3.inverse(A_source)
    T_identity = A_target @ se3.inverse(A_source)
    T_init = T_identity if evidence and rng.random() < 0.7 else _start(T_true, T_identity, int(rng.integers(2)), rng)
    scans = [_augment(scan, A, mirror, drop, rng) for scan, A in zip(scans, (A_source, A_target), strict=True)]
    pair = _with_surfaces(scans, T_true, T_init, from_coarse=rng.random() < 1 / 3, cfg=cfg, evidence=evidence)
    if not on_map:
        return pair
    T_predicted_source = _wrong_prediction(rng)
    seen = _map_around(world, frame, T_predicted_source, cfg, rng)
    turned = A_source[:3, :3] @ M[:3, :3]
    seen = seen._replace(points=(seen.points @ turned.T).astype(np.float32), normals=(seen.normals @ turned.T).astype(np.float32))
    T_true = (A_source @ (M @ T_predicted_source @ M) @ se3.inverse(A_source)).astype(np.float32)
    surfaces, start = _padded(seen, cfg.num_map_points), np.eye(4, dtype=np.float32)
    return pair._replace(from_coarse=np.array(False), surfaces=surfaces, T_surfaces_source=T_true, T_surfaces_init=start)


def unrelated_pair(first: World, second: World, cfg: TrainConfig, rng: np.random.Generator) -> PairBatch:
    """Scans of two different worlds: no pose is right, so the truth is drawn at random, metres and tens of degrees away."""
    a, b = random_pair(first, cfg, rng, evidence=True), random_pair(second, cfg, rng, evidence=True)
    error = se3.exp(rng.normal(size=6) * np.repeat([np.radians(20.0), 5.0], 3))
    return a._replace(target=b.target, T_target_source=(a.T_init @ error).astype(np.float32))


def make_batch(worlds: list[World], cfg: TrainConfig, rng: np.random.Generator, *, evidence: bool = False) -> PairBatch:
    """Random pairs of random worlds, stacked; with `evidence` one pair in eight is of two different worlds.

    Longer worlds give more pairs: each is drawn as often as it has frames.
    """
    lengths = np.array([len(world.Ts_world_lidar) for world in worlds], float)
    pairs = []
    for _ in range(cfg.batch_size):
        first, second = (worlds[index] for index in rng.choice(len(worlds), size=2, p=lengths / lengths.sum()))
        wrong = evidence and first is not second and rng.random() < 0.125
        pairs.append(unrelated_pair(first, second, cfg, rng) if wrong else random_pair(first, cfg, rng, evidence=evidence))
    return jax.tree.map(lambda *arrays: np.stack(arrays), *pairs)
