"""`LidarOdometry` as a stream: real time on two cores, flat memory over 2,000 scans, the same bytes twice.

Every real sequence is read, registered and judged scan by scan (reading and preprocessing included, compile time apart);
then 2,000 simulated scans (HDL-64E with 450 columns) run through one instance while its memory is watched.

Run:     python experiments/streaming.py --data TREE        (about 10 minutes on 2 cores)
Expect:  odo_04_000 at 10 scans/s or more; less than 20 MB growth after the first 200 scans.
"""

import dataclasses
import os
import sys
import time
from pathlib import Path

import _harness
import numpy as np
from _harness import Row

import delo_jax
from delo_jax.metrics.ate import relative_errors
from delo_jax.sim import SENSORS, simulate_drive

SEQUENCES = ("odo_04_000", "raw_0926_0013", "odo_00_056")
REAL_TIME = "odo_04_000"  # the bound is on this one
NUM_SCANS, SETTLED = 2000, 200


def resident_mb() -> float:
    """Resident memory of this process [MB]; Linux."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def drive(params, dataset) -> tuple[delo_jax.LidarOdometry, np.ndarray]:
    """The odometry after a whole sequence, and seconds per scan, reading included."""
    odometry, seconds = delo_jax.LidarOdometry(params), []
    stamps = _harness.needed(dataset.stamps_ns, "times.txt")
    for index in range(len(dataset)):
        begin = time.perf_counter()
        scan = dataset[index]
        odometry.register(scan.points, int(stamps[index]), scan.times)
        seconds.append(time.perf_counter() - begin)
    return odometry, np.array(seconds)


def real(data: Path, name: str, params) -> list[Row]:
    """Speed, errors and determinism on one real sequence."""
    dataset = delo_jax.open_dataset(data / "sequences" / name)
    (first, _), (second, seconds) = drive(params, dataset), drive(params, dataset)
    trajectory = second.trajectory()
    errors = relative_errors(trajectory.Ts_world_lidar, _harness.needed(dataset.truth, f"truth of {name}"))
    same = first.trajectory().Ts_world_lidar.tobytes() == trajectory.Ts_world_lidar.tobytes()
    good = sum(status == "ok" for status in trajectory.statuses)
    return [
        Row(f"{name} scans per second", 1.0 / seconds.mean(), "1/s", 10.0 if name == REAL_TIME else None, True),
        Row(f"{name} time per scan p50", 1e3 * float(np.median(seconds)), "ms"),
        Row(f"{name} time per scan p95", 1e3 * float(np.percentile(seconds, 95)), "ms"),
        Row(f"{name} two runs give the same bytes", float(same), "", 1.0, True),
        Row(f"{name} frames ok", 100 * good / len(dataset), "%"),
        Row(f"{name} step error median (truth as delivered)", 100 * float(np.median(errors.translation_m)), "cm"),
        Row(f"{name} step error median (truth as delivered)", float(np.degrees(np.median(errors.rotation_rad))), "deg"),
    ]


def memory(params, num_scans: int, bar) -> list[Row]:
    """Growth of resident memory over a long simulated drive, simulator included."""
    sensor = dataclasses.replace(SENSORS["hdl64e"], num_columns=450)
    odometry, samples = delo_jax.LidarOdometry(params), []
    task = bar.add_task("simulated scans", total=num_scans)
    for scan in simulate_drive("mixed", 7, num_scans, sensor):
        odometry.register(scan.points)
        samples.append(resident_mb())
        bar.advance(task)
    settled = min(SETTLED, num_scans // 2)
    growth = float(np.max(samples[-50:]) - np.max(samples[settled - 50 : settled]))
    poses_mb = 2e-3 * (num_scans - settled)  # what a trajectory keeps: about 2 kB a frame
    return [Row(f"memory growth after the first {settled} of {num_scans} scans, beyond the poses", growth - poses_mb, "MB", 20.0)]


def main(argv: list[str] | None = None) -> int:
    """Measure, print, judge."""
    args = _harness.parser(__doc__, needs_data=True).parse_args(argv)
    params = delo_jax.load("delo-base")
    begin = time.perf_counter()
    delo_jax.odometry(params, np.zeros((0, 3)), np.zeros((0, 3)))
    rows = [Row("compile time", time.perf_counter() - begin, "s")]
    for name in SEQUENCES:
        rows += real(args.data, name, params)
    with _harness.progress() as bar:
        rows += memory(params, 60 if args.quick else NUM_SCANS, bar)
    return _harness.finish(rows, {"sequences": SEQUENCES, "num_scans": NUM_SCANS}, args)


if __name__ == "__main__":
    sys.exit(main())
