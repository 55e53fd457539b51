"""Simulated worlds as training data: preprocessed scans with exact poses, made once and kept on disk."""

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from delo_jax.config import PreprocessConfig, TrainConfig
from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.geometry import se3
from delo_jax.preprocess import Scan, preprocess, preprocess_timed, still, sweep_of_scan
from delo_jax.sim import KINDS, SimulatedScan, simulate_clip

SIMULATOR = 3  # counts the changes of `delo_jax.sim`, `preprocess` and here that change a world; stored worlds of another are not used
VALIDATION_SEED = 1_000_000  # of the first held-out world
CALIBRATION_SEED = 1_200_000  # of the first world that covariances are fitted on
SEEDS_PER_RUN = 2_000_000  # so that runs of different seeds share no world
RAW_RESERVE = 4  # raw scans keep so many times the points of one input, of which training draws anew each time
AS_MEASURED_SHARE = 1 / 3  # of the worlds: their scans are not de-skewed, as those of a single pair
VELOCITY_SIGMA = np.repeat([np.radians(2.0), 0.2], 3)  # of the velocity that the others are de-skewed with, per second
SENSORS = ("hdl64e", "hdl64e", "hdl64e", "hdl64e", "hdl64e", "hdl64e", "hdl32e", "os1-128")


class World(NamedTuple):
    """Scans of one scene, stacked, and their poses."""

    scans: Scan  # arrays with a leading frame axis
    Ts_world_lidar: np.ndarray  # (f, 4, 4) float64


def scan_of(world: World, frame: int, cfg: PreprocessConfig) -> Scan:
    """One scan of a world as an input: of a raw one, stored with a reserve, as many points as an input takes, an even subset."""
    scan = Scan(*(array[frame] for array in world.scans))
    if cfg.sampling != "raw":
        return scan
    points, mask = scan.points[: cfg.max_points], scan.mask[: cfg.max_points]
    return scan._replace(points=points, mask=mask, keypoint_index=scan.keypoint_index[: cfg.max_points], keypoint_mask=mask)


def stored_config(cfg: PreprocessConfig) -> PreprocessConfig:
    """Preprocessing of the scans in a store; raw scans keep more points than one input takes."""
    if cfg.sampling != "raw":
        return cfg
    num = RAW_RESERVE * cfg.max_points
    return replace(cfg, max_points=num, num_keypoints=num)


def make_world(index: int, *, seed: int, num_frames: int, cfg: PreprocessConfig) -> World:
    """World number `index`: the scene kinds take turns, one clip in four is of another sensor than the HDL-64E.

    Args:
        index: number of the world; with `seed` it fixes everything.
        seed: base seed.
        num_frames: scans, 0.1 s apart.
        cfg: preprocessing of the scans.
    """
    kind = KINDS[index % len(KINDS)]
    sensor = SENSORS[(index // len(KINDS)) % len(SENSORS)]
    clip = simulate_clip(kind, seed + index, num_frames=num_frames, sensor=sensor)
    Ts_world_lidar = np.stack([scan.T_world_lidar for scan in clip])
    velocities = _velocities(Ts_world_lidar, np.random.default_rng([seed + index, 61]))
    with ThreadPoolExecutor(2) as pool:
        scans = list(pool.map(lambda scan, velocity: _world_scan(scan, velocity, stored_config(cfg)), clip, velocities))
    return World(Scan(*(np.stack(arrays) for arrays in zip(*scans, strict=True))), Ts_world_lidar)


def _velocities(Ts_world_lidar: np.ndarray, rng: np.random.Generator) -> list[np.ndarray | None]:
    """What an odometry would de-skew each scan with: its last motion, a little off; None in worlds that stay as measured."""
    if rng.random() < AS_MEASURED_SHARE:
        return [None] * len(Ts_world_lidar)
    motions = se3.log(se3.inverse(Ts_world_lidar[:-1]) @ Ts_world_lidar[1:]) / (1e-9 * FRAME_PERIOD_NS)
    return list(motions[[0, *range(len(motions))]] + VELOCITY_SIGMA * rng.normal(size=(len(Ts_world_lidar), 6)))


def _world_scan(scan: SimulatedScan, velocity: np.ndarray | None, cfg: PreprocessConfig) -> Scan:
    """A simulated scan preprocessed and, with a velocity, de-skewed."""
    if velocity is None or not np.any(scan.times_s):
        return preprocess(scan.points, cfg)
    prepared, times_s = preprocess_timed(scan.points, scan.times_s, cfg)
    return prepared if times_s is None else still(prepared, sweep_of_scan(prepared, times_s), velocity)


def worlds(cfg: TrainConfig, folder: Path, *, validation: bool, on_world: Callable[[], None] = lambda: None) -> Iterator[World]:
    """All worlds of a run, read from `folder` or simulated and written there; an interrupted run goes on where it was.

    Args:
        cfg: number of scenes, frames, seed and preprocessing.
        folder: store; worlds of another preprocessing do not get mixed up, since the file name holds its fingerprint.
        validation: the held-out worlds instead of the training worlds.
        on_world: called after each world, for progress.
    """
    name, count, seed = ("validation", cfg.num_validation_scenes, VALIDATION_SEED) if validation else ("train", cfg.num_scenes, 0)
    seed += cfg.seed * SEEDS_PER_RUN
    yield from stored_worlds(folder, name, count, seed, num_frames=cfg.num_frames, cfg=cfg.model.preprocess, on_world=on_world)


def stored_worlds(
    folder: Path, name: str, count: int, seed: int, *, num_frames: int, cfg: PreprocessConfig, on_world: Callable[[], None] = lambda: None
) -> Iterator[World]:
    """Worlds `seed`, `seed + 1`, ..., of `stored_world`, one after the other.

    Args:
        folder: store; may hold worlds of several names.
        name: of these.
        count: how many.
        seed: of the first.
        num_frames: scans of each.
        cfg: preprocessing of the scans.
        on_world: called after each world, for progress.
    """
    for index in range(count):
        yield stored_world(folder, name, index, seed, num_frames=num_frames, cfg=cfg)
        on_world()


def stored_world(folder: Path, name: str, index: int, seed: int, *, num_frames: int, cfg: PreprocessConfig) -> World:
    """World `seed + index`, read from `folder` or simulated and written there."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps([SIMULATOR, asdict(stored_config(cfg)), num_frames, seed])
    path = folder / f"{name}_{hashlib.sha256(text.encode()).hexdigest()[:8]}_{index:05d}.npz"
    if not path.exists():
        write_world(path, make_world(index, seed=seed, num_frames=num_frames, cfg=cfg))
    return read_world(path)


def write_world(path: Path, world: World) -> None:
    """Store a world; a file that is there is whole."""
    halves = {name: array.astype(np.float16) if name in ("normals", "features") else array for name, array in world.scans._asdict().items()}
    write_arrays(path, **halves, Ts_world_lidar=world.Ts_world_lidar)


def write_arrays(path: Path, **arrays: np.ndarray) -> None:
    """An npz file that is whole as soon as it is there."""
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        np.savez(file, **arrays)
    os.replace(part, path)


def read_world(path: Path) -> World:
    """A stored world."""
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    Ts = arrays.pop("Ts_world_lidar")
    for name in ("normals", "features"):
        arrays[name] = arrays[name].astype(np.float32)
    return World(Scan(**arrays), Ts)
