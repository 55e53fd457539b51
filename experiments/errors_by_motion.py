"""Errors by speed, by acceleration and by length of the way, of every odometry of `benchmark.py`, from what that has stored.

Speed and length: KITTI's segments of 100 to 800 m of the simulated drives along its official motions, in the classes of the devkit.
Acceleration: errors of the motion from scan to scan, in classes of the change of the true speed.

Run:     python experiments/errors_by_motion.py --data TREE       (seconds, after `benchmark.py` with the same options)
Expect:  three tables and errors_by_motion.png in the folder of the store; no bound.
"""

from pathlib import Path

import _harness
import benchmark
import numpy as np
from _benchmark import Results, run
from _harness import Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.metrics.ate import relative_errors
from delo_jax.metrics.drift import KITTI_LENGTHS_M, KITTI_MIN_SEGMENTS, SHORT_LENGTHS_M, drift_by_speed, joined, mean_drift, segment_errors
from delo_jax.report.calibration import COLORS

SHOWN = ("delo", "delo, no map", "kiss-icp", "genz-icp", "vgicp", "gicp")  # the others are off the scale
EDGES = np.array([0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0])  # m/s^2
SMOOTH = 5  # scans over which the acceleration is the slope of the speed
FRAME_S = 1e-9 * FRAME_PERIOD_NS

Curve = tuple[np.ndarray, np.ndarray, np.ndarray]  # middle of the class, translation, rotation; NaN where a class is empty


def accelerations(Ts_world_lidar: np.ndarray) -> np.ndarray:
    """(n - 1,) size of the change of speed at each motion [m/s^2]."""
    speed = np.linalg.norm(np.diff(Ts_world_lidar[:, :3, 3], axis=0), axis=1) / FRAME_S
    kernel = np.ones(SMOOTH) / SMOOTH
    smooth = np.convolve(np.pad(speed, SMOOTH // 2, mode="edge"), kernel, mode="valid")
    return np.abs(np.gradient(smooth, FRAME_S))


def by_acceleration(results: list[Results], name: str) -> Curve:
    """Root mean square errors from scan to scan: cm and mrad."""
    sizes = np.concatenate([accelerations(one.Ts_world_lidar) for one in results])
    errors = [relative_errors(one.poses[name].Ts_world_lidar, one.Ts_world_lidar) for one in results]
    squared = [np.concatenate(values) ** 2 for values in ([e.translation_m for e in errors], [e.rotation_rad for e in errors])]
    inside = (sizes[None] >= EDGES[:-1, None]) & (sizes[None] < EDGES[1:, None])
    counts = inside.sum(axis=1)
    cm, mrad = (
        scale * np.sqrt(inside @ values / np.where(counts, counts, np.nan)) for scale, values in zip((1e2, 1e3), squared, strict=True)
    )
    return 0.5 * (EDGES[:-1] + EDGES[1:]), cm, mrad


def by_speed(results: list[Results], name: str) -> Curve:
    """Mean drift in the devkit's classes of speed, of three segments or more."""
    found = drift_by_speed(_segments(results, name))
    enough = found.num_segments >= KITTI_MIN_SEGMENTS
    t_rel, r_rel = (np.where(enough, values, np.nan) for values in (found.t_rel_percent, found.r_rel_deg_per_100m))
    return found.speeds_mps, t_rel, r_rel


def by_length(results: list[Results], name: str) -> Curve:
    """Mean drift by length of the segment."""
    found = mean_drift(_segments(results, name))
    return found.lengths_m, found.t_rel_percent_by_length, found.r_rel_deg_per_100m_by_length


def _segments(results: list[Results], name: str):
    shortest_m = min(np.linalg.norm(np.diff(one.Ts_world_lidar[:, :3, 3], axis=0), axis=1).sum() for one in results)
    lengths_m = KITTI_LENGTHS_M if shortest_m > KITTI_LENGTHS_M[0] else SHORT_LENGTHS_M  # of a quick run
    return joined([segment_errors(one.poses[name].Ts_world_lidar, one.Ts_world_lidar, lengths_m=lengths_m) for one in results])


def show(title: str, unit: str, curves: dict[str, Curve]) -> None:
    """A row for each class and method."""
    names = " | ".join(curves)
    print(f"\n## {title}\n\n| {unit} | what | {names} |\n|---:|---|{'---:|' * len(curves)}")
    places = next(iter(curves.values()))[0]
    for what in (1, 2):
        for index, place in enumerate(places):
            values = [curve[what][index] for curve in curves.values()]
            if np.isfinite(values).any():
                print(f"| {place:g} | {('translation', 'rotation')[what - 1]} | {' | '.join(f'{value:.3f}' for value in values)} |")


def best(curves: dict[str, Curve]) -> float:
    """Share of the classes, translation and rotation, in which the first method has the least error."""
    table = np.stack([np.concatenate(curve[1:]) for curve in curves.values()])
    known = np.isfinite(table).all(axis=0)
    return float(np.mean(np.argmin(table[:, known], axis=0) == 0))


def draw(path: Path, columns: dict[str, tuple[dict[str, Curve], tuple[str, str, str]]]) -> None:
    """Translation above, rotation below, a column for each kind of class."""
    figure = Figure(figsize=(12.0, 6.4), layout="constrained")
    axes = figure.subplots(2, len(columns), squeeze=False)
    for column, (title, (curves, labels)) in enumerate(columns.items()):
        for row in (0, 1):
            ax: Axes = axes[row, column]
            for color, (name, curve) in zip(COLORS, curves.items(), strict=False):
                known = np.isfinite(curve[1 + row])
                ax.plot(curve[0][known], curve[1 + row][known], color=color, lw=1.6, marker="o", ms=4.0, label=name)
            ax.set(xlabel=labels[0], ylabel=labels[1 + row], yscale="log", title=title if row == 0 else "")
            ax.grid(alpha=0.3, which="both")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize="small")
    figure.savefig(path, dpi=130, metadata={"Software": None})


def main(argv: list[str] | None = None) -> int:
    """Read, bin, print, draw."""
    args = benchmark.parse(argv, __doc__)
    methods = benchmark.entries([name for name in args.methods if name in SHOWN], {})
    with _harness.progress() as bar:
        drives = [benchmark.opened(args.data, *which, bar) for which in benchmark.chosen(args)[0]]
        results = [run(sequence, methods, args.out, bar) for sequence in drives]
    names = [name for name in SHOWN if name in results[0].poses]
    kinds = {
        "by speed": (by_speed, ("speed [m/s]", "t_rel [%]", "r_rel [deg/100 m]")),
        "by acceleration": (by_acceleration, ("size of the acceleration [m/s²]", "RMSE per scan [cm]", "RMSE per scan [mrad]")),
        "by length": (by_length, ("length [m]", "t_rel [%]", "r_rel [deg/100 m]")),
    }
    columns = {title: ({name: of(results, name) for name in names}, labels) for title, (of, labels) in kinds.items()}
    for title, (curves, labels) in columns.items():
        show(f"{title}: {labels[1]}, {labels[2]}", labels[0], curves)
    draw(args.out / "errors_by_motion.png", columns)
    rows = [Row(f"{title}: classes in which ours is off least", 100 * best(curves), "%") for title, (curves, _) in columns.items()]
    return _harness.finish(rows, {"routes": args.routes, "all": args.all, "methods": names}, args)


if __name__ == "__main__":
    _harness.run(main)
