"""The preset `paper`, `official` or `dcp`, trained on simulation at the largest size that fits the machine, beside doing nothing and ours.

The network of the paper with all its parts (edge convolutions, transformer, exact partial transport with m = 0.1 and xi = 5,
Procrustes on the plan, joint evidence), narrowed so that two cores train it in an hour, then tested at frame gaps 1 and
3 on worlds that no training has seen: beside the identity, the mean motion of the training worlds, `delo-base`, and what
limits any plan between so few points: Procrustes on averages of the target points around each point's true place. The
learning curve is printed and drawn. With an accelerator, `--width 512` is the paper's size. By the same steps, for
`benchmark.py`: `--preset official`, DELO as its code was released, and `--preset dcp`, Deep Closest Point: a softmax in place of the
transport, absolute edges, no evidence.

Run:     python experiments/paper_preset.py [--preset official|dcp] [--out DIR]     (about 70 minutes on 2 cores; resumes)
Expect:  paper's medians at gaps 1 and 3 at least 30 % below the better of identity and mean motion, translation and rotation each.
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
from delo_jax.geometry.procrustes import weighted_procrustes
from delo_jax.metrics.registration import pose_errors
from delo_jax.model import delo
from delo_jax.train import loop
from delo_jax.train.presets import PRESETS
from delo_jax.train.worlds import World

TEST_SEED = 2_500_000  # training and validation worlds of any run begin at whole millions
GAPS = (1, 3)
GAIN = 0.7  # of the better of identity and mean motion
BLURS_M = (0.7, 1.5)  # widths of plans that know the truth


@dataclasses.dataclass(frozen=True)
class Settings:
    """What differs from the paper's recipe, so that two cores can train it."""

    preset: str = "paper"
    width: int = 64  # D; the paper's 512
    num_points: int = 1024  # N, as in the paper
    max_range_m: float = 30.0  # in the last steps and the test; the paper crops nothing
    num_steps: int = 5000  # with half of the points
    num_last_steps: int = 600  # with all of them; 1,800 end as far off in rotation and 3 cm nearer
    batch_size: int = 4  # the paper's 16
    learning_rate: float = 2e-3  # cosine with gradients clipped at 1, in the last steps a quarter; the paper's 1e-4, constant
    max_gap: int = 3  # frames between the scans of a training pair; the released code's 5
    num_scenes: int = 380
    num_test_worlds: int = 100


NAMES = {"paper": "delo-paper", "official": "delo-official", "dcp": "dcp"}  # of the weights
TRAINED = "this network"
QUICK = Settings(width=32, num_points=64, num_steps=20, num_last_steps=10, batch_size=2, num_scenes=4, num_test_worlds=2)


def training_config(settings: Settings) -> TrainConfig:
    """The preset with its own losses, at another size."""
    cfg, size = PRESETS[settings.preset], settings.width
    model = replace(
        cfg.model,
        encoder=replace(cfg.model.encoder, width=size // 8, embedding_dim=size),
        attention=replace(cfg.model.attention, hidden=2 * size),
    )
    cfg = replace(
        cfg,
        model=with_points(model, settings.num_points),
        num_epochs=0,
        num_steps=settings.num_steps,
        batch_size=settings.batch_size,
        learning_rate=settings.learning_rate,
        max_gap=settings.max_gap,
        schedule="cosine",
        clip_norm=1.0,
        num_scenes=settings.num_scenes,
    )
    return replace(cfg, validate_every=max(cfg.num_steps // 10, 10))


def with_points(model: DeloConfig, num_points: int, max_range_m: float | None = None) -> DeloConfig:
    """The same network for scans of another size, and of another range."""
    cfg = replace(model.preprocess, max_points=num_points, num_keypoints=num_points)
    return replace(model, preprocess=cfg if max_range_m is None else replace(cfg, max_range_m=max_range_m))


def stages(settings: Settings) -> list[TrainConfig]:
    """Half of the points, led by the scores' cross-entropy against the true matches; then all of those in reach.

    By the paper's losses alone the plan stays soft for thousands of steps, and poses tend to the mean motion. Beyond 30 m
    neighbours are several metres apart; what is matched there turns the pose.
    """
    cfg = replace(training_config(settings), matching_weight=1.0, matching_loss="scores")
    first = own_losses(replace(cfg, model=with_points(cfg.model, settings.num_points // 2)), 0.05)
    num_last = settings.num_last_steps
    last = replace(cfg, num_steps=num_last, validate_every=max(num_last // 3, 10), learning_rate=cfg.learning_rate / 4)
    near = with_points(cfg.model, settings.num_points, settings.max_range_m)
    return [first, own_losses(replace(last, model=near), 0.5)]


def own_losses(cfg: TrainConfig, weight: float) -> TrainConfig:
    """With a weight on the preset's own losses, of pose and evidence."""
    return replace(cfg, odometry_weight=weight * cfg.odometry_weight, evidence_weight=weight * cfg.evidence_weight)


def in_range(world: World, max_range_m: float) -> World:
    """A stored world of raw scans without what is out of range; its points, in random order, stay an even subset."""
    points, mask = world.scans.points, world.scans.mask
    keep = mask & (np.linalg.norm(points, axis=2) < max_range_m)
    order = np.argsort(~keep, axis=1, kind="stable")
    points, mask = np.take_along_axis(points, order[:, :, None], axis=1), np.take_along_axis(keep, order, axis=1)
    points = np.where(mask[:, :, None], points, np.float32(0.0))
    return world._replace(scans=world.scans._replace(points=points, mask=mask, keypoint_mask=mask))


def train(settings: Settings, folder: Path, out: Path, bar) -> tuple[delo.Model, list[World], dict[int, list[dict]], int]:
    """Model, training worlds, validations by step, and the number of steps left out; goes on where it was interrupted."""
    runs = stages(settings)
    model = delo.init(runs[0].model, jax.random.key(runs[0].seed))
    stored = loop.load_worlds(training_config(settings), folder, _harness.BarReporter(bar), None)
    curve: dict[int, list[dict]] = {}
    num_steps = num_nonfinite = 0
    for cfg in runs:
        training, held_out = ([in_range(world, cfg.model.preprocess.max_range_m) for world in found] for found in stored)
        name = f"{cfg.model.preprocess.max_points} points"
        part = out / name.replace(" ", "_")
        reporter = _harness.BarReporter(bar, name, curve=part / "curve.json")
        model, skipped = loop.fit(cfg, training, held_out, delo.Model(model.variables, cfg.model), part, reporter)
        curve |= {num_steps + step: errors for step, errors in reporter.validations.items()}
        num_steps, num_nonfinite = num_steps + cfg.num_steps, num_nonfinite + skipped
    return model, stored[0], curve, num_nonfinite


def mean_motion(worlds: list[World], gap: int) -> np.ndarray:
    """Mean T_target_source of the training worlds at a gap, source first."""
    motions = [se3.inverse(world.Ts_world_lidar[gap:]) @ world.Ts_world_lidar[:-gap] for world in worlds]
    return se3.exp(np.mean(se3.log(np.concatenate(motions)), axis=0))


def test_pairs(models: dict[str, delo.Model], num_worlds: int, bar) -> tuple[dict, dict]:
    """Estimates of each model, and the truth, by gap: all pairs (k, k + gap) of six-frame clips, source first."""
    estimates: dict = {name: {gap: [] for gap in GAPS} for name in (*models, *map(blurred, BLURS_M))}
    true: dict = {gap: [] for gap in GAPS}
    for gap, T_true, encodings in _pairs.encoded_pairs(models, TEST_SEED, num_worlds, GAPS, bar):
        true[gap].append(T_true)
        for name, ends in encodings.items():
            answer = inference.solve(models[name], *ends, jnp.eye(4))
            estimates[name][gap].append(np.asarray(answer.T_target_source, np.float64))
        source, target = encodings[TRAINED]
        for width_m in BLURS_M:
            estimates[blurred(width_m)][gap].append(blurred_truth(source, target, T_true, width_m))
    return estimates, true


def blurred(width_m: float) -> str:
    """Name in the table."""
    return f"true places blurred by {width_m:g} m"


def blurred_truth(source: delo.Encoding, target: delo.Encoding, T_true: np.ndarray, width_m: float) -> np.ndarray:
    """Procrustes on the paper's points with matches that know the truth: Gaussian means of target points around the true places."""
    points, targets = (np.asarray(scan.keypoints, np.float64)[np.asarray(scan.keypoint_mask)] for scan in (source, target))
    squared = np.sum((se3.transform(T_true, points)[:, None] - targets[None]) ** 2, axis=2)
    near = squared.min(axis=1) < (3 * width_m) ** 2
    plan = np.exp(-0.5 * squared[near] / width_m**2)
    matched = plan @ targets / plan.sum(axis=1, keepdims=True)
    pose = weighted_procrustes(*(jnp.asarray(a, jnp.float32) for a in (points[near], matched, np.ones(near.sum()))))
    return np.asarray(pose, np.float64)


def median_with_interval(values: np.ndarray) -> tuple[float, str]:
    """Median and its 95 % bootstrap interval."""
    rng = np.random.default_rng(0)
    draws = np.median(rng.choice(values, (1000, len(values))), axis=1)
    median = float(np.median(values))
    return median, f"{median:.3g} [{np.percentile(draws, 2.5):.3g}, {np.percentile(draws, 97.5):.3g}]"


def compare(estimates: dict, true: dict, preset: str) -> list[Row]:
    """Print the table of methods and gaps; the bounds, which are those of the paper's network."""
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
            limit = GAIN * better if preset == "paper" else None
            rows.append(Row(f"{preset} preset, gap {gap}, median", medians[TRAINED, gap][number], unit, limit))
    return rows


def learning_curve(validations: dict[int, list[dict]], num_first: int, file: Path) -> None:
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
        axes.axvline(num_first, color="gray", linestyle=":", label="all points from here")
        axes.set(xlabel="steps", ylabel=f"median error [{unit}]", ylim=(0, None))
        axes.legend()
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=120)
    print(f"\nfigure: {file}")


def main(argv: list[str] | None = None) -> int:
    """Train, test, judge."""
    parser = _harness.parser(__doc__, needs_data=False)
    parser.add_argument("--preset", choices=tuple(NAMES), default="paper", help="official: the released code; dcp: softmax in its place")
    parser.add_argument("--out", type=Path, help="worlds, checkpoints and weights, by default runs/NAME-preset; an interrupted run goes on")
    parser.add_argument("--width", type=int, default=Settings.width, help="D, a multiple of 32")
    parser.add_argument("--points", type=int, default=Settings.num_points, help="N")
    args = parser.parse_args(argv)
    settings = QUICK if args.quick else Settings(width=args.width, num_points=args.points)
    settings = replace(settings, preset=args.preset)
    folder = args.out or Path(f"runs/{args.preset}-preset")
    out = folder / "quick" if args.quick else folder
    name = NAMES[args.preset]
    with _harness.progress() as bar:
        model, training, curve, num_nonfinite = train(settings, folder / "worlds", out, bar)
        weights.save(out / name, model, {"name": name, "training": dataclasses.asdict(settings)})
        ours = delo_jax.load("delo-base")
        estimates, true = test_pairs({TRAINED: model, "delo-base": ours}, settings.num_test_worlds, bar)
    constant = {
        "identity": {gap: [np.eye(4)] * len(true[gap]) for gap in GAPS},
        "mean motion": {gap: [mean_motion(training, gap)] * len(true[gap]) for gap in GAPS},
    }
    print(f"{args.preset} preset with D = {settings.width}, N = {settings.num_points}: {describe(model.cfg)}")
    learning_curve(curve, settings.num_steps, out / "learning_curve.png")
    rows = compare(constant | estimates, true, args.preset)
    rows.append(Row("training steps left out as not finite", float(num_nonfinite), "", 0.0))
    return _harness.finish(rows, dataclasses.asdict(settings), args)


def describe(cfg: DeloConfig) -> str:
    """Plan, solver and head, in words."""
    matching = cfg.matching
    plan = f"softmax of {matching.scores} scores"
    if matching.plan != "softmax":
        plan = f"{matching.plan} with m = {matching.mass:g}, xi = {matching.num_iters}"
    return f"{plan}, {cfg.pose.solver}, evidence from {cfg.evidence.head}"


if __name__ == "__main__":
    _harness.run(main)
