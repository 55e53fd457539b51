"""`delo eval`: how far a run is from the truth."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from delo_jax.cli.command import Command
from delo_jax.cli.stored import facts_of, poses_of, to_lidar
from delo_jax.errors import DatasetError

GAPS = (1, 2, 5)
NEAREST_NS = 10_000_000  # stamps of one frame in two files


@dataclasses.dataclass(frozen=True, kw_only=True)
class Eval(Command):
    """Drift, absolute and relative errors of a run against the truth.

    Example: delo eval runs/07 --truth poses/07.txt
    """

    folder: tyro.conf.Positional[Path]
    """Folder of a run."""
    truth: Path | None = None
    """KITTI poses (camera frame, where the run has a calibration) or a TUM file; by default the truth of the run's own dataset."""

    refined: bool = False
    """Of the poses that `delo refine` or `delo run --refine` has left, rather than those of the odometry."""

    def run(self) -> int:
        """Prints one table."""
        from delo_jax.cli.console import print_table

        facts = facts_of(self.folder)
        stamps_ns, Ts_estimated = poses_of(self.folder, facts, "refined_kitti.txt" if self.refined else "poses_kitti.txt")
        Ts_true, source = true_poses(self.folder, facts, stamps_ns, self.truth)
        if len(Ts_true) != len(Ts_estimated):
            raise DatasetError(
                f"{source}: expected one pose for each of {len(Ts_estimated)} frames, got {len(Ts_true)}; give the truth of this run"
            )
        if len(Ts_true) < 2:
            raise DatasetError(f"{self.folder}: expected a run of two or more frames, got {len(Ts_true)}; nothing moved")
        print(f"{self.folder}: {len(Ts_true)} frames, {facts.get('state', 'of unknown state')}; truth: {source}")
        print_table("errors", ("", "translation", "", "rotation", ""), _table(Ts_estimated, Ts_true), right=(1, 3))
        return 0


def true_poses(folder: Path, facts: dict[str, Any], stamps_ns: np.ndarray, given: Path | None = None) -> tuple[np.ndarray, str]:
    """True sensor poses of a run's frames, and where they are from: a file, or the truth of the run's own dataset.

    Raises:
        DatasetError: there is none.
    """
    from delo_jax.data.dataset import open_dataset

    own = folder / "truth.tum"
    if given is not None or own.exists():
        path = given or own
        return _read_truth(path, facts, stamps_ns), str(path)
    dataset = facts.get("dataset") or {}
    if not dataset.get("path"):
        raise DatasetError(f"{folder}: expected a truth, got none in the run; give one by --truth")
    found = open_dataset(dataset["path"], sequence=dataset.get("sequence"))
    if found.truth is None:
        raise DatasetError(f"{dataset['path']}: expected a truth beside the scans, got none; give one by --truth")
    return found.truth[: len(stamps_ns)], found.truth_source  # an interrupted run has fewer frames


def _read_truth(path: Path, facts: dict[str, Any], stamps_ns: np.ndarray) -> np.ndarray:
    """KITTI rows as they stand, TUM lines by their stamps."""
    from delo_jax.data.poses import read_kitti_poses, read_text, read_tum

    lines = [line.split() for line in read_text(path).splitlines()]
    first = next((words for words in lines if words and not words[0].startswith("#")), [])
    if len(first) != 8:
        poses = to_lidar(read_kitti_poses(path), facts)
        return poses if facts.get("state") == "complete" else poses[: len(stamps_ns)]  # an interrupted run has fewer frames
    true_ns, poses = read_tum(path)
    order = np.argsort(true_ns, kind="stable")
    true_ns, poses = true_ns[order], poses[order]
    after = np.searchsorted(true_ns, stamps_ns).clip(1, max(len(true_ns) - 1, 1)) % len(true_ns)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(true_ns[before] - stamps_ns) <= np.abs(true_ns[after] - stamps_ns), before, after)
    far = np.abs(true_ns[nearest] - stamps_ns) > NEAREST_NS
    if far.any():
        raise DatasetError(
            f"{path}: expected a pose within 10 ms of every frame, got none for {far.sum()} of {len(stamps_ns)}; give one on the same clock"
        )
    return poses[nearest]


def _table(Ts_estimated: np.ndarray, Ts_true: np.ndarray) -> list[tuple[str, str, str, str, str]]:
    from delo_jax.cli.summary import drift_where_it_fits, span_of
    from delo_jax.metrics.ate import absolute_errors, relative_errors

    rows = []
    drift = drift_where_it_fits(Ts_estimated, Ts_true)
    if drift is not None:
        table = zip(
            drift.lengths_m, drift.t_rel_percent_by_length, drift.r_rel_deg_per_100m_by_length, drift.num_segments_by_length, strict=True
        )
        kinds = [(f"drift over {length:g} m ({count} segments)", t, r) for length, t, r, count in table if count]
        kinds.append((f"drift over {span_of(drift)}, mean of {drift.num_segments}", drift.t_rel_percent, drift.r_rel_deg_per_100m))
        rows += [(name, f"{t:.3f}", "%", f"{r:.3f}", "deg/100 m") for name, t, r in kinds]
    else:
        rows.append(("drift (path below 10 m)", "-", "%", "-", "deg/100 m"))
    rows.append(("ATE (RMSE after alignment)", f"{absolute_errors(Ts_estimated, Ts_true).rmse_m:.3f}", "m", "", ""))
    for gap in (gap for gap in GAPS if gap < len(Ts_true)):
        errors = relative_errors(Ts_estimated, Ts_true, gap=gap)
        t, r = 100 * errors.translation_m, np.rad2deg(errors.rotation_rad)
        for word, value in (("median", np.median), ("p95", lambda x: np.percentile(x, 95))):
            rows.append((f"gap {gap}, {word}", f"{value(t):.2f}", "cm", f"{value(r):.3f}", "deg"))
    return rows
