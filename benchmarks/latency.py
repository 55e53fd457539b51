"""Time of every stage of one scan-to-scan step, and of a stream on its map, on full simulated HDL-64E scans; compilation apart.

Run:     python benchmarks/latency.py [--quick]        (about two minutes on 2 cores)

Timings are medians and tails of single calls, results awaited, transfers to and from the device included. N source points are
solved for, M target points are kept, K key points are matched.
"""

import argparse
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.progress import track

import delo_jax
from delo_jax import inference
from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.sim import simulate_drive
from delo_jax.sim.drive import DRIVE_SEED

WARM_UP, NUM_SCANS = 20, 200


def compile_seconds(params, points: np.ndarray) -> float:
    """First call of everything, which compiles."""
    begin = time.perf_counter()
    delo_jax.odometry(params, points, points)
    return time.perf_counter() - begin


def timed(function: Callable, *args) -> tuple[Any, float]:
    """Result and milliseconds of a call, until the result is there."""
    begin = time.perf_counter()
    result = jax.block_until_ready(function(*args))
    return result, 1e3 * (time.perf_counter() - begin)


def measure(params, scans: list[np.ndarray], num_scans: int) -> dict[str, list[float]]:
    """Milliseconds per stage and scan; the older scan of each pair is encoded already, as in a stream."""
    times: dict[str, list[float]] = {"preprocess": [], "encode": [], "align": [], "total": []}
    source = inference.prepare(params, scans[0])
    jax.block_until_ready(source.encoding)
    for k in track(range(WARM_UP + num_scans), "scans", console=Console(stderr=True)):
        target, preprocess_ms = timed(inference.prepare, params, scans[(k + 1) % len(scans)])
        _, encode_ms = timed(lambda scan: scan.encoding, target)
        _, align_ms = timed(inference.align, params, source, target, np.eye(4))
        source = target
        if k >= WARM_UP:
            for name, value in zip(times, (preprocess_ms, encode_ms, align_ms, preprocess_ms + encode_ms + align_ms), strict=True):
                times[name].append(value)
    return times


def measure_stream(params, num_scans: int) -> dict[str, list[float]]:
    """Milliseconds per stage and scan of `LidarOdometry`, on scans as measured; NaN where a scan is not taken into the map."""
    odometry, names = delo_jax.LidarOdometry(params), ("prepare", "solve", "insert")
    times: dict[str, list[float]] = {name: [] for name in (*names, "total")}
    drive = simulate_drive("urban", DRIVE_SEED + 127, WARM_UP + num_scans, rolling_shutter=True)
    for k, scan in enumerate(track(drive, "stream", total=WARM_UP + num_scans, console=Console(stderr=True))):
        timing = odometry.register(scan.points, k * FRAME_PERIOD_NS, scan.times_s).timing
        if k >= WARM_UP:
            for name in names:
                times[name].append(1e3 * timing.get(name, np.nan))
            times["total"].append(1e3 * sum(timing.values()))
    return times


def show(title: str, times: dict[str, list[float]]) -> None:
    """Percentiles of each stage."""
    print(f"\n| {title} | p50 ms | p95 ms | p99 ms |\n|---|---:|---:|---:|")
    for name, values in times.items():
        print(f"| {name} | " + " | ".join(f"{value:.1f}" for value in np.nanpercentile(values, (50, 95, 99))) + " |")


def main(argv: list[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="20 scans instead of 200")
    parser.add_argument("--weights", default="delo-base", help="name or file")
    args = parser.parse_args(argv)
    params = delo_jax.load(args.weights)
    scans = [scan.points for scan in simulate_drive("mixed", 3, 8)]
    compiled = compile_seconds(params, scans[0])
    times = measure(params, scans, 20 if args.quick else NUM_SCANS)
    cfg = params.cfg
    print(f"N = {cfg.fine.num_points}, M = {cfg.preprocess.max_points}, K = {cfg.preprocess.num_keypoints}; {len(scans[0])} points a scan")
    print(f"JAX {jax.__version__} on {jax.devices()[0].device_kind}, delo-jax {version('delo-jax')}; first call {compiled:.1f} s")
    show("scan to scan", times)
    show("stream on a map", measure_stream(params, 20 if args.quick else 110))
    return 0


if __name__ == "__main__":
    sys.exit(main())
