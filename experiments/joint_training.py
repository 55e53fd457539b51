"""Odometry and evidence learned together, as in the paper, or one after the other.

The `paper` preset, small, with the same worlds, seeds and steps: odometry alone; together, with the evidence loss as printed; together
with the weight that the released code gives it; and apart, the evidence head afterwards on the frozen network. Errors at gaps 1
and 3, and the negative log likelihood of the true pose6 under the predicted evidence, on worlds that no training has seen.

Run:     python experiments/joint_training.py [--out DIR]     (about 40 minutes on 2 cores; resumes)
Expect:  every run finite; printed side by side, with a figure of the learning curves.
"""

import dataclasses
from dataclasses import replace
from pathlib import Path
from typing import Any

import _harness
import jax
import jax.numpy as jnp
import numpy as np
import paper_preset
from _harness import Row
from matplotlib.figure import Figure

from delo_jax import weights
from delo_jax.config import TrainConfig
from delo_jax.geometry import se3
from delo_jax.model import delo
from delo_jax.ops import evidence
from delo_jax.train import loop
from delo_jax.train.worlds import World, scan_of

GAPS = (1, 3)
VARIANTS: dict[str, dict[str, Any]] = {
    "odometry alone": {"evidence_weight": 0.0},
    "together, weight as printed": {"evidence_weight": 1.0},
    "together, weight of the released code": {"evidence_weight": 2e-4, "translation_regulariser": 0.02},
    "evidence afterwards": {"evidence_weight": 1.0, "num_evidence_steps": 600},
}


@dataclasses.dataclass(frozen=True)
class Settings:
    """Sizes of the study."""

    size: paper_preset.Settings = paper_preset.Settings(width=64, num_points=256, num_steps=600, batch_size=8, num_scenes=200)
    seeds: tuple[int, ...] = (0, 1)


QUICK = Settings(size=paper_preset.QUICK, seeds=(0,))


def configs(settings: Settings) -> dict[tuple[str, int], TrainConfig]:
    """Runs by variant and seed."""
    base = replace(paper_preset.training_config(settings.size), validate_every=max(settings.size.num_steps // 6, 10))
    return {(name, seed): replace(base, seed=seed, **changes) for seed in settings.seeds for name, changes in VARIANTS.items()}


@jax.jit
def answer(model: delo.Model, source, target):
    """Pose and evidence of a pair."""
    solved = delo.solve(model, delo.encode(model, source), delo.encode(model, target), jnp.eye(4))
    return solved.T_target_source, solved.nig


def evaluate(model: delo.Model, worlds: list[World]) -> np.ndarray:
    """Rows of: gap, error [cm], error [deg], negative log likelihood per axis, share of axes within one predicted sigma."""
    rows = []
    for world in worlds:
        scans = [scan_of(world, frame, model.cfg.preprocess) for frame in range(len(world.Ts_world_lidar))]
        for gap in GAPS:
            for k in range(len(scans) - gap):
                T_true = se3.inverse(world.Ts_world_lidar[k + gap]) @ world.Ts_world_lidar[k]
                T, nig = answer(model, scans[k], scans[k + gap])
                error = se3.inverse(np.asarray(T, np.float64)) @ T_true
                observed = jnp.asarray(se3.pose6(T_true), jnp.float32)
                likelihood = float(jnp.mean(evidence.negative_log_likelihood(nig, observed)))
                variances = evidence.moments(nig)
                sigma = np.sqrt(np.asarray(variances.aleatoric + variances.epistemic))
                within = float(np.mean(np.abs(np.asarray(observed - nig.gamma)) < sigma))
                cm, deg = 100 * np.linalg.norm(error[:3, 3]), np.degrees(se3.rotation_angle(error[:3, :3]))
                rows.append([gap, cm, deg, likelihood, within])
    return np.array(rows)


def draw(curves: dict[str, list], file: Path) -> None:
    """Median error at gap 1 by step; a line per variant, seeds averaged."""
    figure = Figure(figsize=(10, 3.5), layout="constrained")
    for axes, field, unit in zip(figure.subplots(1, 2), ("median_cm", "median_deg"), ("cm", "deg"), strict=True):
        for name, of_seeds in curves.items():
            steps = list(of_seeds[0])
            values = [np.mean([next(r[field] for r in validations[step] if r["gap"] == 1) for validations in of_seeds]) for step in steps]
            same_at_first = name == "evidence afterwards"  # as odometry alone: drawn so that both are seen
            axes.plot(steps, values, marker="x" if same_at_first else "o", linestyle=":" if same_at_first else "-", label=name)
        axes.set(xlabel="steps", ylabel=f"median error at gap 1 [{unit}]", ylim=(0, None))
        axes.legend(fontsize=7)
    figure.savefig(file, dpi=120)
    print(f"\nfigure: {file}")


def main(argv: list[str] | None = None) -> int:
    """Train, measure, print."""
    parser = _harness.parser(__doc__, needs_data=False)
    parser.add_argument(
        "--out", type=Path, default=Path("runs/joint-training"), help="worlds, checkpoints and weights; an interrupted run goes on"
    )
    args = parser.parse_args(argv)
    settings = QUICK if args.quick else Settings()
    out = args.out / "quick" if args.quick else args.out
    results: dict[str, list] = {name: [] for name in VARIANTS}
    curves: dict[str, list] = {name: [] for name in VARIANTS}
    num_nonfinite = 0
    with _harness.progress() as bar:
        runs = configs(settings)
        stored = paper_preset.training_config(replace(settings.size, num_points=paper_preset.Settings.num_points))  # with a reserve
        training, held_out = loop.load_worlds(stored, args.out / "worlds", _harness.BarReporter(bar), None)
        for (name, seed), cfg in runs.items():
            folder = out / f"{name} {seed}".replace(" ", "_").replace(",", "")
            reporter = _harness.BarReporter(bar, f"{name}, seed {seed}", folder / "curve.json")
            model, skipped = loop.fit(cfg, training, held_out, delo.init(cfg.model, jax.random.key(seed)), folder, reporter)
            weights.save(folder / "model", model, {"name": name})
            num_nonfinite += skipped
            results[name].append(evaluate(model, held_out))
            curves[name].append(reporter.validations)
    print("| training | gap | median cm (per seed) | median deg (per seed) | NLL per axis (per seed) | within one sigma % (nominal 68) |")
    print("|---|---:|---|---|---|---|")
    for name, of_seeds in results.items():
        for gap in GAPS:
            rows = [values[values[:, 0] == gap] for values in of_seeds]
            cells = [" / ".join(f"{np.median(r[:, column]):{form}}" for r in rows) for column, form in ((1, ".0f"), (2, ".2f"))]
            evident = name != "odometry alone"
            cells.append(" / ".join(f"{r[:, 3].mean():.2f}" for r in rows) if evident else "no evidence learned")
            cells.append(" / ".join(f"{100 * r[:, 4].mean():.0f}" for r in rows) if evident else "")
            print(f"| {name} | {gap} | " + " | ".join(cells) + " |")
    draw(curves, out / "joint_training.png")
    finite = all(np.isfinite(values).all() for of_seeds in results.values() for values in of_seeds)
    rows = [Row("runs with a number that is not finite", float(not finite), "", 0.0)]
    rows.append(Row("training steps left out as not finite", float(num_nonfinite), "", 0.0))
    return _harness.finish(rows, dataclasses.asdict(settings), args)


if __name__ == "__main__":
    _harness.run(main)
