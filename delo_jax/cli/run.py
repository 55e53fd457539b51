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
Method = Literal[
    "delo",
    "kiss-icp",
    "genz-icp",
    "vgicp",
    "gicp",
    "icp",
    "point-to-plane",
    "kiss-matcher",
    "delo-paper",
    "dcp",
    "constant-velocity",
    "mean-motion",
    "identity",
]
"""Those of `baselines.registry`, which is not imported before it is needed."""


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
    method: Method = "delo"
    """delo: this package. Whole odometries of other packages: kiss-icp, genz-icp; vgicp, on a map of voxels. Scan to scan: gicp, icp,
    point-to-plane, kiss-matcher; delo-paper and dcp with weights that you have trained. Without measuring: constant-velocity (the first
    motion, by GICP, for ever), mean-motion (10.5 m/s straight ahead), identity. Only delo and delo-paper know their uncertainty."""
    weights: str | None = None
    """Released weights by name, or a .safetensors file; delo-base by default."""
    map: Literal["local", "none"] | None = None
    """local, the default: scans are registered to a map of what was seen lately; none: to the last scan, by the network alone."""
    deskew: Literal["auto", "on", "off"] = "auto"
    """Undo the motion within a sweep. auto: where points carry times; on: also by azimuth, for scans as measured."""
    refine: bool = False
    """Also register frames two and four apart, smooth the poses in a second thread, and solve the whole pose graph at the end."""
    stamp_sigma_ms: float = 1.0
    """Standard deviation of the scans' stamps; on the map it is part of the covariance. 0 for stamps that are exact."""
    no_elevation_correction: bool = False
    """Leave out the 0.205 deg that KITTI's scans need; other scans are never changed."""

    def effective(self) -> "Run":
        """With the defaults of the method filled in."""
        return self if self.method != "delo" else dataclasses.replace(self, weights=self.weights or "delo-base", map=self.map or "local")

    def run(self) -> int:
        """Tracks all scans and prints a summary."""
        from delo_jax.baselines.registry import METHODS
        from delo_jax.cli.method import check_options
        from delo_jax.cli.tracking import Job, new_folder, track
        from delo_jax.data.dataset import open_dataset

        check_options(METHODS[self.method], given_weights=self.weights, given_map=self.map, refine=self.refine)
        options = self.effective()
        dataset = open_dataset(
            self.path, sequence=self.sequence, elevation_correction=not self.no_elevation_correction, azimuth_times=self.deskew == "on"
        )
        folder = new_folder(self.out, dataset.name)
        deskew = "off" if self.deskew == "off" else DESKEW_WORDS[dataset.point_times]
        print("\n".join([*dataset.describe(), f"de-skew: {deskew}"]))
        job = Job(
            command=dataclasses.replace(options, out=folder),
            source=dataset,
            folder=folder,
            method=self.method,
            weights=options.weights,
            use_map=options.map == "local",
            deskew=self.deskew != "off",
            refine=self.refine,
            stamp_sigma_s=1e-3 * self.stamp_sigma_ms,
            stage="read",
            facts=options._facts(dataset, deskew),
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
    from delo_jax.cli.page import write_page
    from delo_jax.cli.summary import refinement_rows, rejected_lines, run_rows

    trajectory, total = result.trajectory, len(job.source)
    lines = rejected_lines(result, job.source.paths)
    for line in lines:
        print(f"rejected: {line}")
    if len(trajectory):
        write_page(job.folder, result.cloud, truth=result.truth, refinement=result.refinement)
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
    print(f"poses in the {'lidar' if job.source.T_cam_lidar is None else 'camera'} frame, report.html, frames: {job.folder}")
    return 0
