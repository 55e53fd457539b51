"""The stream: real time on two cores, the same bytes twice.

`delo run` on every real sequence, twice (reading and preprocessing included, compile time apart). What a stream costs besides its
frames, memory and compilation among it, is measured by `benchmarks/stream.py`.

Run:     python experiments/streaming.py --data TREE        (about 2 minutes on 2 cores)
Expect:  odo_04_000 at 10 scans/s or more.
"""

import csv
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import _harness
import numpy as np
from _harness import Row

import delo_jax
from delo_jax.data import camera_to_lidar, read_kitti_poses
from delo_jax.metrics.ate import relative_errors

SEQUENCES = ("odo_04_000", "raw_0926_0013", "odo_00_056")
REAL_TIME = "odo_04_000"  # the bound is on this one


def run(folder: Path, data: Path, name: str) -> dict[str, Any]:
    """`delo run` on a sequence, as a user starts it; its run.json."""
    command = [sys.executable, "-m", "delo_jax", "run", str(data / "sequences" / name), "--out", str(folder)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return json.loads((folder / "run.json").read_text())


def real(data: Path, name: str, work: Path) -> list[Row]:
    """Speed, errors and determinism of `delo run` on one real sequence, with the truth as delivered."""
    first, second = work / f"{name}-1", work / f"{name}-2"
    run(first, data, name)
    facts = run(second, data, name)
    with (second / "frames.csv").open() as file:
        frames = list(csv.DictReader(file))
    stages = [key for key in frames[0] if key.endswith("_ms")]
    milliseconds = np.array([sum(float(frame[key] or 0.0) for key in stages) for frame in frames])
    dataset = delo_jax.open_dataset(data / "sequences" / name)
    T_cam_lidar = _harness.needed(dataset.T_cam_lidar, f"Tr in calib.txt of {name}")
    estimated = camera_to_lidar(read_kitti_poses(second / "poses_kitti.txt"), T_cam_lidar)
    errors = relative_errors(estimated, _harness.needed(dataset.truth, f"truth of {name}"))
    same = all((first / file).read_bytes() == (second / file).read_bytes() for file in ("poses_kitti.txt", "covariances.npy"))
    print(f"{name}: elevation + {facts['sensor']['elevation_correction_deg']:g} deg, de-skew {facts['sensor']['deskew']}")
    good = sum(frame["status"] == "ok" for frame in frames)
    return [
        Row(f"{name} scans per second, reading included", 1e3 / milliseconds.mean(), "1/s", 10.0 if name == REAL_TIME else None, True),
        Row(f"{name} time per scan p50", float(np.median(milliseconds)), "ms"),
        Row(f"{name} time per scan p95", float(np.percentile(milliseconds, 95)), "ms"),
        Row(f"{name} compile time, apart", facts["compile_s"], "s"),
        Row(f"{name} two runs give the same bytes", float(same), "", 1.0, True),
        Row(f"{name} frames ok", 100 * good / len(frames), "%"),
        Row(f"{name} step error median", 100 * float(np.median(errors.translation_m)), "cm"),
        Row(f"{name} step error median", float(np.degrees(np.median(errors.rotation_rad))), "deg"),
    ]


def main(argv: list[str] | None = None) -> int:
    """Measure, print, judge."""
    args = _harness.parser(__doc__, needs_data=True).parse_args(argv)
    names, rows = SEQUENCES[-1:] if args.quick else SEQUENCES, []
    with tempfile.TemporaryDirectory() as work, _harness.progress() as bar:
        task = bar.add_task("real sequences", total=len(names))
        for name in names:
            rows += real(args.data, name, Path(work))
            bar.advance(task)
    return _harness.finish(rows, {"sequences": names}, args)


if __name__ == "__main__":
    _harness.run(main)
