"""Where the time of a frame goes: every part of `LidarOdometry.register` on a simulated drive, as a table and as a picture.

The parts are the package's own functions, timed in place; what none of them takes is "the rest". Results of jitted functions are awaited,
which the odometry does anyway as it reads them. Medians over the frames, the first ones apart; a part that a frame does not have (an
insertion into the map) counts 0 there, so means are printed beside.

Run:     python benchmarks/frame.py [--quick] [--figure docs/frame_time.png]     (about half a minute on 2 cores)
"""

import argparse
import functools
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

import delo_jax
from delo_jax import inference, preprocess
from delo_jax.bench.suite import device_line
from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.pipeline.local_map import LocalMap, Surroundings
from delo_jax.pipeline.scan_to_map import MapTracker
from delo_jax.sim import simulate_drive

SEED, NUM_SCANS, WARM_UP, NUM_QUICK = 1_740_000, 120, 20, 25
PARTS: dict[str, list[tuple[Any, str]]] = {
    "thin and crop": [(preprocess, "_thinned"), (preprocess, "_crop")],
    "voxels": [(preprocess, "voxel_mean"), (preprocess, "one_per_voxel")],
    "planes and features": [(preprocess, "_describe")],
    "points that are kept, key points": [(preprocess, "_select"), (preprocess, "_keypoints")],
    "map around the prediction": [(MapTracker, "expect"), (MapTracker, "_around")],  # its tree grows meanwhile
    "search for matches": [(Surroundings, "matches"), (Surroundings, "planes_in_reach")],
    "learned steps": [(inference, "fine_step")],
    "classical steps": [(inference, "robust_steps")],
    "classical steps with the velocity": [(inference, "sweep_steps")],
    "de-skew": [(inference.PreparedScan, "still")],
    "insertion into the map": [(LocalMap, "insert"), (LocalMap, "prune")],
}
REST = "the rest"


class Clock:
    """Seconds by part, time within an inner part counted there alone."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys([*PARTS, REST], 0.0)
        self._open: list[float] = []  # time that inner parts took, of each part under way

    def timed(self, part: str, function: Callable) -> Callable:
        """The function, its time counted."""

        @functools.wraps(function)
        def counted(*args: Any, **options: Any) -> Any:
            self._open.append(0.0)
            begin = time.perf_counter()
            try:
                return jax.block_until_ready(function(*args, **options))
            finally:
                took = time.perf_counter() - begin
                self.seconds[part] += took - self._open.pop()
                if self._open:
                    self._open[-1] += took

        return counted


def measure(num_scans: int, warm_up: int) -> dict[str, np.ndarray]:
    """Milliseconds of every frame after the first ones, by part, the total last."""
    params = delo_jax.load("delo-base")
    scans = list(simulate_drive("urban", SEED, num_scans, rolling_shutter=True))
    odometry, rows = delo_jax.LidarOdometry(params), []
    replaced = [(part, owner, name, getattr(owner, name)) for part, places in PARTS.items() for owner, name in places]
    clock = Clock()
    for part, owner, name, function in replaced:
        setattr(owner, name, clock.timed(part, function))
    try:
        for number, scan in enumerate(scans):
            clock.seconds = dict.fromkeys(clock.seconds, 0.0)
            register = clock.timed(REST, odometry.register)
            begin = time.perf_counter()
            register(scan.points, number * FRAME_PERIOD_NS, scan.times_s)
            rows.append(clock.seconds | {"total": time.perf_counter() - begin})
    finally:
        for _, owner, name, function in replaced:
            setattr(owner, name, function)
    return {name: 1e3 * np.array([row[name] for row in rows[warm_up:]]) for name in rows[0]}


def draw(path: Path, means: dict[str, float]) -> None:
    """One bar, cut into the parts in the order of a frame."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    ax: Any = figure.subplots()
    left, names = 0.0, list(means)
    for number, (name, value) in enumerate(means.items()):
        color = f"C{number % 10}"
        ax.barh(len(names) - number, value, left=left, color=color, height=0.75)
        ax.text(left + value + 0.25, len(names) - number, f"{name}, {value:.1f} ms", va="center", fontsize=8)
        left += value
    ax.set(xlabel="ms of a frame, mean", yticks=[], xlim=(0.0, 1.45 * left), title=f"Where the {left:.1f} ms of a frame go")
    ax.spines[["top", "right", "left"]].set_visible(False)
    figure.savefig(path, dpi=120, metadata={"Software": None})


def main() -> int:
    """Measure, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"{NUM_QUICK} scans")
    parser.add_argument("--figure", type=Path, help="draw it here, too")
    args = parser.parse_args()
    found = measure(*(NUM_QUICK, 10) if args.quick else (NUM_SCANS, WARM_UP))
    print("| part | mean ms | p50 ms | p95 ms | share % |\n|---|---:|---:|---:|---:|")
    means = {name: float(values.mean()) for name, values in found.items()}
    for name, values in found.items():
        p50, p95 = np.percentile(values, [50, 95])
        print(f"| {name} | {means[name]:.2f} | {p50:.2f} | {p95:.2f} | {100 * means[name] / means['total']:.0f} |")
    print(f"\n{device_line()}; {len(found['total'])} frames")
    if args.figure:
        draw(args.figure, {name: value for name, value in means.items() if name != "total"})
    return 0


if __name__ == "__main__":
    sys.exit(main())
