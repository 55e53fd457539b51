"""Our odometry over a KITTI odometry folder, one sequence after the other; what is done is kept."""

import hashlib
import json
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.progress import Progress

import delo_jax
from delo_jax import weights
from delo_jax.data.sequence import Dataset
from delo_jax.errors import DatasetError, ScanError
from delo_jax.model.delo import Model

NUM_WARM_UP = 5  # scans whose time does not count: they compile
MODES = {"map": "Ours, on the map", "alone": "Ours, network alone"}
APART = {"baselines", "cli", "metrics", "refine", "report", "sim", "train"}  # parts of the package that no pose comes from


class Tracked(NamedTuple):
    """What became of a sequence."""

    Ts_world_lidar: np.ndarray  # (n, 4, 4)
    seconds: np.ndarray  # (n,) per scan, without reading it
    statuses: np.ndarray  # (n,) words

    @property
    def p50_ms(self) -> float:
        """Median time of a scan."""
        return 1e3 * float(np.median(self.seconds[min(NUM_WARM_UP, len(self.seconds) // 2) :]))

    def percent(self, status: str) -> float:
        """Share of the frames with a status."""
        return 100 * float(np.mean(self.statuses == status))


class Store:
    """Tracked sequences on disk, under a key of the weights and of the sources that a pose comes from.

    Args:
        folder: made where it is missing.
        weights_name: name or file.
    """

    def __init__(self, folder: Path, weights_name: str):
        package = Path(delo_jax.__file__).parent
        digest = hashlib.sha256(weights.find(weights_name).read_bytes())
        for path in sorted(path for path in package.rglob("*.py") if path.relative_to(package).parts[0] not in APART):
            digest.update(str(path.relative_to(package)).encode() + path.read_bytes())
        self._folder, self._name = folder / digest.hexdigest()[:16], weights_name
        self._params: Model | None = None

    def tracked(self, dataset: Dataset, mode: str, bar: Progress) -> Tracked:
        """The odometry's poses of a sequence; from the store where it has been there before."""
        scans = hashlib.sha256(json.dumps([str(path.resolve()) for path in dataset.paths]).encode()).hexdigest()[:8]
        path = self._folder / f"{dataset.name}_{scans}_{mode}.npz"
        if path.exists():
            with np.load(path) as file:
                return Tracked(*(file[name] for name in Tracked._fields))
        found = self._track(dataset, mode, bar)
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_suffix(".part.npz")
        np.savez(unfinished, **found._asdict())
        unfinished.replace(path)  # whole, or not there
        return found

    def _track(self, dataset: Dataset, mode: str, bar: Progress) -> Tracked:
        if self._params is None:
            self._params = delo_jax.load(self._name)
        odometry = delo_jax.LidarOdometry(self._params, use_map=mode == "map")
        seconds = []
        for k in bar.track(range(len(dataset)), description=f"{dataset.name}, {mode}"):
            stamp_ns = None if dataset.stamps_ns is None else int(dataset.stamps_ns[k])
            try:
                scan = dataset[k]
            except ScanError as error:
                odometry.reject(str(error), stamp_ns)
                seconds.append(0.0)
                continue
            begin = time.perf_counter()
            odometry.register(scan.points, stamp_ns, scan.times)
            seconds.append(time.perf_counter() - begin)
        trajectory = odometry.trajectory()
        return Tracked(np.array(trajectory.Ts_world_lidar), np.array(seconds), np.array(trajectory.statuses))


def sequences(root: Path, names: list[str]) -> list[Dataset]:
    """Those of the named sequences that are there, with truth and calibration; a line about each one that is not.

    Raises:
        DatasetError: none at all.
    """
    found = []
    for name in names:
        try:
            dataset = delo_jax.open_dataset(root, sequence=name)
        except DatasetError as error:
            print(f"{name} left out: {error}")
            continue
        if dataset.truth is None or dataset.T_cam_lidar is None:
            print(f"{name} left out: no truth or no calibration: {'; '.join(dataset.notes) or dataset.truth_source}")
            continue
        found.append(dataset)
    if not found:
        raise DatasetError(f"{root}: expected some of the sequences {', '.join(names)} with velodyne, calib.txt and poses, got none")
    return found
