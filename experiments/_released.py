"""Released trajectories beside the official poses: the data tree's, and how they are compared."""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from _routes import calibration, official, whole

from delo_jax.data import camera_to_lidar, lidar_to_camera
from delo_jax.errors import DatasetError
from delo_jax.geometry import se3
from delo_jax.metrics.drift import Segments, mean_drift, segments_that_fit
from delo_jax.metrics.frames import compare_frames

EQUAL = 2e-4  # of motions, in matrix entries [1, m]: files of seven digits, chained


class Number(NamedTuple):
    """Drift of a sequence."""

    r_rel: float  # deg/100 m
    t_rel: float  # percent
    segments: Segments | None = None  # None where only the number is known

    @property
    def num_segments(self) -> int:
        """0 where only the number is known."""
        return 0 if self.segments is None else len(self.segments.which)


Numbers = dict[str, Number]  # by sequence


class Tree:
    """Official poses and released trajectories of the data tree."""

    def __init__(self, folder: Path):
        self._data, self._folder = folder, folder / "released_trajectories"
        golden = self._folder / "golden_metrics.json"
        if not golden.exists():
            raise DatasetError(f"{folder}: expected released trajectories, got no {golden}; check --data")
        self.golden = json.loads(golden.read_text())["methods"]

    def truth(self, sequence: str, frame: str) -> np.ndarray:
        """Official poses in the frame of the LiDAR or of the camera."""
        return official(self._data, sequence, frame)

    def released(self, method: str, sequence: str, frame: str) -> np.ndarray:
        """Poses that were released, brought to a frame."""
        with np.load(self._folder / f"{method}.npz") as file:
            Ts = whole(file[sequence])
        own = "camera" if method == "simple_online" else "lidar"
        to_frame = lidar_to_camera if frame == "camera" else camera_to_lidar
        return Ts if frame == own else to_frame(Ts, calibration(self._data, sequence))


def number(Ts_estimated: np.ndarray, Ts_true: np.ndarray) -> Number:
    """Drift over the segments that fit."""
    num = min(len(Ts_estimated), len(Ts_true))
    Ts_estimated, Ts_true = Ts_estimated[:num], Ts_true[:num]
    match = compare_frames(Ts_estimated, Ts_true)
    if not match.agree:
        raise DatasetError(f"expected estimate and truth in one frame, got axes {match.estimated_axis} and {match.true_axis}")
    segments = segments_that_fit(Ts_estimated, Ts_true)
    if segments is None:
        raise DatasetError("expected a path of more than 10 m, got a shorter one; nothing drifts on it")
    drift = mean_drift(segments)
    return Number(drift.r_rel_deg_per_100m, drift.t_rel_percent, segments)


def of_released(tree: Tree, method: str, sequences: tuple[str, ...], *, frame: str = "lidar", shift: int = 0) -> Numbers:
    """Released trajectories of a method, row i with the official pose of frame i + shift."""
    return {name: number(tree.released(method, name, frame), tree.truth(name, frame)[shift:]) for name in sequences}


def of_golden(tree: Tree, method: str, sequences: tuple[str, ...]) -> Numbers:
    """Numbers of trajectories that are not in the tree, in the LiDAR frame."""
    found = {name: tree.golden[method][name]["velodyne"] for name in sequences}
    return {name: Number(cell["r_rel"], cell["t_rel"]) for name, cell in found.items()}


def shared_percent(tree: Tree, sequence: str) -> float:
    """Motions of DELO+PUEPE that are DELO's, of the same row or one away, whichever pairing shares most."""
    ours, theirs = (tree.released(method, sequence, "lidar") for method in ("delo_puepe", "delo"))
    motions, others = (se3.inverse(Ts[:-1]) @ Ts[1:] for Ts in (ours, theirs))
    shares = []
    for shift in (-1, 0, 1):
        first, second = motions[max(shift, 0) :], others[max(-shift, 0) :]
        num = min(len(first), len(second))
        shares.append(100 * float(np.mean(np.abs(first[:num] - second[:num]).max(axis=(1, 2)) < EQUAL)))
    return max(shares)
