"""Every odometry and every pair method on the same scans: drives along KITTI's official motions, and recorded sequences.

Drives: path, heading, speed and body motions of the official poses, scans simulated as measured by an HDL-64E in a random world beside the
path, with exact truth (no scan of KITTI is in them; `delo_jax.sim.simulate_route`). 04, 07 and 10 whole, the first 300 frames of the
others; `--all` takes 00 to 10 whole. Recorded sequences with `poses_boresight` as truth. KITTI's metric over the lengths of 100 to 800 m
that each reaches, 10 to 50 m on the recorded ones; every method sees every scan as it comes, taking turns at who is first. `--jobs`
sequences are under way at a time, one a core by default: times are those of methods on their share of the cores.

Pairs at gaps of 1, 2, 3 and 5 frames, from the identity, as measured (no de-skew), 60 at even distances of each gap; a pair is lost when it
is off by more than 0.5 m or 2 deg. Times hold the preparation of both scans.

What a method made of a sequence is kept in `--out` by content (scans, method, version, settings): a re-run does what has changed.

Run:     python experiments/benchmark.py --data TREE           (about an hour on 2 cores; needs '.[baselines]')
Expect:  all bounds kept.
"""

import functools
import sys
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import _harness
import numpy as np
from _benchmark import EXCERPT, GAPS, KINDS, OTHERS, OWN, WHOLE, Entry, Results, Sequence, is_stored, real, run, simulated, source_hash
from _harness import Row
from _workers import Counting, cores, spread
from rich.progress import Progress

import delo_jax
from delo_jax import weights
from delo_jax.baselines.registry import METHODS, Method
from delo_jax.errors import ConfigError, DeloError
from delo_jax.metrics.ate import absolute_errors
from delo_jax.metrics.drift import KITTI_LENGTHS_M, SHORT_LENGTHS_M, Drift, Segments, joined, mean_drift, segment_errors
from delo_jax.model.delo import Model
from delo_jax.pipeline.baseline_odometry import BaselineOdometry
from delo_jax.pipeline.lidar_odometry import LidarOdometry

SEQUENCES = ("odo_00_056", "odo_04_000", "raw_0926_0013")
OURS, NO_MAP = "delo", "delo, no map"
PAIRS_ONLY = ("kiss-matcher",)  # takes most of a second a scan, and is no odometry
NETWORKS = "of networks that you trained: of a method (dcp, delo-paper), or under another name, as a row of its own"
LOST_M, LOST_DEG = 0.5, 2.0
QUICK_ROUTE, QUICK = "04", 40  # scans


class Numbers(NamedTuple):
    """Of one odometry on one sequence."""

    segments: Segments
    ate_m: float
    p50_ms: float
    p95_ms: float
    not_ok: int


def entries(names: list[str], given: dict[str, str]) -> dict[str, Entry]:
    """Methods by name, those that can run; of the others it says why not. A name that no method has is this package with weights given."""
    found = {}
    weights_of = {OURS: "delo-base"} | given
    for name in dict.fromkeys([*names, *(name for name in given if name not in METHODS)]):
        method = METHODS.get(name, METHODS[OURS])
        model = delo_jax.load(weights_of[name]) if name in weights_of else None
        try:
            method.check(model)
        except DeloError as error:
            print(f"left out: {error}", file=sys.stderr)
            continue
        digest = "" if model is None else f"{weights.read_card(weights_of[name])['sha256']} {model.cfg}"
        stamp = f"{source_hash(OWN if method.network else OTHERS)} {method.package_version} {digest}"
        opened = () if model is None else (model,)
        tracker = None if name in PAIRS_ONLY else functools.partial(_tracker, method, opened)
        found[name] = Entry(stamp, tracker, None if method.pair is None else functools.partial(method.open_pair, *opened))
        if name == OURS:
            found[NO_MAP] = Entry(stamp, functools.partial(LidarOdometry, *opened, use_map=False), None)
    return found


def _tracker(method: Method, opened: tuple[Model, ...]) -> BaselineOdometry | LidarOdometry:
    """A method along a drive; one without a tracker is `LidarOdometry`, on a map where the network has a fine stage for one."""
    if method.tracker is None:
        return LidarOdometry(*opened, use_map=opened[0].cfg.fine.num_iters > 0)
    return BaselineOdometry(method.open_tracker(*opened))


def numbers(results: Results, name: str, lengths_m: tuple[float, ...]) -> Numbers:
    """Of one odometry."""
    found, truth = results.poses[name], results.Ts_world_lidar
    segments = segment_errors(found.Ts_world_lidar, truth, lengths_m=lengths_m, step=10 if lengths_m is KITTI_LENGTHS_M else 1)
    p50, p95 = 1e3 * np.percentile(found.seconds[1:], [50, 95])
    return Numbers(segments, absolute_errors(found.Ts_world_lidar, truth).rmse_m, float(p50), float(p95), int(np.sum(~found.ok)))


def show_odometry(sequence: Sequence, table: dict[str, Numbers], way_m: float) -> None:
    """One row for each odometry."""
    first = mean_drift(next(iter(table.values())).segments)
    reached = first.lengths_m[first.num_segments_by_length > 0]
    print(f"\n### {sequence.name}: {sequence.num_scans} scans, {way_m:.0f} m; drift over {reached[0]:g} to {reached[-1]:g} m\n")
    print("| odometry | t_rel % | r_rel deg/100 m | ATE m | p50 ms | p95 ms | not ok |\n|---|---:|---:|---:|---:|---:|---:|")
    for name, row in table.items():
        drift = mean_drift(row.segments)
        cells = f"{drift.t_rel_percent:.3f} | {drift.r_rel_deg_per_100m:.3f}"
        print(f"| {name} | {cells} | {row.ate_m:.3f} | {row.p50_ms:.1f} | {row.p95_ms:.1f} | {row.not_ok} |")


def show_pooled(title: str, tables: list[dict[str, Numbers]]) -> dict[str, Drift]:
    """Mean over the segments of all sequences, median times, and on how many of the sequences each odometry is the best."""
    drifts = {name: mean_drift(joined([table[name].segments for table in tables])) for name in tables[0]}
    best = [min((np.mean(row.segments.t_rel_percent), name) for name, row in table.items())[1] for table in tables]
    print(f"\n## {title}\n\n| odometry | t_rel % | r_rel deg/100 m | p50 ms | p95 ms | least t_rel on |\n|---|---:|---:|---:|---:|---:|")
    for name, drift in sorted(drifts.items(), key=lambda item: item[1].t_rel_percent):
        p50, p95 = (np.median([getattr(table[name], of) for table in tables]) for of in ("p50_ms", "p95_ms"))
        cells = f"{drift.t_rel_percent:.3f} | {drift.r_rel_deg_per_100m:.3f} | {p50:.1f} | {p95:.1f}"
        print(f"| {name} | {cells} | {best.count(name)} of {len(tables)} |")
    return drifts


def show_pairs(title: str, by_method: dict[str, list]) -> dict[tuple[str, int], float]:
    """A row for each method and gap; shares of lost pairs [%] by method and gap."""
    print(f"\n## {title}\n\n| gap | method | pairs | cm: median / p95 | deg: median / p95 | lost % | p50 ms |")
    print("|---:|---|---:|---|---|---:|---:|")
    lost = {}
    for gap in GAPS:
        for name, parts in by_method.items():
            which = [part.gaps == gap for part in parts]
            errors = np.concatenate([part.errors[rows] for part, rows in zip(parts, which, strict=True)])
            seconds = np.concatenate([part.seconds[rows] for part, rows in zip(parts, which, strict=True)])
            cm, deg = 100 * np.linalg.norm(errors[:, 3:], axis=1), np.degrees(np.linalg.norm(errors[:, :3], axis=1))
            lost[name, gap] = 100 * float(np.mean((cm > 100 * LOST_M) | (deg > LOST_DEG)))
            spread = " | ".join(
                f"{np.median(values):.{digits}f} / {np.percentile(values, 95):.{digits}f}" for values, digits in ((cm, 1), (deg, 3))
            )
            print(f"| {gap} | {name} | {len(errors)} | {spread} | {lost[name, gap]:.1f} | {1e3 * np.median(seconds):.0f} |")
    return lost


def judge(drifts: dict[str, Drift], lost: dict[tuple[str, int], float]) -> list[Row]:
    """Ours beside the best peer that ran: drift over all simulated drives; lost pairs."""
    rows = []
    for what, of in (("t_rel", "t_rel_percent"), ("r_rel", "r_rel_deg_per_100m")):
        peers = [getattr(drift, of) for name, drift in drifts.items() if name in METHODS and name != OURS]
        if OURS in drifts and peers:
            rows.append(Row(f"simulated drives: {what} / that of the best peer", getattr(drifts[OURS], of) / min(peers), "", 1.0))
    for gap in GAPS:
        if (OURS, gap) in lost:
            rows.append(Row(f"simulated drives, gap {gap}: lost pairs", lost[OURS, gap], "%", 1.0))
    return rows


def parse(argv: list[str] | None, doc: str | None = __doc__):
    """Arguments; of another script, too, that reads the same store."""
    parser = _harness.parser(doc, needs_data=True)
    parser.add_argument("--all", action="store_true", help="00 to 10 whole: 23,200 scans, about seven hours")
    parser.add_argument("--routes", nargs="*", default=list(KINDS), help="official sequences to drive along")
    parser.add_argument("--sequences", nargs="*", default=list(SEQUENCES), help="recorded ones of the tree")
    parser.add_argument("--methods", nargs="*", default=list(METHODS), help="of `delo run --help`; all by default")
    parser.add_argument("--weights", nargs="*", default=[], metavar="NAME=FILE", help=NETWORKS)
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark"), help="store")
    parser.add_argument("--jobs", type=int, default=len(cores()), help="sequences at a time, each with its share of the cores")
    args = parser.parse_args(argv)
    for given, known in ((args.methods, METHODS), (args.routes, KINDS)):
        if unknown := set(given) - set(known):
            raise ConfigError(f"expected of {', '.join(known)}, got {', '.join(sorted(unknown))}")
    return args


def chosen(args) -> tuple[list[tuple[str, int | None]], list[tuple[str, None]]]:
    """Simulated and recorded sequences, by name and number of scans, all scans where that is None."""
    if args.quick:
        return [(QUICK_ROUTE, QUICK)], []
    return [(number, None if args.all or number in WHOLE else EXCERPT) for number in args.routes], [(name, None) for name in args.sequences]


def opened(data: Path, name: str, num_scans: int | None, bar: Progress) -> Sequence:
    """A simulated or a recorded one."""
    return simulated(data, name, num_scans=num_scans) if name in KINDS else real(data, name, bar)


def work(args, name: str, num_scans: int | None, methods: list[str]) -> None:
    """What the methods make of a sequence, into the store; in a process of its own."""
    found = entries(methods, _weights(args))
    run(opened(args.data, name, num_scans, Progress(disable=True)), found, args.out, Counting())


def _weights(args) -> dict[str, str]:
    return dict(one.split("=", 1) for one in args.weights)


def main(argv: list[str] | None = None) -> int:
    """Run what is missing, print, judge."""
    args = parse(argv)
    methods = entries(args.methods, _weights(args))
    results: list[list[Results]] = []
    with _harness.progress() as bar:
        both = [[(opened(args.data, *which, bar), which) for which in group] for group in chosen(args)]
        missing = [(sequence.num_scans, which) for group in both for sequence, which in group if not is_stored(sequence, methods, args.out)]
        if num := min(args.jobs, len(missing)):
            names = [name for name in methods if name != NO_MAP]
            tasks = [(args, *which, names) for _, which in sorted(missing, key=lambda one: -one[0])]
            spread(work, tasks, num, bar, "scans", sum(num_scans for num_scans, _ in missing))
        for group in both:
            results.append([run(sequence, methods, args.out, bar) for sequence, _ in group])
    rows: list[Row] = []
    lengths = (SHORT_LENGTHS_M if args.quick else KITTI_LENGTHS_M), SHORT_LENGTHS_M
    titles = "Simulated drives along KITTI's motions", "Recorded sequences"
    for title, lengths_m, group, found in zip(titles, lengths, both, results, strict=True):
        tables = []
        for (sequence, _), result in zip(group, found, strict=True):
            tables.append({name: numbers(result, name, lengths_m) for name in result.poses})
            way_m = np.linalg.norm(np.diff(result.Ts_world_lidar[:, :3, 3], axis=0), axis=1).sum()
            show_odometry(sequence, tables[-1], way_m)
        if tables:
            drifts = show_pooled(title, tables)
            by_method = {name: [one.pairs[name] for one in found] for name in found[0].pairs}
            lost = show_pairs(f"{title}: pairs from the identity", by_method)
            rows = rows or judge(drifts, lost)
    settings = {"routes": args.routes, "sequences": args.sequences, "all": args.all, "jobs": args.jobs, "methods": list(methods)}
    settings["versions"] = {name: version(name) for name in {METHODS[n].package for n in args.methods} if name is not None}
    return _harness.finish(rows, settings, args)


if __name__ == "__main__":
    _harness.run(main)
