"""The gate's thresholds, read off the error by confidence, and what is doubted by frame gap: figures 6 and 7 of the paper.

- Pairs of simulated worlds of `delo calibrate`: root mean square of each axis over the pairs whose confidence is above a cut-off.
  theta_min is the first cut-off by which the error, mean over the axes relative to that of all pairs, has fallen half of the way to its
  least; theta_max is where it is least: pairs that are more confident are not better, they are over-confident. Where it falls up to the
  last cut-off there are none, and theta_max is 1. `RefineConfig` has the thresholds that this prints. Beside it the curve of unseen worlds.
- Simulated drives: epistemic standard deviations at gaps 1, 2 and 200, where nothing is seen twice: they must rise with the gap.

Run:     python experiments/gate.py                        (about 10 minutes on 2 cores; worlds are kept in runs/)
Expect:  all bounds kept; pictures in runs/calibrated.
"""

import functools
from pathlib import Path
from typing import NamedTuple

import _harness
import jax
import jax.numpy as jnp
import numpy as np
from _harness import Row
from rich.progress import Progress

import delo_jax
from delo_jax import inference
from delo_jax.config import RefineConfig
from delo_jax.errors import WeightsError
from delo_jax.model.delo import Model
from delo_jax.report.calibration import cutoff_figure, gap_figure
from delo_jax.sim import simulate_drive
from delo_jax.train.calibrate import Pairs, doubts, halves, stored_pairs
from delo_jax.train.worlds import CALIBRATION_SEED
from delo_jax.uncertainty import gate
from delo_jax.uncertainty.observability import AXES

UNSEEN_SEED, DRIVE_SEED = 1_600_000, 730_000
NUM_WORLDS, NUM_QUICK = 100, 3
CUTOFFS = np.arange(0.0, 1.0, 0.05)
GAPS, FAR, NUM_STARTS = (1, 2), 200, 15
KINDS = ("urban", "mixed", "open")
HALF = 0.5


class Judged(NamedTuple):
    """Pairs that are not lost."""

    confidences: np.ndarray  # (n,)
    errors: np.ndarray  # (n, 6)
    gaps: np.ndarray  # (n,)


class Thresholds(NamedTuple):
    """Of the gate."""

    theta_min: float
    theta_max: float


def judged(model: Model, pairs: Pairs, quantiles: gate.Quantiles) -> Judged:
    """Confidence of each pair, by the calibrated covariance."""
    pairs = pairs.rows(np.flatnonzero(~pairs.lost(model)))
    weights = model.variables["covariance"]
    epistemic = doubts(model, weights, pairs)[:, None] * np.sum(halves(model, weights, pairs) ** 2, axis=2)
    confidences = np.array([gate.confidence(one, quantiles) for one in epistemic])
    return Judged(confidences, pairs.errors, np.abs(pairs.gaps))


def curve(pairs: Judged) -> np.ndarray:
    """(c, 6) root mean square errors of the pairs above each cut-off."""
    kept = [pairs.errors[pairs.confidences >= cutoff] for cutoff in CUTOFFS]
    return np.stack([np.sqrt(np.mean(errors**2, axis=0)) if len(errors) else np.full(6, np.nan) for errors in kept])


def thresholds(pairs: Judged) -> Thresholds:
    """Read off the curve."""
    relative = np.mean(curve(pairs) / curve(pairs)[0], axis=1)
    least = int(np.nanargmin(relative))
    first = int(np.argmax(relative <= 1.0 - HALF * (1.0 - relative[least])))
    return Thresholds(float(CUTOFFS[first]), 1.0 if least == len(CUTOFFS) - 1 else float(CUTOFFS[least]))


def show(title: str, pairs: Judged) -> None:
    """The curve."""
    print(f"\n## {title}: {len(pairs.errors)} pairs\n")
    print(f"| confidence at least | pairs | {' | '.join(f'{axis} {unit}' for axis, unit in zip(AXES, UNITS, strict=True))} |")
    print(f"|---:|{'---:|' * 7}")
    for cutoff, row in zip(CUTOFFS, curve(pairs), strict=True):
        cells = " | ".join(f"{value:.2f}" for value in row * SCALES)
        print(f"| {cutoff:.2f} | {np.sum(pairs.confidences >= cutoff)} | {cells} |")


UNITS, SCALES = ("mrad",) * 3 + ("cm",) * 3, np.repeat([1e3, 1e2], 3)


def by_gap(model: Model, seed: int, kind: str, bar: Progress) -> dict[int, list[np.ndarray]]:
    """Epistemic standard deviations (6,) of pairs of a drive, from the identity, by the calibrated covariance whatever its status."""
    keep = {*range(NUM_STARTS + max(GAPS)), *range(FAR, FAR + NUM_STARTS)}
    task, encodings = bar.add_task(f"{kind} drive", total=FAR + NUM_STARTS), {}
    for number, scan in enumerate(simulate_drive(kind, seed, FAR + NUM_STARTS, rolling_shutter=True)):
        if number in keep:
            encodings[number] = inference.prepare(model, scan.points).encoding
        bar.advance(task)
    found: dict[int, list[np.ndarray]] = {gap: [] for gap in (*GAPS, FAR)}
    for gap, start in ((gap, start) for gap in found for start in range(NUM_STARTS)):
        result = inference.solve(model, encodings[start], encodings[start + gap], jnp.eye(4))
        result, (half, doubt) = jax.device_get((result, inference.pair_covariance(model, result)))
        if result.finite:
            found[gap].append(np.sqrt(float(doubt) * np.sum(np.asarray(half, np.float64) ** 2, axis=1)))
    return found


def main(argv: list[str] | None = None) -> int:
    """Curves, thresholds, pictures."""
    parser = _harness.parser(__doc__, needs_data=False)
    parser.add_argument("--weights", default="delo-base", help="name or file, calibrated")
    parser.add_argument("--out", type=Path, default=Path("runs/calibrated"), help="folder of `delo calibrate`, for worlds; pictures too")
    args = parser.parse_args(argv)
    model = delo_jax.load(args.weights)
    quantiles = gate.Quantiles.of(model.variables)
    if quantiles is None:
        raise WeightsError(f"{args.weights}: expected calibrated weights, got none with quantiles of held-out pairs; see delo calibrate")
    count = NUM_QUICK if args.quick else NUM_WORLDS
    found = {}
    with _harness.progress() as bar:
        for name, kind, seed in (("Worlds of the calibration", "calibration", CALIBRATION_SEED), ("Unseen worlds", "unseen", UNSEEN_SEED)):
            step = functools.partial(bar.advance, bar.add_task(name, total=count))
            found[name] = judged(model, stored_pairs(args.out / "worlds", kind, model, count, seed, on_world=step), quantiles)
            show(name, found[name])
        drives = [by_gap(model, DRIVE_SEED + k, kind, bar) for k, kind in enumerate(KINDS[:1] if args.quick else KINDS)]
    fitted, unseen = found.values()
    theta, other = thresholds(fitted), thresholds(unseen)
    print(
        f"\ntheta_min {theta.theta_min:.2f}, theta_max {theta.theta_max:.2f}; on unseen worlds {other.theta_min:.2f}, {other.theta_max:.2f}"
    )
    sigmas = {gap: np.stack([one for drive in drives for one in drive[gap]]) for gap in (*GAPS, FAR)}
    print(f"\n## Median epistemic standard deviation by gap\n\n| gap | pairs | {' | '.join(AXES)} |\n|---:|---:|{'---:|' * 6}")
    for gap, one in sigmas.items():
        cells = " | ".join(f"{value:.2f}" for value in np.median(one, axis=0) * SCALES)
        print(f"| {gap} | {len(one)} | {cells} |")
    curves = {f"gap {gap}": curve(Judged(*(array[unseen.gaps == gap] for array in unseen))) * SCALES for gap in GAPS}
    cutoff_figure(args.out / "rmse_by_confidence.png", CUTOFFS, curves, AXES, UNITS, thresholds=theta, title="Unseen worlds")
    gap_figure(args.out / "doubt_by_gap.png", {gap: one * SCALES for gap, one in sigmas.items()}, AXES, UNITS, title="Simulated drives")
    default, top = RefineConfig(), curve(unseen)
    half = np.mean(top[np.searchsorted(CUTOFFS, 0.5)] / top[0])
    rise = min(float(np.median(sigmas[FAR][:, axis]) / np.median(sigmas[GAPS[0]][:, axis])) for axis in range(6))
    rows = [
        Row("theta_min of the default off by", abs(default.theta_min - theta.theta_min), "", 0.051),
        Row("theta_max of the default off by", abs(default.theta_max - theta.theta_max), "", 0.051),
        Row("unseen: error of the more confident half / of all, mean over the axes", float(half), "", 1.0),
        Row("doubt at gap 200 / at gap 1, least axis", rise, "times", 1.5, True),
    ]
    return _harness.finish(rows, {"weights": args.weights, "worlds": count}, args)


if __name__ == "__main__":
    _harness.run(main)
