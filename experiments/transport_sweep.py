"""Mass m and iterations xi of the paper's transport (its Sec. 3.1), on the frozen features of the trained `paper` preset.

For every m and xi: errors of Procrustes on the plan, how uneven the row weights are (what selects points), how sharp the rows
are, and how far the marginals are from being kept after so few iterations. With uniform marginals m = 1 is a balanced plan: at
convergence every source point weighs the same, nothing is refused; small m with no cap active is the soft pointer of DCP.

Run:     python experiments/transport_sweep.py --weights runs/paper-preset/delo-paper.safetensors     (about 8 minutes on 2 cores)
Expect:  all bounds kept; the figure is written beside the weights.
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
from _plans import describe
from matplotlib.figure import Figure

import delo_jax
from delo_jax.geometry import se3
from delo_jax.model import delo

TEST_SEED = 2_500_000  # that of paper_preset.py
GAPS = (1, 3)


@dataclasses.dataclass(frozen=True)
class Settings:
    """Sizes of the sweep."""

    masses: tuple[float, ...] = (0.1, 0.5, 1.0)
    rounds: tuple[int, ...] = (1, 5, 20, 500)
    num_worlds: int = 10


QUICK = Settings(masses=(0.1, 1.0), rounds=(1, 5), num_worlds=2)


def features(model: delo.Model, num_worlds: int, bar) -> list:
    """(source, target, descriptors of both in context, T_target_source, gap) of all pairs of unseen clips."""
    in_context = jax.jit(lambda source, target: delo.match(model, source, target)[:2])
    found = []
    for gap, T, encodings in _pairs.encoded_pairs({"paper": model}, TEST_SEED, num_worlds, GAPS, bar):
        found.append((*encodings["paper"], *in_context(*encodings["paper"]), T, gap))
    return found


def evaluate(model: delo.Model, pairs: list) -> dict[int, np.ndarray]:
    """Per gap, rows of: error [cm], error [deg], then the plan's numbers as in `_plans.PlanNumbers`."""

    @jax.jit
    def one(source, target, ours, theirs, T_true):
        plan = model.apply("plan", ours, theirs, source.keypoint_mask, target.keypoint_mask)
        return delo.coarse(model, source, target, plan).T_target_source, jnp.stack(describe(plan, source, target, T_true))

    rows: dict[int, list] = {gap: [] for gap in GAPS}
    for *arguments, T_true, gap in pairs:
        T, numbers = one(*arguments, T_true.astype(np.float32))
        error = se3.inverse(np.asarray(T, np.float64)) @ T_true
        cm, deg = 100 * np.linalg.norm(error[:3, 3]), np.degrees(se3.rotation_angle(error[:3, :3]))
        rows[gap].append([cm, deg, *np.asarray(numbers)])
    return {gap: np.array(values) for gap, values in rows.items()}


def draw(medians: dict, settings: Settings, file: Path) -> None:
    """Errors and row-weight variation over m, a line per xi."""
    figure = Figure(figsize=(12, 3.5), layout="constrained")
    labels = "median error at gap 1 [cm]", "median error at gap 1 [deg]", "row-weight variation at gap 1"
    for column, (axes, label) in enumerate(zip(figure.subplots(1, 3), labels, strict=True)):
        for rounds in settings.rounds:
            axes.plot(settings.masses, [medians[mass, rounds][1][column] for mass in settings.masses], marker="o", label=f"xi = {rounds}")
        axes.set(xlabel="mass m", ylabel=label, ylim=(0, None))
        axes.legend()
    figure.savefig(file, dpi=120)
    print(f"\nfigure: {file}")


def main(argv: list[str] | None = None) -> int:
    """Sweep, print, judge."""
    parser = _harness.parser(__doc__, needs_data=False)
    parser.add_argument("--weights", type=Path, required=True, help="of the paper preset, as experiments/paper_preset.py writes them")
    args = parser.parse_args(argv)
    settings = QUICK if args.quick else Settings()
    model = delo_jax.load(args.weights)
    medians = {}
    head = " | ".join(f"gap {gap}: cm | deg" for gap in GAPS)
    with _harness.progress() as bar:
        pairs = features(model, settings.num_worlds, bar)
        task = bar.add_task("sweep", total=len(settings.masses) * len(settings.rounds))
        print(f"| m | xi | {head} | row-weight variation | inlier mass % | sharpness % | largest excess % |\n|---:|---:|{'---:|' * 8}")
        for mass in settings.masses:
            for rounds in settings.rounds:
                matching = replace(model.cfg.matching, mass=mass, num_iters=rounds)
                errors = evaluate(delo.Model(model.variables, replace(model.cfg, matching=matching)), pairs)
                medians[mass, rounds] = {gap: np.median(values, axis=0) for gap, values in errors.items()}
                cells = " | ".join(f"{medians[mass, rounds][gap][0]:.0f} | {medians[mass, rounds][gap][1]:.2f}" for gap in GAPS)
                variation, *shares = medians[mass, rounds][1][2:]
                numbers = " | ".join([f"{variation:.2f}", *(f"{100 * share:.1f}" for share in shares)])
                print(f"| {mass:g} | {rounds} | {cells} | {numbers} |", flush=True)
                bar.advance(task)
    draw(medians, settings, args.weights.with_name("transport_sweep.png"))
    most = max(settings.rounds)
    rows = [
        Row(f"row-weight variation at m = 1, xi = {most}: a balanced plan refuses nothing", float(medians[1.0, most][1][2]), "", 0.05),
        Row(f"median excess of a cap at m = 0.1, xi = {most}", 100 * float(medians[0.1, most][1][5]), "%", 1.0),
    ]
    return _harness.finish(rows, dataclasses.asdict(settings), args)


if __name__ == "__main__":
    _harness.run(main)
