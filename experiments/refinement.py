"""What a pose graph gains on drives: all pairs, those that the gate lets through, with its thresholds or the paper's, shuffled covariances.

Unseen simulated drives of exact truth, as measured by a turning sensor, and the recorded sequences, with `poses_boresight` as truth; on
the map and from scan to scan. Odometry and network passes (every frame with the second next; key frames four apart) are done once a
drive, graphs differ in what they take: all pairs; those of key frames that a gate lets through, with the pairs two apart; the same pairs
with all covariances dealt out at random. Also how the errors of the edges hang together, which a graph takes to be independent:
correlation of a pass with the odometry over the same two frames, and with the next pass, which shares a scan.

A drive out and back on the same road, motion-compensated, backwards on the way home with the scans between those of the way out, shows
what loops do: proposed from the trajectory's own uncertainty, aligned from the identity both ways.

- The gate adds at most half of the factors of key frames and is at most 5 % worse than all of them.
- No drive below the median drift of its set gets an ATE or drift more than 2 % worse by refinement.
- Shuffled covariances are worse.
- Out and back, from scan to scan: loops are kept, none of them wrong, and the ATE with them is not larger than without.

Run:     python experiments/refinement.py --data TREE     (about 15 minutes on 2 cores)
Expect:  all bounds on the map kept, five from scan to scan missed.
"""

import time
from typing import NamedTuple

import _harness
import numpy as np
from _harness import Row
from _peers import Drive, recorded, simulated
from _tracks import SHORT_M, drift
from rich.progress import Progress

import delo_jax
from delo_jax import inference
from delo_jax.config import RefineConfig
from delo_jax.errors import WeightsError
from delo_jax.geometry import se3
from delo_jax.metrics.ate import absolute_errors
from delo_jax.model.delo import Model
from delo_jax.pipeline.lidar_odometry import STAMP_SIGMA_S
from delo_jax.refine import gtsam_backend, loops
from delo_jax.refine import plan as plans
from delo_jax.refine.refiner import Record, Refiner, Tracked
from delo_jax.sim import simulate_drive
from delo_jax.uncertainty import gate

SEED, NUM_DRIVES, NUM_SCANS = 720_000, 10, 120  # kinds take turns
KINDS = ("urban", "residential", "mixed", "road", "open")
SEQUENCES = ("raw_0926_0013", "odo_04_000", "odo_00_056")
NUM_QUICK, NUM_QUICK_SCANS = 2, 20
GATE = "gate"
GATES = {GATE: RefineConfig(), "gate, the paper's thresholds": RefineConfig(theta_min=0.2, theta_max=0.7)}
ODOMETRY, ALL, SHUFFLED = "odometry", "all pairs", "all pairs, shuffled"
MODES = {"on the map": True, "scan to scan": False}
LOOP_DRIVE, WRONG_M, MAX_LOOPED = ("urban", 721_000), 0.3, 1.0
MAX_SHARE, MAX_WORSE, MAX_HARM = 0.5, 1.05, 1.02


class Passed(NamedTuple):
    """Odometry and passes of a drive."""

    record: Record  # with all pairs
    confidences: np.ndarray  # (k,) of the record's robust factors; NaN of those that no gate judges
    Ts_true: np.ndarray


class Errors(NamedTuple):
    """Of a trajectory."""

    ate_cm: float
    percent: float
    deg: float  # per 100 m
    num_key: float  # factors of key frames
    solve_ms: float


def follow(drive: Drive, params: Model, use_map: bool, bar: Progress) -> Passed:
    """Odometry and all passes; what the gate would say of each."""
    stamp_sigma_s = STAMP_SIGMA_S if drive.name in SEQUENCES else 0.0  # a simulator's are exact
    odometry, confidences = delo_jax.LidarOdometry(params, use_map=use_map, stamp_sigma_s=stamp_sigma_s), {}
    quantiles = gate.Quantiles.of(params.variables)
    if quantiles is None:
        raise WeightsError("--weights: expected calibrated ones, got none with quantiles of held-out pairs; see delo calibrate")

    class Noting(Refiner):
        """Also notes confidences."""

        def _verdict(self, estimate):
            assert quantiles is not None
            confidences[len(self.record.frames) - 1] = gate.confidence(estimate.epistemic, quantiles)
            return gate.Verdict("refine", "noted")

    with Noting(params, RefineConfig(gate="none")) as refiner:
        for sweep in bar.track(drive.sweeps, description=f"{drive.name}, {'map' if use_map else 'scan to scan'}"):
            frame = odometry.register(sweep.points, sweep.stamp_ns, sweep.times_s)
            refiner.add(Tracked(frame.since, frame.T_world_lidar, frame.covariance, frame.local, odometry.last_scan))
    rows = plans.joined(refiner.record.factors)
    key = rows.targets - rows.sources == RefineConfig().key_gap
    found = np.array([confidences[target] if is_key else np.nan for target, is_key in zip(rows.targets.tolist(), key, strict=True)])
    return Passed(refiner.record, found, drive.Ts_world_lidar)


def variants(passed: Passed, rng: np.random.Generator) -> dict[str, plans.Plan]:
    """Graphs of a drive."""
    whole = passed.record.plan()
    own, pairs = (whole.factors.rows(which) for which in (~whole.factors.robust, whole.factors.robust))
    result = {ALL: whole}
    for name, cfg in GATES.items():
        keep = np.array([np.isnan(c) or gate.judge(float(c), cfg).action == "refine" for c in passed.confidences])
        result[name] = whole._replace(factors=plans.joined([own, pairs.rows(keep)]))
    everything = plans.joined([own, pairs])
    dealt = everything._replace(covariances=rng.permutation(everything.covariances))
    result[SHUFFLED] = whole._replace(factors=dealt)
    return result


def errors_of(Ts: np.ndarray, Ts_true: np.ndarray, num_key: float = 0.0, solve_ms: float = 0.0) -> Errors:
    """ATE after alignment, drift over 10-50 m."""
    return Errors(100 * absolute_errors(Ts, Ts_true).rmse_m, *drift(Ts, Ts_true, SHORT_M), num_key, solve_ms)


def judged(passed: Passed, seed: int) -> dict[str, Errors]:
    """Every variant of a drive."""
    Ts_odometry = np.stack([frame.T_world_lidar for frame in passed.record.frames])
    table = {ODOMETRY: errors_of(Ts_odometry, passed.Ts_true)}
    for name, plan in variants(passed, np.random.default_rng(seed)).items():
        begin = time.perf_counter()
        Ts = gtsam_backend.solve(plan).Ts_world_lidar
        spent = 1e3 * (time.perf_counter() - begin)
        rows = plan.factors
        num_key = np.sum(rows.robust & (rows.targets - rows.sources == RefineConfig().key_gap))
        table[name] = errors_of(Ts, passed.Ts_true, float(num_key), spent)
    return table


def show(title: str, table: dict[str, Errors]) -> None:
    """One drive, or the mean of several."""
    print(f"\n### {title}\n\n| graph | ATE cm | 10-50 m: % | deg/100 m | key factors | solve ms |\n|---|---:|---:|---:|---:|---:|")
    for name, e in table.items():
        print(f"| {name} | {e.ate_cm:.2f} | {e.percent:.3f} | {e.deg:.3f} | {e.num_key:.0f} | {e.solve_ms:.0f} |", flush=True)


def edge_errors(passed: Passed) -> np.ndarray:
    """(k, 3, 6) of a pass two frames on, of the odometry over the same frames, and of the next pass."""
    rows = plans.joined(passed.record.factors)
    two = rows.rows(rows.targets - rows.sources == RefineConfig().odometry_gap)
    true = se3.inverse(passed.Ts_true[two.sources]) @ passed.Ts_true[two.targets]
    Ts = np.stack([frame.T_world_lidar for frame in passed.record.frames])
    chained = se3.inverse(Ts[two.sources]) @ Ts[two.targets]
    passes, chain = (se3.log(se3.inverse(true) @ found) for found in (two.Ts_source_target, chained))
    place = {int(source): k for k, source in enumerate(two.sources)}
    pairs = [(k, place[int(target)]) for k, target in enumerate(two.targets) if int(target) in place]
    return np.stack([np.stack([passes[a], chain[a], passes[b]]) for a, b in pairs])


def show_correlations(title: str, drives: list[Passed]) -> None:
    """Of the edges' errors, axis by axis."""
    found = np.concatenate([edge_errors(passed) for passed in drives])
    found = found - np.median(found, axis=0, keepdims=True)
    cut = 4 * 1.4826 * np.median(np.abs(found), axis=0, keepdims=True)
    found = np.clip(found, -cut, cut)
    print(f"\n### {title}: correlation of the errors\n\n| | roll | pitch | yaw | forward | lateral | vertical |\n|---|" + "---:|" * 6)
    for what, other in (("a pass and the odometry over its frames", 1), ("a pass and the next one", 2)):
        cells = [f"{np.corrcoef(found[:, 0, axis], found[:, other, axis])[0, 1]:.2f}" for axis in range(6)]
        print(f"| {what} | {' | '.join(cells)} |", flush=True)


def out_and_back(params: Model, num_scans: int, bar: Progress) -> list[Row]:
    """A road driven twice."""
    task, scans = bar.add_task("out and back", total=2 * num_scans), []
    for scan in simulate_drive(*LOOP_DRIVE, 2 * num_scans):
        scans.append((scan.points, scan.T_world_lidar))
        bar.advance(task)
    scans = scans[::2] + scans[::-2]
    Ts_true = np.stack([T for _, T in scans])
    rows: list[Row] = []
    print("\n### Out and back\n\n| | path m | proposed | kept | wrong | ATE cm: odometry | pairs | pairs and loops |\n|---|" + "---:|" * 7)
    for mode, use_map in MODES.items():
        odometry, prepared = delo_jax.LidarOdometry(params, use_map=use_map, stamp_sigma_s=0.0), []
        with Refiner(params) as refiner:
            for points, _ in bar.track(scans, description=f"out and back, {mode}"):
                frame = odometry.register(points)
                prepared.append(odometry.last_scan)
                refiner.add(Tracked(frame.since, frame.T_world_lidar, frame.covariance, frame.local, odometry.last_scan))
        record = refiner.record
        chain = loops.Chain.of(record.plan())
        pairs = loops.propose(chain, np.array([scan is not None for scan in prepared]))
        there, back = ([inference.align(params, prepared[a], prepared[b], np.eye(4)) for a, b in ends] for ends in (pairs, pairs[:, ::-1]))
        kept = loops.verify(chain, pairs, there, back, record.local)
        off = se3.log(se3.inverse(kept.Ts_source_target) @ se3.inverse(Ts_true[kept.sources]) @ Ts_true[kept.targets])
        wrong = int(np.sum(np.linalg.norm(off[:, 3:], axis=1) > WRONG_M))
        Ts = [odometry.trajectory().Ts_world_lidar, *(gtsam_backend.solve(record.plan(extra)).Ts_world_lidar for extra in (None, kept))]
        ate = [100 * absolute_errors(poses, Ts_true).rmse_m for poses in Ts]
        way_m = np.linalg.norm(np.diff(Ts_true[:, :3, 3], axis=0), axis=1).sum()
        cells = " | ".join(f"{value:.2f}" for value in ate)
        print(f"| {mode} | {way_m:.0f} | {len(pairs)} | {len(kept.sources)} | {wrong} | {cells} |", flush=True)
        rows.append(Row(f"out and back, {mode}: wrong loops", wrong, "", 0.0))
        if not use_map:
            rows.append(Row(f"out and back, {mode}: ATE, with loops / without", ate[2] / ate[1], "", MAX_LOOPED))
    return rows


def mean(tables: list[dict[str, Errors]]) -> dict[str, Errors]:
    """Over drives."""
    return {name: Errors(*np.mean([table[name] for table in tables], axis=0).tolist()) for name in tables[0]}


def rows_of(mode: str, tables: list[dict[str, Errors]]) -> list[Row]:
    """Bounds of a set of drives."""
    total = mean(tables)
    gated, every, shuffled = total[GATE], total[ALL], total[SHUFFLED]
    rows = [Row(f"{mode}: key factors, gate / all", gated.num_key / every.num_key, "", MAX_SHARE)]
    for field in ("ate_cm", "percent", "deg"):
        rows.append(Row(f"{mode}: {field}, gate / all", getattr(gated, field) / getattr(every, field), "", MAX_WORSE))
    rows.append(Row(f"{mode}: ATE, shuffled / all", shuffled.ate_cm / every.ate_cm, "", 1.0, True))
    drifts = np.array([table[ODOMETRY].percent for table in tables])
    good = [table for table, value in zip(tables, drifts, strict=True) if value <= np.median(drifts)]
    for field in ("ate_cm", "percent"):
        worst = max(getattr(table[GATE], field) / getattr(table[ODOMETRY], field) for table in good)
        rows.append(Row(f"{mode}: good drives, worst {field}, refined / odometry", worst, "", MAX_HARM))
    return rows


def main(argv: list[str] | None = None) -> int:
    """Drives, variants, tables, bounds."""
    parser = _harness.parser(__doc__, needs_data=True)
    parser.add_argument("--weights", default="delo-base", help="name or file, calibrated")
    parser.add_argument("--sequences", nargs="*", default=list(SEQUENCES), help="recorded ones")
    args = parser.parse_args(argv)
    params = delo_jax.load(args.weights)
    num_drives, num_scans = (NUM_QUICK, NUM_QUICK_SCANS) if args.quick else (NUM_DRIVES, NUM_SCANS)
    tables: dict[str, list[dict[str, Errors]]] = {mode: [] for mode in MODES}
    passed: dict[str, list[Passed]] = {mode: [] for mode in MODES}
    rows: list[Row] = []
    with _harness.progress() as bar:
        for number in range(num_drives):
            drive = simulated(f"{number} {KINDS[number % len(KINDS)]}", SEED + number, num_scans, bar)
            for mode, use_map in MODES.items():
                one = follow(drive, params, use_map, bar)
                tables[mode].append(judged(one, number))
                passed[mode].append(one)
                show(f"{drive.name}, {mode}", tables[mode][-1])
        for name in args.sequences:
            drive = recorded(args.data, name, num_scans if args.quick else None, bar)
            for mode, use_map in MODES.items():
                one = follow(drive, params, use_map, bar)
                show(f"{name}, {mode}", judged(one, 0))
                show_correlations(f"{name}, {mode}", [one])
        rows += out_and_back(params, num_scans, bar)
    for mode in MODES:
        show(f"Simulated drives, {mode}: mean of {num_drives}", mean(tables[mode]))
        show_correlations(f"Simulated drives, {mode}", passed[mode])
        rows += rows_of(mode, tables[mode])
    return _harness.finish(rows, {"weights": args.weights, "drives": num_drives, "sequences": args.sequences}, args)


if __name__ == "__main__":
    _harness.run(main)
