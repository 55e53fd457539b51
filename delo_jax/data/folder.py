"""A plain folder of scan files from any sensor."""

import re
from collections import Counter
from pathlib import Path

import numpy as np

from delo_jax.data.kitti import increasing_or_none
from delo_jax.data.poses import parse_seconds, read_kitti_poses, read_times, relative_to_first
from delo_jax.data.scans import SUFFIXES, read_scan
from delo_jax.data.sequence import Dataset
from delo_jax.errors import DatasetError, ScanError

_MIN_STEP = 1_000_000  # ns between scans: frame numbers step by less
_MICROSECONDS_SINCE_1970 = 10**15


def open_folder(folder: Path, *, azimuth_times: bool) -> Dataset:
    """All scans of the folder's most frequent format, in natural order; nothing is corrected.

    Stamps: times.txt (seconds) where it has one line a scan, else the file names where they are decimal seconds, integer nanoseconds
    or integer microseconds since 1970. Truth: poses.txt (KITTI rows, in the sensor's frame) where it has one line a scan.

    Raises:
        DatasetError: no scans.
    """
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith("."))
    if not files:
        raise DatasetError(f"{folder}: expected scans ({', '.join(SUFFIXES)}) or a KITTI tree, got neither; give the folder of the scans")
    (suffix, count), *others = Counter(path.suffix.lower() for path in files).most_common()
    notes = [f"{number} {other} files left out, since most are {suffix}" for other, number in others]
    paths = sorted((path for path in files if path.suffix.lower() == suffix), key=_natural_key)
    by_name = _stamps_of_names(paths)
    if by_name is not None:
        order = np.argsort(by_name, kind="stable")
        paths, by_name = [paths[i] for i in order], by_name[order]
    stamps_ns = _one_per_scan(folder / "times.txt", read_times, count, notes)
    stamps_ns = by_name if stamps_ns is None else stamps_ns
    poses = _one_per_scan(folder / "poses.txt", read_kitti_poses, count, notes)
    stored = suffix != ".bin" and _has_times(paths)
    return Dataset(
        name=folder.resolve().name,
        layout=f"folder of {suffix} scans",
        paths=tuple(paths),
        stamps_ns=None if stamps_ns is None else increasing_or_none(stamps_ns, notes),
        truth=None if poses is None else relative_to_first(poses),
        truth_source="none" if poses is None else f"{folder / 'poses.txt'} (taken to be in the sensor's frame)",
        point_times="stored" if stored else "azimuth" if azimuth_times else "none",
        compensated=False if azimuth_times else None,
        notes=tuple(notes),
    )


def _natural_key(path):
    """Scan 10 after scan 9."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"([0-9]+)", path.name)]


def _stamps_of_names(paths):
    stems = [path.stem for path in paths]
    if all(re.fullmatch(r"[0-9]{1,10}\.[0-9]+", stem) for stem in stems):
        return np.array([parse_seconds(stem, str(path)) for stem, path in zip(stems, paths, strict=True)], np.int64)
    if len(stems) < 2 or not all(re.fullmatch(r"[0-9]{1,18}|[1-8][0-9]{18}", stem) for stem in stems):
        return None
    numbers = np.array([int(stem) for stem in stems], np.int64)
    if np.median(np.diff(numbers)) >= _MIN_STEP:
        return numbers
    return numbers * 1000 if _MICROSECONDS_SINCE_1970 <= numbers[0] < 9 * _MICROSECONDS_SINCE_1970 else None


def _one_per_scan(path, read, count, notes):
    """Rows of a file that may belong to the scans; a note where it does not."""
    if not path.exists():
        return None
    try:
        rows = read(path)
    except DatasetError as error:
        notes.append(f"{path.name} not used: {error}")
        return None
    if len(rows) == count:
        return rows
    notes.append(f"{path.name} not used: it has {len(rows)} rows for {count} scans")
    return None


def _has_times(paths):
    """Whether the first readable scan has times."""
    for path in paths[:5]:
        try:
            return read_scan(path).times is not None
        except ScanError:
            continue
    return False
