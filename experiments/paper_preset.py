"""The `paper` preset, trained on simulation at the largest size that fits the machine, against doing nothing, and against ours.

The network of the paper with all its parts (edge convolutions, transformer, exact partial transport with m = 0.1 and xi = 5,
Procrustes on the plan, joint evidence), narrowed so that two cores train it in about an hour, then tested at frame gaps 1 and
3 on worlds that no training has seen: beside the identity, the mean motion of the training worlds, and `delo-base`. The
learning curve is printed and drawn. With an accelerator, `--width 512 --points 1024` is the paper's size.

Run:     python experiments/paper_preset.py [--out DIR]     (about 70 minutes on 2 cores; resumes)
Expect:  medians at gaps 1 and 3 at least 30 % below the better of identity and mean motion, translation and rotation each.
"""

import dataclasses
from dataclasses import replace
from pathlib import Path

import _harness
import _pairs
import jax
import jax.numpy as jnp
import numpy as np
from _harness import Row
from _plans import LOST_DEG, LOST_M
from matplotlib.figure import Figure

import delo_jax
from delo_jax import inference, weights
from delo_jax.config import DeloConfig, TrainConfig
from delo_jax.geometry import se3
from delo_jax.metrics.registration import pose_errors
from delo_jax.model import delo
from delo_jax.train import loop
from delo_jax.train.presets import PRESETS
from delo_jax.train.worlds import World

TEST_SEED = 2_500_000  # training and validation worlds of any run begin at whole millions
GAPS = (1, 3)
GAIN = 0.7  # of the better of identity and mean motion


@dataclasses.dataclass(frozen=True)
class Settings:
    """What differs from the paper's recipe, so that two cores can train it."""

    width: int = 64  # D; the paper's 512
    num_points: int = 512  # N; the paper's 1024
    num_steps: int = 3000
    batch_size: int = 8  # the paper's 16
    learning_rate: float = 2e-3  # cosine with gradients clipped at 1; the paper's 1e-4, constant
    max_gap: int = 3  # frames between the scans of a training pair; the released code's 5
    num_scenes: int = 380
    num_test_worlds: int = 100


QUICK = Settings(width=32, num_points=64, num_steps=20, batch_size=2, num_scenes=4, num_test_worlds=2)


def training_config(settings: Settings) -> TrainConfig:
    """The preset `paper` at another size."""
    cfg, size = PRESETS["paper"], settings.width
    model = replace(
        cfg.model,
        encoder=replace(cfg.model.encoder, width=size // 8, embedding_dim=size),
        attention=replace(cfg.model.attention, hidden=2 * size),
        preprocess=replace(cfg.model.preprocess, max_points=settings.num_points, num_keypoints=settings.num_points),
    )
    return replace(
        cfg,
        model=model,
        num_epochs=0,
        num_steps=settings.num_steps,
        batch_size=settings.batch_size,
        learning_rate=settings.learning_rate,
        max_gap=settings.max_gap,
        schedule="cosine",
        clip_norm=1.0,
        num_scenes=settings.num_scenes,
        validate_every=max(settings.num_steps // 12, 10),
    )


def mean_motion(worlds: list[World], gap: int) -> np.ndarray:
    """Mean T_target_source of the training worlds at a gap, source first."""
    motions = [se3.inverse(world.Ts_world_lidar[gap:]) @ world.Ts_world_lidar[:-gap] for world in worlds]
    return se3.exp(np.mean(se3.log(np.concatenate(motions)), axis=0))


def test_pairs(models: dict[str, delo.Model], num_worlds: int, bar) -> tuple[dict, dict]:
    """Estimates of each model, and the truth, by gap: all pairs (k, k + gap) of six-frame clips, source first."""
    estimates: dict = {name: {gap: [] for gap in GAPS} for name in models}
    true: dict = {gap: [] for gap in GAPS}
    for gap, T_true, encodings in _pairs.encoded_pairs(models, TEST_SEED, num_worlds, GAPS, bar):
        true[gap].append(T_true)
        for name, ends in encodings.items():
            answer = inference.solve(models[name], *ends, jnp.eye(4))
            estimates[name][gap].append(np.asarray(answer.T_target_source, np.float64))
    return estimates, true


def median_with_interval(values: np.ndarray) -> tuple[float, str]:
    """Median and its 95 % bootstrap interval."""
    rng = np.random.default_rng(0)
    draws = np.median(rng.choice(values, (1000, len(values))), axis=1)
    median = float(np.median(values))
    return median, f"{median:.3g} [{np.percentile(draws, 2.5):.3g}, {np.percentile(draws, 97.5):.3g}]"


def compare(estimates: dict, true: dict) -> list[Row]:
    """Print the table of methods and gaps; the bounds."""
    print("\n| gap | pairs | method | median cm [95 %] | median deg [95 %] | lost % |\n|---:|---:|---|---:|---:|---:|")
    medians: dict = {}
    for gap in GAPS:
        for name, by_gap in estimates.items():
            errors = pose_errors(np.array(by_gap[gap]), np.array(true[gap]))
            degrees = np.degrees(errors.rotation_rad)
            lost = (errors.translation_m > LOST_M) | (degrees > LOST_DEG)
            cm, cm_text = median_with_interval(100 * errors.translation_m)
            deg, deg_text = median_with_interval(degrees)
            medians[name, gap] = cm, deg
            print(f"| {gap} | {len(lost)} | {name} | {cm_text} | {deg_text} | {100 * lost.mean():.1f} |")
    rows = []
    for gap in GAPS:
        for number, unit in enumerate(("cm", "deg")):
            better = min(medians[name, gap][number] for name in ("identity", "mean motion"))
            rows.append(Row(f"paper preset, gap {gap}, median", medians["paper", gap][number], unit, GAIN * better))
    return rows


def learning_curve(validations: dict[int, list[dict]], file: Path) -> None:
    """Median errors on the validation worlds by step: printed and drawn."""
    print("\n| steps | gap 1: cm | deg | gap 3: cm | deg |\n|---:|---:|---:|---:|---:|")
    curves = {gap: [next(row for row in errors if row["gap"] == gap) for errors in validations.values()] for gap in GAPS}
    for number, step in enumerate(validations):
        rows = [curves[gap][number] for gap in GAPS]
        print(f"| {step} | " + " | ".join(f"{row['median_cm']:.0f} | {row['median_deg']:.2f}" for row in rows) + " |")
    figure = Figure(figsize=(9, 3.5), layout="constrained")
    for axes, field, unit in zip(figure.subplots(1, 2), ("median_cm", "median_deg"), ("cm", "deg"), strict=True):
        for gap in GAPS:
            axes.plot(list(validations), [row[field] for row in curves[gap]], marker="o", label=f"gap {gap}")
        axes.set(xlabel="steps", ylabel=f"median error [{unit}]", ylim=(0, None))
        axes.legend()
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=120)
    print(f"\nfigure: {file}")


def main(argv: list[str] | None = None) -> int:
    """Train, test, judge."""
    parser = _harness.parser(__doc__, needs_data=False)
    parser.add_argument(
        "--out", type=Path, default=Path("runs/paper-preset"), help="worlds, checkpoints and weights; an interrupted run goes on"
    )
    parser.add_argument("--width", type=int, default=Settings.width, help="D, a multiple of 32")
    parser.add_argument("--points", type=int, default=Settings.num_points, help="N")
    parser.add_argument("--steps", type=int, default=Settings.num_steps, help="optimiser steps")
    args = parser.parse_args(argv)
    settings = QUICK if args.quick else Settings(width=args.width, num_points=args.points, num_steps=args.steps)
    cfg, out = training_config(settings), args.out / "quick" if args.quick else args.out
    with _harness.progress() as bar:
        reporter = _harness.BarReporter(bar, curve=out / "curve.json")
        training, held_out = loop.load_worlds(cfg, args.out / "worlds", reporter, None)
        model, num_nonfinite = loop.fit(cfg, training, held_out, delo.init(cfg.model, jax.random.key(cfg.seed)), out, reporter)
        weights.save(out / "delo-paper", model, {"name": "delo-paper", "training": dataclasses.asdict(settings)})
        ours = delo_jax.load("delo-base")
        estimates, true = test_pairs({"paper": model, "delo-base": ours}, settings.num_test_worlds, bar)
    constant = {
        "identity": {gap: [np.eye(4)] * len(true[gap]) for gap in GAPS},
        "mean motion": {gap: [mean_motion(training, gap)] * len(true[gap]) for gap in GAPS},
    }
    print(f"paper preset with D = {settings.width}, N = {settings.num_points}: {describe(cfg.model)}")
    learning_curve(reporter.validations, out / "learning_curve.png")
    rows = compare(constant | estimates, true)
    rows.append(Row("training steps left out as not finite", float(num_nonfinite), "", 0.0))
    return _harness.finish(rows, dataclasses.asdict(settings), args)


def describe(cfg: DeloConfig) -> str:
    """Plan, solver and head, in words."""
    matching = cfg.matching
    return f"{matching.plan} with m = {matching.mass:g}, xi = {matching.num_iters}, {cfg.pose.solver}, evidence from {cfg.evidence.head}"


if __name__ == "__main__":
    _harness.run(main)
