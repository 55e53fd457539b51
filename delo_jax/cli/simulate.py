"""`delo simulate`: a KITTI tree of a simulated drive that training has not seen."""

import dataclasses
import sys
from pathlib import Path
from typing import Literal

import tyro

from delo_jax.cli.command import Command
from delo_jax.config import require

Kind = Literal["urban", "residential", "mixed", "road", "open"]
SensorName = Literal["hdl64e", "hdl32e", "os1-128", "vlp16"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Simulate(Command):
    """Scans of a long simulated drive with exact poses, as a KITTI odometry tree; training never uses these worlds.

    Example: delo simulate drives --drive urban --num-scans 200 --rolling-shutter
    """

    out: tyro.conf.Positional[Path]
    """Root of the tree; sequences that are in it already are left alone."""
    drive: Kind = "mixed"
    """What stands beside the road: a city, houses with gardens, a mixture, a country road, or open land with vegetation."""
    seed: int = 0
    """Of the world, the motion, the sensor and the noise; from 0 to 499999."""
    num_scans: int = 130
    """Length of the drive; ten scans are a second."""
    sensor: SensorName = "hdl64e"
    """Model of the spinning LiDAR."""
    rolling_shutter: bool = False
    """Points as measured by the moving sensor rather than motion-compensated."""

    def run(self) -> int:
        """Writes the tree and prints how to go on."""
        require(self.num_scans >= 1, "num_scans", "at least 1", self.num_scans)
        from delo_jax.cli.console import Row, interruptible, print_summary, progress
        from delo_jax.data.writers import KittiTreeWriter
        from delo_jax.sim.drive import DRIVE_SEED, LAST_DRIVE_SEED, simulate_drive

        last, name = LAST_DRIVE_SEED - DRIVE_SEED, f"{self.drive}-{self.seed}"
        require(0 <= self.seed <= last, "seed", f"0 to {last}, whose worlds training never uses", self.seed)
        drive = simulate_drive(self.drive, DRIVE_SEED + self.seed, self.num_scans, self.sensor, rolling_shutter=self.rolling_shutter)
        count, num_points, path = 0, 0, 0.0
        position = None
        writer = KittiTreeWriter(self.out, name, motion_compensated=not self.rolling_shutter)
        with writer, progress() as bar, interruptible() as interrupted:
            task = bar.add_task("simulating", total=self.num_scans, note="")
            for scan in drive:
                if interrupted():
                    break
                writer.append(scan.points, scan.T_world_lidar)
                count, num_points = count + 1, num_points + len(scan.points)
                before, position = position, scan.T_world_lidar[:3, 3]
                path += 0.0 if before is None else float(((position - before) ** 2).sum() ** 0.5)
                bar.advance(task)
        rows = [
            Row("scans", str(count)),
            Row("points per scan (mean)", f"{num_points / max(count, 1):.0f}"),
            Row("path", f"{path:.1f}", "m"),
            Row("truth", f"exact, in poses/{name}.txt"),
            Row("motion within a sweep", "in the points" if self.rolling_shutter else "compensated"),
            Row("elevation correction", "none needed; calib.txt says so"),
        ]
        print_summary(rows)
        if count < self.num_scans:
            print(f"delo: interrupted; {count} of {self.num_scans} scans are kept in {self.out / 'sequences' / name}", file=sys.stderr)
            return 1
        print(f"odometry on it:  delo run {self.out} --sequence {name}")
        return 0
