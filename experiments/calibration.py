"""Which covariance of a pair fits the errors: the evidence as it is, rescaled, the registration's information, or a full one.

All 30 ordered pairs of six scans, 0.1 s apart, of simulated worlds with exact truth, from the identity. What has to be fitted is fitted on
the worlds of `delo calibrate` (other seeds) by maximum likelihood; nothing is fitted on the worlds of the table. Lost pairs are apart, but
for the area under the ROC curve, which says whether the sigmas tell pairs that are off by more than 0.3 m or 1 deg.

- evidence: normal-inverse-gamma, the moments of the released head, second moment about the pose.
- evidence, rescaled: each sigma to a power, times a factor, axis by axis: twelve numbers.
- information: inverse Gauss-Newton matrix of the planes, scaled for rotation and translation, plus a variance per axis: eight numbers.
- full: `ops.spread`, a Cholesky factor in the frame of the motion, from the solver's statistics and the evidence; the default.
- Student: the same head under a multivariate Student-t likelihood, its degrees of freedom fitted too; its intervals are those of t.
- ensemble of 5 heads: mean covariance of five such heads, each fitted on a bootstrap sample of the worlds; their mean is the same pose.
- ensemble of 3 networks: members trained on from the weights, each on 120 worlds of its own; the second moment, about the default's pose,
  of the mixture of their Gaussians, six factors fitted. Member heads and factors are fitted on the first 100 of the worlds.

Only `full` has had its last scales set on folds. The default in bins of speed, turn rate and overlap (share of the source points that have
a target point within 1 m at the true pose, of the preprocessed scans).

Then drives, pair after pair, each de-skewed by its own motion: unseen simulated ones as measured by a turning sensor, and recorded ones
(`--drives`). Squared errors over 10 and 100 frames are those of the pairs in a row, their covariances added up as if independent. The
noise of the truth of recorded pairs (`real_calibration.py` says how it is measured) is added over 1 frame; over more it is not known.

Run:     python experiments/calibration.py --drives raw_0926_0013 odo_04_000 --data TREE     (about an hour on 2 cores after
         `delo calibrate`, which leaves its solved pairs, 25 minutes with --members 0; members and figures go to its folder)
Expect:  all bounds kept.
"""

import functools
from pathlib import Path

import _harness
import numpy as np
from _covariances import FULL, UNITS, Method, Said, methods, over_frames, sparsifications
from _harness import Row
from _members import QUICK, Budget, Solved, trained
from _peers import Drive, recorded, simulated
from _truth import noise_header, truth_noise
from _uncertainty import LIMITS, deskewed, prepared_sweep, relative
from rich.progress import Progress
from scipy.spatial import cKDTree

import delo_jax
from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.errors import ConfigError
from delo_jax.geometry import se3
from delo_jax.metrics.calibration import auroc, coverage, nees
from delo_jax.model.delo import Model
from delo_jax.report.calibration import error_figure, reliability_figure
from delo_jax.sim import KINDS
from delo_jax.train.calibrate import FRAMES, NUM_FRAMES, Pairs, joined, solved_pair, stored_pairs
from delo_jax.train.calibrate import LEVELS as BOUNDED_LEVELS
from delo_jax.train.worlds import CALIBRATION_SEED, scan_of, stored_world
from delo_jax.uncertainty.observability import AXES

UNSEEN_SEED, DRIVE_SEED = 1_600_000, 1_720_000
NUM_UNSEEN, NUM_FITTED, NUM_QUICK = 300, 900, 4
NUM_MEMBERS, NUM_MEMBERS_FITTED = 3, 100
NUM_DRIVES, NUM_SCANS, NUM_QUICK_SCANS = 6, 121, 13
STEPS = (10, 100)  # frames, of pairs in a row
LEVELS = (0.5, 0.68, 0.9, 0.95, 0.99)
POINTS, NEES_RANGE = 5.0, (0.8, 1.25)
GAPS = (1, 2, 3, 5)
BINS = {  # edges
    "speed, m/s": (0.0, 3.0, 8.0, 15.0, np.inf),
    "turn rate, deg/s": (0.0, 2.0, 5.0, 15.0, np.inf),
    "overlap": (0.0, 0.5, 0.6, 0.7, 0.8, 1.01),
}
NEAR_M = 1.0
FRAME_S = 1e-9 * FRAME_PERIOD_NS


def solve(name: str, models: list[Model], folder: Path, count: int, seed: int, bar: Progress) -> list[Pairs]:
    """The pairs of some worlds by each of the networks."""
    found = []
    for number, model in enumerate(models):
        task = bar.add_task(f"{name} worlds" + (f", member {number}" if number else ""), total=count)
        found.append(stored_pairs(folder, name, model, count, seed, on_world=functools.partial(bar.advance, task)))
        print(
            f"{name} worlds: {len(found[-1].errors)} pairs, {found[-1].lost(model).sum()} lost" + (f" by member {number}" if number else "")
        )
    return found


def show(title: str, pairs: Pairs, by_method: dict[str, Said], more: dict[str, dict[str, str]] | None = None) -> None:
    """Likelihood, consistency, sharpness, sparsification, more columns by name and method; then coverage."""
    more = more or {}
    print(f"\n## {title}: {len(pairs.errors)} pairs\n")
    names = ("nats", "squared / expected", "sigma: mrad", "sigma: cm", "AUSE rotation", "AUSE translation", *more)
    print(f"| covariance | {' | '.join(names)} |\n|---|{'---:|' * len(names)}")
    for name, said in by_method.items():
        C = said.covariances
        sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
        sharpness = 1e3 * np.median(sigma[:, :3]), 100 * np.median(sigma[:, 3:])
        ause = (f"{value:.3f}" for value in sparsifications(pairs.errors, C))
        likelihood, squared = said.nats(pairs.errors).mean(), nees(pairs.errors, C).mean() / 6
        numbers = (f"{value:.2f}" for value in (likelihood, squared, *sharpness))
        print(f"| {name} | {' | '.join((*numbers, *ause, *(column[name] for column in more.values())))} |")
    constant = sparsifications(pairs.errors, np.broadcast_to(np.eye(6), (len(pairs.errors), 6, 6)))
    print(f"| constant | | | | | {constant[0]:.3f} | {constant[1]:.3f} |{' |' * len(more)}")
    print(f"\n| covariance | level | {' | '.join(AXES)} |\n|---|---:|{'---:|' * 6}")
    for name, said in by_method.items():
        for level in LEVELS:
            cells = " | ".join(f"{100 * share:.1f}" for share in coverage(pairs.errors, said.stretched(level), level))
            print(f"| {name} | {100 * level:.0f} % | {cells} |")


def detection(solved: Solved, found: dict[str, Method]) -> dict[str, str]:
    """Area under the ROC curve of each method's sigmas, for pairs that are off; all pairs count."""
    sizes = np.stack([np.linalg.norm(solved.pairs.errors[:, part], axis=1) for part in (slice(0, 3), slice(3, 6))], axis=1)
    off = np.any(sizes > LIMITS[[0, 3]], axis=1)
    print(f"{off.sum()} of {len(off)} unseen pairs are off by more than {LIMITS[3]:g} m or {np.degrees(LIMITS[0]):.0f} deg")
    return {name: f"{auroc(method(solved).sizes(), off):.3f}" for name, method in found.items()}


def conditions(model: Model, folder: Path, count: int, bar: Progress) -> dict[str, np.ndarray]:
    """What the bins are about, of every pair of every unseen world, from the truth."""
    rows, cfg = [], model.cfg.preprocess
    for index in bar.track(range(count), description="overlap"):
        world = stored_world(folder, "unseen", index, UNSEEN_SEED, num_frames=NUM_FRAMES, cfg=cfg)
        clouds = [scan.points[scan.mask] for scan in (scan_of(world, frame, cfg) for frame in range(NUM_FRAMES))]
        trees = [cKDTree(cloud) for cloud in clouds]
        for source, target in FRAMES:
            T = relative(world.Ts_world_lidar, source, target)
            elapsed_s = FRAME_S * abs(target - source)
            distances, _ = trees[target].query(clouds[source] @ T[:3, :3].T + T[:3, 3], distance_upper_bound=NEAR_M)
            turn_deg = np.degrees(se3.rotation_angle(T[:3, :3]))
            rows.append((np.linalg.norm(T[:3, 3]) / elapsed_s, turn_deg / elapsed_s, np.isfinite(distances).mean()))
    return dict(zip(BINS, np.array(rows).T, strict=True))


def show_bins(pairs: Pairs, values: dict[str, np.ndarray], C: np.ndarray) -> None:
    """Consistency and coverage at 68 % of the default by bin."""
    print(f"\n## {FULL} by speed, turn rate and overlap\n")
    print(f"| of | from | to | pairs | squared / expected | {' | '.join(f'{axis}: 68 %' for axis in AXES)} |")
    print(f"|---|---:|---:|---:|---:|{'---:|' * 6}")
    sigma, squared = np.sqrt(np.diagonal(C, axis1=1, axis2=2)), nees(pairs.errors, C) / 6
    for name, edges in BINS.items():
        for low, high in zip(edges[:-1], edges[1:], strict=True):
            inside = (values[name] >= low) & (values[name] < high)
            if inside.any():
                cells = " | ".join(f"{100 * share:.0f}" for share in coverage(pairs.errors[inside], sigma[inside], 0.68))
                print(
                    f"| {name} | {low:g} | {min(high, values[name].max()):.3g} | {inside.sum()} | {squared[inside].mean():.2f} | {cells} |"
                )


def in_a_row(model: Model, drives: list[Drive], bar: Progress) -> Pairs:
    """Pairs of each two scans that follow each other, source the later one, de-skewed by their own motion where points carry times."""
    rows = []
    for number, drive in enumerate(drives):
        last = prepared_sweep(model, drive.sweeps[0])
        for k in bar.track(range(1, len(drive.sweeps)), description=f"{drive.name}: pairs"):
            frame = prepared_sweep(model, drive.sweeps[k])
            source, target = deskewed(model, frame, last, drive.sweeps[k - 1].stamp_ns - drive.sweeps[k].stamp_ns)
            row = solved_pair(model, source.encoding, target.encoding, relative(drive.Ts_world_lidar, k, k - 1))
            rows.append(row._replace(worlds=np.array(number)))
            last = frame
    return joined(rows)


def show_drives(title: str, models: list[Model], drives: list[Drive], found: dict[str, Method], noise: np.ndarray, bar: Progress) -> None:
    """The table of pairs in a row, noise of the truth (6,) added over one frame; ends where a pair is lost."""
    pairs, *others = [in_a_row(model, drives, bar) for model in models]
    lost = pairs.lost(models[0])
    if lost.any():
        print(f"\n{title}: {lost.sum()} of {len(lost)} pairs are lost and in no row")
    solved, columns = Solved(pairs, tuple(others)).rows(np.flatnonzero(~lost)), {}
    good = solved.pairs
    pieces = good._replace(worlds=(np.cumsum(lost) * (1 + pairs.worlds.max()) + pairs.worlds)[~lost])
    said = {name: method(solved) for name, method in found.items()}
    for num in STEPS:
        by_method = {name: over_frames(pieces, one.covariances, num) for name, one in said.items()}
        if len(by_method[FULL][0]):
            columns[f"{num} frames: squared / expected"] = {name: f"{nees(*both).mean() / 6:.2f}" for name, both in by_method.items()}
    sigma = np.tile(noise, (len(good.errors), 1))
    show(title, good, {name: one.plus(sigma) for name, one in said.items()}, columns)


def draw(folder: Path, pairs: Pairs, said: Said) -> None:
    """Reliability diagram, and errors over sigma."""
    sigma = np.sqrt(np.diagonal(said.covariances, axis1=1, axis2=2))
    levels = np.linspace(0.05, 0.95, 19)
    title = f"Unseen worlds, {len(pairs.errors)} pairs"
    observed = {float(level): coverage(pairs.errors, sigma, float(level)) for level in (*levels, 0.99)}
    reliability_figure(folder / "reliability.png", observed, AXES, title=title)
    printed = 1.0 / UNITS
    error_figure(folder / "errors.png", printed * pairs.errors, printed * sigma, AXES, ("mrad",) * 3 + ("cm",) * 3, title=title)


def judge(pairs: Pairs, C: np.ndarray) -> list[Row]:
    """Bounds of the default."""
    sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    rows = []
    for level in BOUNDED_LEVELS:
        shares = 100 * coverage(pairs.errors, sigma, level)
        for axis, share in zip(AXES, shares, strict=True):
            rows.append(Row(f"{axis}: coverage at {100 * level:.0f} %, off by", abs(float(share) - 100 * level), "points", POINTS))
    squared = float(nees(pairs.errors, C).mean()) / 6
    rows += [Row("error squared / expected", squared, "", NEES_RANGE[1]), Row("the same", squared, "", NEES_RANGE[0], True)]
    constant = sparsifications(pairs.errors, np.broadcast_to(np.eye(6), C.shape))
    for what, ours, level in zip(("rotation", "translation"), sparsifications(pairs.errors, C), constant, strict=True):
        rows.append(Row(f"{what}: AUSE / that of a constant variance", ours / level, "", 1.0))
    return rows


def main(argv: list[str] | None = None) -> int:
    """Solve, fit, print, draw, judge."""
    parser = _harness.parser(__doc__, needs_data=False)
    parser.add_argument("--weights", default="delo-base", help="name or file, calibrated")
    parser.add_argument("--out", type=Path, default=Path("runs/calibrated"), help="folder of `delo calibrate`, for worlds and figures")
    parser.add_argument("--members", type=int, default=NUM_MEMBERS, help="networks of an ensemble; 0: none is trained")
    parser.add_argument("--data", type=Path, help="tree of real sequences, for --drives")
    parser.add_argument("--drives", nargs="*", default=[], help="recorded ones, printed beside the simulated")
    args = parser.parse_args(argv)
    if args.drives and args.data is None:
        raise ConfigError("--data: expected the tree of the recorded drives, got none; name it, or leave --drives out")
    model, folder = delo_jax.load(args.weights), args.out / "worlds"
    num_unseen, num_fitted = (NUM_QUICK, NUM_QUICK) if args.quick else (NUM_UNSEEN, NUM_FITTED)
    with _harness.progress() as bar:
        members = trained(model, args.members, args.out / "members", bar, QUICK if args.quick else Budget())
        (seen,) = solve("calibration", [model], folder, num_fitted, CALIBRATION_SEED, bar)
        by_members, everything = (
            Solved(rows[0], tuple(rows[1:]))
            for rows in (
                solve("calibration", [model, *members], folder, min(num_fitted, NUM_MEMBERS_FITTED), CALIBRATION_SEED, bar),
                solve("unseen", [model, *members], folder, num_unseen, UNSEEN_SEED, bar),
            )
        )
    found = methods(model, seen, members, by_members)
    kept = np.flatnonzero(~everything.pairs.lost(model))
    unseen = everything.pairs.rows(kept)
    said = {name: method(everything.rows(kept)) for name, method in found.items()}
    show("Unseen worlds", unseen, said, {"AUROC": detection(everything, found)})
    for gap in GAPS:
        which = np.flatnonzero(np.abs(unseen.gaps) == gap)
        show(f"Gap {gap}", unseen.rows(which), {name: one.rows(which) for name, one in said.items() if name in ("evidence", FULL)})
    with _harness.progress() as bar:
        values = {name: array[kept] for name, array in conditions(model, folder, num_unseen, bar).items()}
        show_bins(unseen, values, said[FULL].covariances)
        num_drives, num_scans = (1, NUM_QUICK_SCANS) if args.quick else (NUM_DRIVES, NUM_SCANS)
        names = [(f"unseen drive {k}, {KINDS[k % len(KINDS)]}", DRIVE_SEED + k) for k in range(num_drives)]
        drives = [simulated(name, seed, num_scans, bar) for name, seed in names]
        show_drives("Unseen drives, pair after pair", [model, *members], drives, found, np.zeros(6), bar)
        for name in args.drives:
            drive = recorded(args.data, name, num_scans if args.quick else None, bar)
            print(f"\n{noise_header()}")
            noise = truth_noise(drive, (1,), bar)[1].robust
            show_drives(f"{name}, pair after pair", [model, *members], [drive], found, noise, bar)
    draw(args.out, unseen, said[FULL])
    rows = judge(unseen, said[FULL].covariances)
    return _harness.finish(rows, {"weights": args.weights, "unseen": num_unseen, "fitted": num_fitted, "drives": args.drives}, args)


if __name__ == "__main__":
    _harness.run(main)
