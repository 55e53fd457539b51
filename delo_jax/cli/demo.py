"""`delo demo`: a simulated drive through everything, with the truth beside it."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from delo_jax.cli.command import Command
from delo_jax.cli.run import conclude
from delo_jax.config import require
from delo_jax.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np

    from delo_jax.cli.simulated import SimulatedDrive

KIND, SEED = "urban", 500_063  # 84 m, a bend of 14 deg; a drive that training never saw
POINTS_PER_PICTURE = 150_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class Demo(Command):
    """A simulated drive through network, odometry, covariance, status, pose graph and pictures; needs no data and no network connection.

    Example: delo demo --out delo_demo
    """

    out: Path = Path("delo_demo")
    """Folder for the results; those of an earlier demo are replaced."""
    num_scans: int = 60
    """Length of the drive; ten scans are a second."""
    weights: str = "delo-base"
    """Released weights by name, or a .safetensors file."""

    def run(self) -> int:
        """Simulates, tracks, draws and compares with the truth."""
        require(self.num_scans >= 2, "num_scans", "at least 2", self.num_scans)
        from delo_jax.cli.simulated import SimulatedDrive
        from delo_jax.cli.tracking import Job, track
        from delo_jax.data.poses import write_tum

        report = self.out / "run.json"
        if report.exists() and SimulatedDrive.name not in report.read_text():
            raise ConfigError(f"--out {self.out}: expected a new folder or that of a demo, got one that holds another run; choose another")
        source = SimulatedDrive(KIND, SEED, self.num_scans)
        print(f"simulated drive: {KIND} street, {self.num_scans} scans of an HDL-64E, rolling shutter; truth: exact")
        job = Job(
            command=self,
            source=source,
            folder=self.out,
            weights=self.weights,
            use_map=True,
            deskew=True,
            refine=True,
            stamp_sigma_s=0.0,
            stage="simulate",
            facts={
                "dataset": {"path": None, "sequence": None, "name": source.name, "layout": f"simulated, kind {KIND}, seed {SEED}"},
                "sensor": {"elevation_correction_deg": 0.0, "motion_compensated": False, "point_times": "stored", "deskew": "done"},
                "map": "local",
                "truth": "truth.tum, exact",
            },
        )
        result = track(job)
        if len(result.trajectory):
            write_tum(self.out / "truth.tum", result.trajectory.stamps_ns, source.truth)
            self._draw_scene(source, result.trajectory.Ts_world_lidar)
        return conclude(job, result)

    def _draw_scene(self, source: "SimulatedDrive", Ts_world_lidar: "np.ndarray") -> None:
        """The map that the estimated poses make of some scans."""
        from delo_jax.data.fields import FRAME_PERIOD_NS
        from delo_jax.geometry import se3
        from delo_jax.geometry.deskew import deskew
        from delo_jax.report.figures import scene_figure

        clouds = {}
        for index, scan in source.kept.items():
            if not 0 < index < len(Ts_world_lidar) or scan.times is None:
                continue
            velocity = se3.log(se3.inverse(Ts_world_lidar[index - 1]) @ Ts_world_lidar[index]) / (1e-9 * FRAME_PERIOD_NS)
            clouds[index] = deskew(scan.points, scan.times, velocity)
        if clouds:
            title = f"{len(clouds)} scans at the poses estimated"
            scene_figure(
                self.out / "scene.png",
                list(clouds.values()),
                Ts_world_lidar,
                scan_indices=list(clouds),
                max_points=POINTS_PER_PICTURE,
                title=title,
            )
