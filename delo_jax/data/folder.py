"""A plain folder of scan files from any sensor."""

import re
from collections import Counter
from pathlib import Path

import numpy as np

from delo_jax.data.kitti import increasing_or_none
from delo_jax.data.poses import parse_seconds, read_kitti_poses, read_times, relative_to_first
from delo_jax.data.scans import SUFFIXES, read_scan
from delo_jax.data.sequence import Dataset, median_spacing_s
from delo_jax.errors import DatasetError, ScanError

_MIN_STEP = 1_000_000  # ns between scans: frame numbers step by less
_MICROSECONDS_SINCE_1970 = 10**15
_LONGEST_SWEEP = 1.5  # spacings of the stamps


def open_folder(folder: Path, *, azimuth_times: bool) -> Dataset:
    """All scans of the folder's most frequent format, in natural order; nothing is corrected.

    Stamps: times.txt (seconds) where it has one line a scan, else the file names where they are decimal seconds, integer nanoseconds
    or integer microseconds since 1970. Truth: poses.txt (KITTI rows, in the sensor's frame) where it has one line a scan. Stored times
    are left out where they last longer than the stamps allow, and are relative to mid-sweep where they do not start over in each scan.

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
    poses = _one_per_scan(folder / "poses.txt", read_kitti_poses, count, notes)
    stamps_ns = increasing_or_none(by_name if stamps_ns is None else stamps_ns, notes)
    sweeps = _some_sweeps(paths)
    stored = len(sweeps) > 0 and _fit(sweeps, median_spacing_s(stamps_ns), notes)
    return Dataset(
        name=folder.resolve().name,
        layout=f"folder of {suffix} scans",
        paths=tuple(paths),
        stamps_ns=stamps_ns,
        truth=None if poses is None else relative_to_first(poses),
        truth_source="none" if poses is None else f"{folder / 'poses.txt'} (taken to be in the sensor's frame)",
        point_times="stored" if stored else "azimuth" if azimuth_times else "none",
        center_times=stored and _run_on(sweeps),
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


def _some_sweeps(paths):
    """(first, last) point time [s] of the first scans and the last one, of those that can be read and have times."""
    sweeps = []
    for path in dict.fromkeys([*paths[:3], paths[-1]]):
        try:
            times = read_scan(path).times
        except ScanError:
            continue
        if times is not None:
            sweeps.append((times.min(), times.max()))
    return np.array(sweeps)


def _fit(sweeps, spacing_s, notes):
    """Whether the sweeps are about as short as the spacing of the stamps; a note where they are not."""
    longest_s = np.ptp(sweeps, axis=1).max()
    if spacing_s is None or longest_s <= _LONGEST_SWEEP * spacing_s:
        return True
    notes.append(f"stored point times not used: a sweep lasts {longest_s:.3g} s by them, but scans are {spacing_s:.3g} s apart")
    return False


def _run_on(sweeps):
    """Whether times go on from scan to scan, as those of a recording do; in its first second they look like offsets."""
    middles = sweeps.mean(axis=1)
    return bool(np.ptp(middles) > np.ptp(sweeps, axis=1).max() / 4)
