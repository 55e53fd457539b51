"""Pairs of scans as key points with exact truth: unseen simulated worlds, dense traffic, half overlap, recorded sequences."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import _harness
import numpy as np
from rich.progress import Progress

import delo_jax
from delo_jax import inference
from delo_jax.config import PreprocessConfig
from delo_jax.data import camera_to_lidar, read_kitti_poses
from delo_jax.geometry import se3
from delo_jax.model import delo
from delo_jax.preprocess import Scan, preprocess
from delo_jax.sim import KINDS, simulate_clip
from delo_jax.train.worlds import SIMULATOR

TEST_SEED = 500_000  # training and validation worlds of any run begin at whole millions
TRAFFIC_SEED = 1_500_000
DENSE_TRAFFIC = 10.0
NUM_FRAMES = 6


class Sequence(NamedTuple):
    """Scans in order, key points alone, with sensor poses."""

    scans: Scan  # arrays with a leading frame axis
    Ts_world_lidar: np.ndarray  # (f, 4, 4)


class Pairs(NamedTuple):
    """n pairs of frames."""

    frames: Scan  # arrays with a leading frame axis
    source: np.ndarray  # (n,) frame numbers
    target: np.ndarray
    T_target_source: np.ndarray  # (n, 4, 4)
    group: np.ndarray  # (n,) pairs of one number are the same two frames, both ways round


def key_points(scan: Scan) -> Scan:
    """The scan with its key points as its only points."""
    rows, mask = scan.keypoint_index, scan.keypoint_mask
    points, normals, features = (np.where(mask[:, None], array[rows], 0).astype(np.float32) for array in scan[:3])
    return Scan(points, normals, features, mask, np.arange(len(rows), dtype=np.int32), mask)


def stack(scans: list[Scan]) -> Scan:
    """Arrays with a leading axis."""
    return Scan(*(np.stack(arrays) for arrays in zip(*scans, strict=True)))


def simulated(num_worlds: int, *, traffic: float, cfg: PreprocessConfig, folder: Path, bar: Progress) -> list[Sequence]:
    """Worlds that no training has seen, kept in `folder`; the scene kinds take turns, all scans are an HDL-64E's."""
    seed = TEST_SEED if traffic == 1.0 else TRAFFIC_SEED
    text = json.dumps([SIMULATOR, seed, NUM_FRAMES, traffic, asdict(cfg)])
    name = hashlib.sha256(text.encode()).hexdigest()[:8]
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for index in bar.track(range(num_worlds), description=f"test worlds, traffic x{traffic:g}"):
        path = folder / f"test_{name}_{index:05d}.npz"
        if not path.exists():
            clip = simulate_clip(KINDS[index % len(KINDS)], seed + index, num_frames=NUM_FRAMES, traffic=traffic)
            scans = stack([key_points(preprocess(scan.points, cfg)) for scan in clip])
            part = path.with_suffix(".part.npz")
            np.savez(part, **scans._asdict(), Ts_world_lidar=np.stack([scan.T_world_lidar for scan in clip]))
            part.replace(path)
        with np.load(path) as stored:
            found.append(Sequence(Scan(*(stored[field] for field in Scan._fields)), stored["Ts_world_lidar"]))
    return found


def recorded(data: Path, names: tuple[str, ...], cfg: PreprocessConfig, bar: Progress) -> list[Sequence]:
    """Sequences of a tree of real scans, elevation-corrected, not de-skewed, against `poses_boresight`."""
    found = []
    for name in names:
        dataset = delo_jax.open_dataset(data / "sequences" / name)
        T_cam_lidar = _harness.needed(dataset.T_cam_lidar, "Tr in calib.txt")
        poses = camera_to_lidar(read_kitti_poses(data / "poses_boresight" / f"{name}.txt"), T_cam_lidar)
        scans = [key_points(preprocess(dataset[k].points, cfg)) for k in bar.track(range(len(dataset)), description=name)]
        found.append(Sequence(stack(scans), poses))
    return found


def pairs(sequences: list[Sequence], gap: int, per_sequence: int | None = None) -> Pairs:
    """Pairs (k, k + gap) of every sequence, each in both directions; at most `per_sequence` of them, evenly spread."""
    sources, targets, poses, groups, offset = [], [], [], [], 0
    for sequence in sequences:
        starts = np.arange(len(sequence.Ts_world_lidar) - gap)
        if per_sequence is not None and 2 * len(starts) > per_sequence:
            starts = starts[np.linspace(0, len(starts) - 1, per_sequence // 2).round().astype(int)]
        first, last = np.r_[starts, starts + gap], np.r_[starts + gap, starts]
        poses.append(se3.inverse(sequence.Ts_world_lidar[last]) @ sequence.Ts_world_lidar[first])
        sources.append(offset + first)
        targets.append(offset + last)
        groups.append(offset + np.r_[starts, starts])
        offset += len(sequence.Ts_world_lidar)
    frames = Scan(*(np.concatenate(arrays) for arrays in zip(*(sequence.scans for sequence in sequences), strict=True)))
    return Pairs(frames, np.concatenate(sources), np.concatenate(targets), np.concatenate(poses), np.concatenate(groups))


def half_overlap(full: Pairs, seed: int) -> Pairs:
    """The pairs as two sensors with half a turn of view see them, a quarter turn apart: half of what one sees, the other does too."""
    rng = np.random.default_rng(seed)
    num, frames = len(full.T_target_source), []
    for source, target in zip(full.source, full.target, strict=True):
        heading, turn = rng.uniform(-np.pi, np.pi), np.pi / 2 * rng.choice([-1, 1])
        for frame, towards in ((source, heading), (target, heading + turn)):
            frames.append(_sector(Scan(*(array[frame] for array in full.frames)), towards))
    return Pairs(stack(frames), 2 * np.arange(num), 2 * np.arange(num) + 1, full.T_target_source, full.group)


def _sector(scan: Scan, heading: float) -> Scan:
    """The half of a scan around a heading; its rows move to the front."""
    inside = scan.mask & (np.cos(np.arctan2(scan.points[:, 1], scan.points[:, 0]) - heading) > 0)
    order = np.argsort(~inside, kind="stable")
    mask = inside[order]
    points, normals, features = (np.where(mask[:, None], array[order], 0).astype(np.float32) for array in scan[:3])
    return Scan(points, normals, features, mask, scan.keypoint_index, mask)


def encoded_pairs(models: dict[str, delo.Model], seed: int, num_worlds: int, gaps: tuple[int, ...], bar: Progress) -> Iterator[tuple]:
    """(gap, T_target_source, encodings of source and target by model) of all pairs, source first, of six-frame clips."""
    for index in bar.track(range(num_worlds), description="unseen clips"):
        clip = simulate_clip(KINDS[index % len(KINDS)], seed + index)
        encodings = {name: [inference.encode(m, preprocess(scan.points, m.cfg.preprocess)) for scan in clip] for name, m in models.items()}
        for gap in gaps:
            for k in range(len(clip) - gap):
                T = se3.inverse(clip[k + gap].T_world_lidar) @ clip[k].T_world_lidar
                yield gap, T, {name: (scans[k], scans[k + gap]) for name, scans in encodings.items()}


def in_pieces(count: int, size: int) -> Iterator[np.ndarray]:
    """Row numbers 0 to count in pieces of one size; the last is filled up with its first row."""
    for start in range(0, count, size):
        rows = np.arange(start, start + size)
        yield np.where(rows < count, rows, start)
