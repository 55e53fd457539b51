"""Recorded sequences with poses as training data: preprocessed scans, made once and kept on disk."""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np

from delo_jax.config import PreprocessConfig
from delo_jax.data import Dataset, open_dataset
from delo_jax.errors import DatasetError
from delo_jax.preprocess import Scan, preprocess
from delo_jax.train.worlds import World, read_world, stored_config, write_world

RECORDED = 1  # counts the changes of this file or of `delo_jax.data` that change a scan; stored worlds of another are not used
CHUNK = 100  # scans of a world
MIN_FRAMES = 6  # of a world, and of a sequence's validation block
VALIDATION_SHARE = 10  # one scan in so many is held out: the last ones, at least MIN_FRAMES
GAP_FRAMES = 5  # left out between training and validation, so that no pair of neighbours is split over the two


class Chunk(NamedTuple):
    """Scans `start` to `stop` (exclusive) of a sequence with truth."""

    dataset: Dataset
    start: int
    stop: int


def recorded_worlds(
    root: Path,
    names: Sequence[str],
    cfg: PreprocessConfig,
    folder: Path,
    *,
    validation: bool,
    chunk: int = CHUNK,
    on_world: Callable[[], None] = lambda: None,
) -> Iterator[World]:
    """Worlds of contiguous scans, read from `folder` or preprocessed and written there; an interrupted run goes on where it was.

    The last tenth of each sequence is its validation block. Scans are taken as they are: those of a raw drive are not de-skewed.
    Poses are always those of `root`, in the frame of the sequence's first scan.

    Args:
        root: what `open_dataset` takes: a KITTI odometry tree, or a folder of raw drives.
        names: its sequences to use.
        cfg: preprocessing of the model; the stored scans are those of `stored_config`.
        folder: store; what was made from other scans or settings does not get mixed up, since the file name holds a fingerprint.
        validation: the held-out worlds instead of the training worlds.
        chunk: most scans of a world, at least MIN_FRAMES; the last of a sequence may have up to MIN_FRAMES - 1 more.
        on_world: called after each world, for progress.

    Raises:
        DatasetError: a sequence that is missing, without poses or too short; before the first scan is read.
        ScanError: a damaged scan.
    """
    chunks, cfg = _chunks(root, names, validation, chunk), stored_config(cfg)
    folder.mkdir(parents=True, exist_ok=True)
    for part in chunks:
        path = folder / f"recorded_{part.dataset.name}_{part.start:06d}_{_fingerprint(root, part, cfg)}.npz"
        if not path.exists():
            write_world(path, _make(part, cfg))
        yield read_world(path)._replace(Ts_world_lidar=_poses(part))
        on_world()


def count_recorded(root: Path, names: Sequence[str], *, validation: bool, chunk: int = CHUNK) -> int:
    """Number of worlds that `recorded_worlds` of the same arguments yields; no scan is read.

    Raises:
        DatasetError: as there.
    """
    return len(_chunks(root, names, validation, chunk))


def split(num_frames: int, *, validation: bool, chunk: int = CHUNK) -> list[tuple[int, int]]:
    """Ranges [start, stop) of the worlds of a sequence; none of fewer than MIN_FRAMES scans.

    Args:
        num_frames: scans of the sequence.
        validation: those of the held-out block instead of the training scans.
        chunk: most scans of a range, at least MIN_FRAMES; a shorter rest than MIN_FRAMES goes to the range before.
    """
    held_out = num_frames - max(num_frames // VALIDATION_SHARE, MIN_FRAMES)
    start, stop = (held_out, num_frames) if validation else (0, held_out - GAP_FRAMES)
    starts = list(range(start, stop, chunk))
    if len(starts) > 1 and stop - starts[-1] < MIN_FRAMES:
        starts.pop()
    return list(zip(starts, [*starts[1:], stop], strict=True))


def _chunks(root: Path, names: Sequence[str], validation: bool, chunk: int) -> list[Chunk]:
    """Every world's place; all sequences are opened and checked, which reads no scan."""
    datasets = [_open(root, name) for name in names]
    return [Chunk(dataset, *bounds) for dataset in datasets for bounds in split(len(dataset), validation=validation, chunk=chunk)]


def _open(root: Path, name: str) -> Dataset:
    dataset = open_dataset(root, sequence=name)
    least = 2 * MIN_FRAMES + GAP_FRAMES
    if dataset.truth is None:
        found = "; ".join(["none", *dataset.notes])
        raise DatasetError(f"{root}: expected poses of sequence {name!r}, got {found}; add poses/{name}.txt and calib.txt, or leave it out")
    if len(dataset) < least:
        raise DatasetError(f"{root}: expected at least {least} scans in sequence {name!r}, got {len(dataset)}; leave it out")
    return dataset


def _fingerprint(root: Path, part: Chunk, cfg: PreprocessConfig) -> str:
    dataset = part.dataset
    source = [str(root.resolve()), dataset.name, part.start, part.stop, len(dataset), dataset.elevation_correction_deg]
    return hashlib.sha256(json.dumps([RECORDED, asdict(cfg), *source]).encode()).hexdigest()[:8]


def _poses(part: Chunk) -> np.ndarray:
    assert part.dataset.truth is not None  # checked when opened
    return part.dataset.truth[part.start : part.stop]


def _make(part: Chunk, cfg: PreprocessConfig) -> World:
    """The scans read and preprocessed, two at a time."""
    with ThreadPoolExecutor(2) as pool:
        scans = list(pool.map(lambda index: preprocess(part.dataset[index].points, cfg), range(part.start, part.stop)))
    return World(Scan(*(np.stack(arrays) for arrays in zip(*scans, strict=True))), _poses(part))
