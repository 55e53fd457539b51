"""`delo run`: the trajectory of a dataset."""

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from delo_jax.cli.command import Command

if TYPE_CHECKING:
    from delo_jax.cli.tracking import Job, Result
    from delo_jax.data.dataset import Dataset

DESKEW_WORDS = {
    "stored": "done, with the times stored in the scans",
    "azimuth": "done, with times by azimuth",
    "none": "none: the points carry no times",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run(Command):
    """Poses, covariances and status of every scan of a dataset.

    Example: delo run kitti --sequence 07 --out runs/07
    """

    path: tyro.conf.Positional[Path]
    """KITTI odometry tree or sequence, KITTI raw drive, or a folder of .bin, .pcd, .ply, .npy or .npz scans."""
    sequence: str | None = None
    """Which sequence or drive, where the path holds several."""
    out: Path | None = None
    """Folder for the results; runs/NAME, numbered, by default."""
    weights: str = "delo-base"
    """Released weights by name, or a .safetensors file."""
    map: Literal["local", "none"] = "local"
    """local: scans are registered to a map of what was seen lately; none: to the last scan, by the network alone."""
    deskew: Literal["auto", "on", "off"] = "auto"
    """Undo the motion within a sweep. auto: where points carry times; on: also by azimuth, for scans as measured."""
    refine: bool = False
    """Also register frames two and four apart, smooth the poses in a second thread, and solve the whole pose graph at the end."""
    stamp_sigma_ms: float = 1.0
    """Standard deviation of the scans' stamps; on the map it is part of the covariance. 0 for stamps that are exact."""
    no_elevation_correction: bool = False
    """Leave out the 0.205 deg that KITTI's scans need; other scans are never changed."""

    def run(self) -> int:
        """Tracks all scans and prints a summary."""
        from delo_jax.cli.tracking import Job, new_folder, track
        from delo_jax.data.dataset import open_dataset

        dataset = open_dataset(
            self.path, sequence=self.sequence, elevation_correction=not self.no_elevation_correction, azimuth_times=self.deskew == "on"
        )
        folder = new_folder(self.out, dataset.name)
        deskew = "off" if self.deskew == "off" else DESKEW_WORDS[dataset.point_times]
        print("\n".join([*dataset.describe(), f"de-skew: {deskew}"]))
        job = Job(
            command=dataclasses.replace(self, out=folder),
            source=dataset,
            folder=folder,
            weights=self.weights,
            use_map=self.map == "local",
            deskew=self.deskew != "off",
            refine=self.refine,
            stamp_sigma_s=1e-3 * self.stamp_sigma_ms,
            stage="read",
            facts=self._facts(dataset, deskew),
        )
        return conclude(job, track(job))

    def _facts(self, dataset: "Dataset", deskew: str) -> dict[str, Any]:
        return {
            "dataset": {"path": str(self.path.resolve()), "sequence": self.sequence, "name": dataset.name, "layout": dataset.layout},
            "sensor": {
                "elevation_correction_deg": dataset.elevation_correction_deg,
                "motion_compensated": dataset.compensated,
                "point_times": dataset.point_times,
                "deskew": deskew,
            },
            "map": self.map,
            "truth": dataset.truth_source,
        }


def conclude(job: "Job", result: "Result") -> int:
    """Prints the end of a run and returns its exit code."""
    from delo_jax.cli.console import print_summary
    from delo_jax.cli.summary import refinement_rows, rejected_lines, run_rows

    trajectory, total = result.trajectory, len(job.source)
    lines = rejected_lines(result, job.source.paths)
    for line in lines:
        print(f"rejected: {line}")
    if len(trajectory):
        print_summary(run_rows(result))
    if result.refinement is not None:
        print_summary(refinement_rows(result.refinement, trajectory.Ts_world_lidar, result.truth), "pose graph")
    if result.interrupted:
        kept = f"{len(trajectory)} of {total} frames are kept in {job.folder}" if len(trajectory) else "no frame was finished"
        print(f"delo: interrupted; {kept}", file=sys.stderr)
        return 1
    if all(status == "rejected" for status in trajectory.statuses):
        remedy = "check that the scans hold x, y, z in metres, seen from the sensor"
        print(f"delo: {job.source.name}: no usable scan among {total}, the first: {lines[0]}; {remedy}", file=sys.stderr)
        return 1
    print(f"poses in the {'lidar' if job.source.T_cam_lidar is None else 'camera'} frame, picture, frames: {job.folder}")
    return 0
