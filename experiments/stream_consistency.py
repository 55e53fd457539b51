"""Whether the covariances of a drive on the map fit its errors: of motions over 1, 10 and 100 frames, and of poses in the world.

Simulated drives of exact truth that neither the weights nor their covariance has seen, kinds of the world in turn, 120 scans each, one in
four compensated, the others as measured by a turning sensor. What has to be fitted was fitted by `delo calibrate` on drives of other seeds.

- before: the inverse information of each registration with its hand-made constants; motions are chained as if independent.
- after: `uncertainty.stream`, an error of each pose on the map and a drift along the way, with the numbers that the weights carry.

Motions over 1 frame are bounded. Those over 10 and 100 frames overlap, a dozen drives hold few independent ones, and poses in the world
share the first scan of their drive: they are printed. Recorded sequences (`--sequences odo_00_056 raw_0926_0002`, with `--data`) are
printed too, without a bound: their errors, which hold those of the truth, are larger than a simulator's, and what is calibrated on
simulated drives is too sure of them.

Run:     python experiments/stream_consistency.py                (about 8 minutes on 2 cores; drives are kept in runs/)
Expect:  all bounds kept.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import _harness
import numpy as np
from _harness import Row

import delo_jax
from delo_jax.data.poses import camera_to_lidar, read_kitti_poses
from delo_jax.errors import ConfigError, WeightsError
from delo_jax.geometry import se3
from delo_jax.metrics.calibration import coverage, nees
from delo_jax.model.delo import Model
from delo_jax.train.calibrate import LEVELS
from delo_jax.train.calibrate_stream import GAPS, NUM_SCANS, UNITS, WORLD, Drive, covariances, segments, stored_drives
from delo_jax.uncertainty.observability import AXES
from delo_jax.uncertainty.stream import NAME, StreamNoise

UNSEEN_SEED = 1_700_000
NUM_DRIVES, NUM_QUICK, NUM_QUICK_SCANS = 12, 1, 15
NEES_RANGE = (0.8, 1.25)
NAMES = {1: "1 frame", 10: "10 frames", 100: "100 frames", WORLD: "world"}
PRINTED = np.repeat([1e3, 100.0], 3)  # mrad, cm


class Errors(NamedTuple):
    """Errors and what was said of them."""

    errors: np.ndarray  # (n, 6) [rad, m]
    covariances: np.ndarray  # (n, 6, 6)


def chained(drives: list[Drive]) -> dict[int, Errors]:
    """Errors with the covariances of the registrations, added up along the way as if their errors were independent."""
    found: dict[int, Errors] = {}
    for gap in (*GAPS, WORLD):
        pairs = [pair for drive in drives for pair in _chains(drive, gap)]
        if pairs:
            found[gap] = Errors(*(np.stack(arrays) for arrays in zip(*pairs, strict=True)))
    return found


def _chains(drive: Drive, gap: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    num, Ts = len(drive.good), drive.Ts_world_lidar
    motions = [(0, k) for k in range(1, num)] if gap == WORLD else [(k, k + gap) for k in range(1, num - gap)]
    for start, end in motions:
        if not drive.good[start : end + 1].all():
            continue
        C = np.zeros((6, 6))
        for k in range(start + 1, end + 1):
            C = se3.compose_covariance(C, drive.classical[k], se3.inverse(Ts[k - 1]) @ Ts[k])
        T, T_true = (se3.inverse(poses[start]) @ poses[end] for poses in (Ts, drive.Ts_true))
        yield se3.log(se3.inverse(T) @ T_true), C


def calibrated(drives: list[Drive], numbers: StreamNoise) -> dict[int, Errors]:
    """Errors with the calibrated covariances."""
    rows = segments(drives)
    errors, C = rows.errors * UNITS, covariances(numbers, rows) * np.outer(UNITS, UNITS)
    return {gap: Errors(errors[rows.gaps == gap], C[rows.gaps == gap]) for gap in np.unique(rows.gaps)}


def plain(model: Model) -> Model:
    """The same weights without the numbers of a drive."""
    return replace(model, variables={name: value for name, value in model.variables.items() if name != NAME})


def recorded(data: Path, name: str, model: Model, bar) -> Errors:
    """Motions of a recorded sequence over 1 frame, with the covariances of their frames."""
    dataset = delo_jax.open_dataset(data / "sequences" / name, azimuth_times=name.startswith("raw_"))
    T_cam_lidar = _harness.needed(dataset.T_cam_lidar, f"Tr in calib.txt of {name}")
    stamps_ns = _harness.needed(dataset.stamps_ns, f"times.txt of {name}")
    Ts_true = camera_to_lidar(read_kitti_poses(data / "poses_boresight" / f"{name}.txt"), T_cam_lidar)
    odometry, errors, Cs = delo_jax.LidarOdometry(model), [], []
    for k in bar.track(range(len(dataset)), description=name):
        scan = dataset[k]
        frame = odometry.register(scan.points, int(stamps_ns[k]), scan.times)
        if k > 0 and frame.status == "ok":
            T_true = se3.inverse(Ts_true[frame.since]) @ Ts_true[k]
            errors.append(se3.log(se3.inverse(frame.motion.T_target_source) @ T_true))
            Cs.append(frame.motion.covariance)
    return Errors(np.stack(errors), np.stack(Cs))


def show(title: str, by_name: dict[str, Errors]) -> None:
    """Consistency, median sigmas and root mean square errors, coverage."""
    print(f"\n## {title}\n\n| covariance | n | squared / expected | level | {' | '.join(AXES)} |\n|---|---:|---:|---|{'---:|' * 6}")
    for name, (errors, C) in by_name.items():
        sigmas = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
        head = f"| {name} | {len(errors)} | {nees(errors, C).mean() / 6:.2f} |"
        for level in LEVELS:
            print(f"{head} {100 * level:.0f} % | " + " | ".join(f"{100 * share:.1f}" for share in coverage(errors, sigmas, level)) + " |")
        for what, values in (("sigma", np.median(sigmas, axis=0)), ("error", np.sqrt(np.mean(errors**2, axis=0)))):
            print(f"{head} {what}, mrad and cm | " + " | ".join(f"{value:.2f}" for value in values * PRINTED) + " |")


def judge(before: dict[int, Errors], after: dict[int, Errors]) -> list[Row]:
    """Bounds on single motions; the rest is printed."""
    rows = []
    for name, table in (("before", before), ("after", after)):
        for gap, (errors, C) in table.items():
            squared, bounded = float(nees(errors, C).mean()) / 6, name == "after" and gap == GAPS[0]
            rows.append(Row(f"{name}, {NAMES[gap]}: error squared / expected", squared, "", NEES_RANGE[1] if bounded else None))
            if bounded:
                rows.append(Row("the same", squared, "", NEES_RANGE[0], True))
    return rows


def main(argv: list[str] | None = None) -> int:
    """Simulate, register, print, judge."""
    parser = _harness.parser(__doc__, needs_data=False)
    parser.add_argument("--weights", default="delo-base", help="name or file, calibrated for drives")
    parser.add_argument("--out", type=Path, default=Path("runs/calibrated"), help="folder of `delo calibrate`, for drives")
    parser.add_argument("--data", type=Path, help="tree of real sequences, for --sequences")
    parser.add_argument("--sequences", nargs="*", default=[], help="recorded ones, printed beside the drives")
    args = parser.parse_args(argv)
    if args.sequences and args.data is None:
        raise ConfigError("--data: expected the tree of the recorded sequences, got none; name it, or leave --sequences out")
    model = delo_jax.load(args.weights)
    numbers = StreamNoise.of(model.variables)
    if numbers is None:
        raise WeightsError(f"{args.weights}: expected weights that are calibrated for drives, got none; run delo calibrate")
    count, num_scans = (NUM_QUICK, NUM_QUICK_SCANS) if args.quick else (NUM_DRIVES, NUM_SCANS)
    with _harness.progress() as bar:
        task = bar.add_task("unseen drives", total=count * num_scans)
        stored = stored_drives(args.out / "drives", model, count, UNSEEN_SEED, num_scans=num_scans, on_scan=lambda: bar.advance(task))
        drives = list(stored)
        cases = [(name, what, weights) for name in args.sequences for what, weights in (("before", plain(model)), ("after", model))]
        real = {f"{name}, {what}": recorded(args.data, name, weights, bar) for name, what, weights in cases}
    before, after = chained(drives), calibrated(drives, numbers)
    for gap in after:
        show(f"Unseen drives, {NAMES[gap]}", {"before": before[gap], "after": after[gap]})
    if real:
        show("Recorded, 1 frame", real)
    return _harness.finish(judge(before, after), {"weights": args.weights, "drives": count, "scans": num_scans}, args)


if __name__ == "__main__":
    _harness.run(main)
