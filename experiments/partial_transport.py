"""Where does partial transport help? Score sources x pose solvers, same encoder and training budget, three seeds.

Every source of matching scores is trained on the same simulated worlds with the same number of steps, by the cross-entropy
of its whole plan against the true matches; its scores are then frozen, and every pose solver is run on the same plans:
Procrustes on the plan (the paper's), Procrustes on the best match of each row, and the same weighted by how well matches
agree in pairs. Softmax, exact partial transport and the best partial-transport variant are trained on, end to end through the
consistency weights, the first two through Procrustes too; mass, entropic weight and iterations are swept on frozen scores.
Tested on worlds that no training has seen, with dense traffic, at half overlap, and on recordings; intervals draw the two frames
of a pair together with both of its directions.

Run:     python experiments/partial_transport.py --data TREE [--out DIR]     (about 100 minutes on 2 cores; resumes)
Expect:  all bounds kept: at least 300 pairs per cell, and the solver decides more than the source.
"""

import dataclasses
from dataclasses import replace
from pathlib import Path
from typing import Any

import _harness
import _pairs
import jax
import numpy as np
from _harness import Row
from _pairs import Pairs
from _plans import PlanNumbers, interval, lost, remembered, timing

from delo_jax import weights
from delo_jax.config import SOLVERS, DeloConfig, MatchingConfig, PoseConfig, TrainConfig
from delo_jax.model import delo
from delo_jax.train import loop
from delo_jax.train.worlds import World

GAPS = (1, 3, 5)
SEEDS = (0, 1, 2)
MASS = 0.6
SOURCES = {
    "softmax": MatchingConfig(plan="softmax"),
    "dual softmax": MatchingConfig(plan="dual_softmax"),
    "softmax x confidence": MatchingConfig(plan="softmax_confidence"),
    "Algorithm 1 as printed": MatchingConfig(plan="algorithm_1", mass=MASS),
    "exact partial OT": MatchingConfig(plan="partial_transport", mass=MASS),
    "OT with dustbin": MatchingConfig(plan="dustbin_transport"),
    "sparse partial OT, 16 candidates": MatchingConfig(plan="sparse_transport", mass=MASS, num_candidates=16),
    "exact partial OT, predicted mass": MatchingConfig(plan="partial_transport", predict_mass=True),
    "unbalanced OT": MatchingConfig(plan="unbalanced_transport"),
}
PARTIAL = [name for name in SOURCES if "OT" in name]  # candidates for the best partial-transport variant
MASSES, EPSILONS, ITERATIONS = (0.1, 0.3, 0.6, 0.9), (0.25, 1.0, 2.0), (1, 5, 10, 50)


@dataclasses.dataclass(frozen=True)
class Settings:
    """Sizes of the study."""

    num_training_worlds: int = 200
    num_test_worlds: int = 150
    num_steps: int = 300
    num_end_to_end_steps: int = 100
    batch_size: int = 4
    seeds: tuple[int, ...] = SEEDS


QUICK = Settings(num_training_worlds=10, num_test_worlds=4, num_steps=10, num_end_to_end_steps=10, batch_size=2, seeds=(0,))


def training_config(matching: MatchingConfig, seed: int, settings: Settings) -> TrainConfig:
    """The one training of all sources; only the matching differs."""
    return TrainConfig(
        model=DeloConfig(matching=matching),
        seed=seed,
        num_scenes=settings.num_training_worlds,
        num_steps=settings.num_steps,
        num_evidence_steps=0,
        batch_size=settings.batch_size,
        matching_loss="plan",
        matching_weight=1.0,
        fine_weight=0.0,
        evidence_weight=0.0,
        validate_every=100,
    )


def trained(name: str, cfg: TrainConfig, start_from: delo.Model, worlds: list[World], out: Path, bar) -> tuple[delo.Model, int]:
    """The model of a run; read from its file where the run is over, else trained, going on from its last checkpoint."""
    folder = out / name.replace(" ", "_").replace(",", "")
    file = folder / "model.safetensors"
    if file.exists():
        return weights.load(file), int(weights.read_card(file)["steps left out as not finite"])
    model, num_nonfinite = loop.fit(cfg, worlds, [], start_from, folder, _harness.BarReporter(bar, name))
    weights.save(file, model, {"name": name, "steps left out as not finite": num_nonfinite})
    return model, num_nonfinite


def test_sets(data: Path, settings: Settings, out: Path, bar) -> dict[str, dict[int, Pairs]]:
    """Condition -> gap -> pairs."""
    cfg, num = DeloConfig().preprocess, settings.num_test_worlds
    unseen, traffic = (
        _pairs.simulated(num, traffic=factor, cfg=cfg, folder=out / "worlds", bar=bar) for factor in (1.0, _pairs.DENSE_TRAFFIC)
    )
    real = _pairs.recorded(data, ("raw_0926_0013", "odo_04_000"), cfg, bar)
    sets = {
        "unseen worlds": {gap: _pairs.pairs(unseen, gap, 2) for gap in GAPS},
        "dense traffic": {gap: _pairs.pairs(traffic, gap, 2) for gap in GAPS},
        "half overlap": {gap: _pairs.half_overlap(_pairs.pairs(unseen, gap, 2), seed=gap) for gap in GAPS},
        "recorded": {gap: _pairs.pairs(real, gap) for gap in GAPS},
    }
    return sets


def cell(errors: np.ndarray, group: np.ndarray) -> str:
    """Lost share, median error, each with its interval, of (seeds, pairs, 2)."""
    share, metres = 100.0 * lost(errors), 100.0 * errors[..., 0]
    low, high = interval(share, group, np.mean)
    first, last = interval(metres, group, np.median)
    degrees = np.degrees(np.median(errors[..., 1]))
    return f"{share.mean():.1f} [{low:.1f}, {high:.1f}] | {np.median(metres):.0f} [{first:.0f}, {last:.0f}] | {degrees:.2f}"


def print_results(results: dict, sets: dict, settings: Settings) -> None:
    """One table per condition, and one of the plans."""
    head = " | ".join(f"gap {gap}: lost % | median cm | deg" for gap in GAPS)
    for condition, by_source in results.items():
        num = [next(iter(by_source.values()))[gap][1].shape[1] for gap in GAPS]
        print(f"\n### {condition}: {' / '.join(map(str, num))} pairs at gaps 1 / 3 / 5, {len(settings.seeds)} seeds\n")
        print(f"| matching | solver | {head} |\n|---|---|{'---:|' * 9}")
        for source, by_gap in by_source.items():
            for number, solver in enumerate(SOLVERS):
                print(
                    f"| {source} | {solver} | "
                    + " | ".join(cell(by_gap[gap][1][:, :, number], sets[condition][gap].group) for gap in GAPS)
                    + " |"
                )
        print(f"\n| matching, plan at gap 3 | row-weight variation | inlier mass % | sharpness % | largest excess % |\n|---|{'---:|' * 4}")
        for source, by_gap in by_source.items():
            variation, inliers, sharpness, excess = (np.median(value) for value in by_gap[3][0])
            print(f"| {source} | {variation:.2f} | {100 * inliers:.0f} | {100 * sharpness:.0f} | {100 * excess:.0f} |")


def print_differences(results: dict, sets: dict) -> None:
    """How much less each source loses than softmax does on the same pairs, under the consistency solver."""
    number = SOLVERS.index("consistency")
    print("\n### Lost % with the consistency solver, minus that of softmax on the same pairs\n")
    cells = [(condition, gap) for condition in results for gap in GAPS[1:]]
    print("| matching | " + " | ".join(f"{condition}, gap {gap}" for condition, gap in cells) + " |\n|---|" + "---:|" * len(cells))
    for source in list(SOURCES)[1:]:
        texts = []
        for condition, gap in cells:
            shares = [100.0 * lost(results[condition][name][gap][1][:, :, number]) for name in (source, "softmax")]
            difference = shares[0] - shares[1]
            low, high = interval(difference, sets[condition][gap].group, np.mean)
            texts.append(f"{difference.mean():.1f} [{low:.1f}, {high:.1f}]")
        print(f"| {source} | " + " | ".join(texts) + " |")


def swap(model: delo.Model, **changes: Any) -> delo.Model:
    """The same weights with other settings of the matching."""
    return delo.Model(model.variables, replace(model.cfg, matching=replace(model.cfg.matching, **changes)))


def sweep(models: list[delo.Model], sets: dict, folder: Path) -> None:
    """Mass, entropic weight and iterations of exact partial transport on its frozen scores."""
    print(f"\n### Exact partial OT on frozen scores, gap 3: lost % with {', '.join(SOLVERS)}\n")
    head = " | ".join(f"{name}: {' / '.join(SOLVERS)}" for name in ("unseen worlds", "half overlap"))
    print(f"| m | eps | xi | {head} |\n|---:|---:|---:|---|---|")
    variants = [{"mass": mass, "epsilon": epsilon, "num_iters": 10} for mass in MASSES for epsilon in EPSILONS]
    variants += [{"mass": MASS, "epsilon": 1.0, "num_iters": rounds} for rounds in ITERATIONS if rounds != 10]
    for variant in variants:
        cells = []
        for name in ("unseen worlds", "half overlap"):
            errors = np.stack([remembered(swap(model, **variant), sets[name][3], folder)[1] for model in models])
            cells.append(" / ".join(f"{100 * lost(errors)[:, :, number].mean():.1f}" for number in range(len(SOLVERS))))
        print(f"| {variant['mass']:g} | {variant['epsilon']:g} | {variant['num_iters']} | " + " | ".join(cells) + " |", flush=True)


def share_lost(results: dict, condition: str, source: str, gap: int, solver: str) -> float:
    """Lost share in percent, over all seeds."""
    return 100.0 * float(lost(results[condition][source][gap][1][:, :, SOLVERS.index(solver)]).mean())


def collect(models: dict[str, list[delo.Model]], sets: dict, folder: Path, bar) -> dict:
    """condition -> source -> gap -> (numbers of the plans, errors (seeds, pairs, solvers, 2))."""
    results: dict = {condition: {source: {} for source in models} for condition in sets}
    task = bar.add_task("testing", total=sum(map(len, models.values())) * len(sets) * len(GAPS))
    for source, of_seeds in models.items():
        for condition, by_gap in sets.items():
            for gap, both in by_gap.items():
                measured = []
                for model in of_seeds:
                    measured.append(remembered(model, both, folder))
                    bar.advance(task)
                numbers = PlanNumbers(*(np.stack(values) for values in zip(*(m[0] for m in measured), strict=True)))
                results[condition][source][gap] = numbers, np.stack([m[1] for m in measured])
    return results


def from_scratch(worlds: list[World], settings: Settings, out: Path, bar) -> tuple[dict[str, list[delo.Model]], int]:
    """The models of every source, one per seed, and how many of their steps were left out."""
    models: dict[str, list[delo.Model]] = {name: [] for name in SOURCES}
    num_nonfinite = 0
    for name, matching in SOURCES.items():
        for seed in settings.seeds:
            cfg = training_config(matching, seed, settings)
            model, skipped = trained(f"{name}, seed {seed}", cfg, delo.init(cfg.model, jax.random.key(seed)), worlds, out, bar)
            models[name].append(model)
            num_nonfinite += skipped
    return models, num_nonfinite


def end_to_end(
    models: dict, runs: list[tuple[str, str]], worlds: list[World], settings: Settings, out: Path, bar
) -> tuple[dict[str, list[delo.Model]], int]:
    """Models of (source, solver) trained on by the paper's odometry loss through the solver, their plan still held to the true matches."""
    found: dict[str, list[delo.Model]] = {}
    num_nonfinite = 0
    for name, solver in runs:
        found[f"{name}, end to end through {solver}"] = []
        for seed, model in zip(settings.seeds, models[name], strict=True):
            cfg = training_config(model.cfg.matching, seed, settings)
            cfg = replace(cfg, model=replace(cfg.model, pose=PoseConfig(solver=solver)), num_steps=settings.num_end_to_end_steps)
            cfg = replace(cfg, odometry_weight=1.0, learning_rate=5e-4)
            run, skipped = trained(f"{name}, {solver}, seed {seed}", cfg, delo.Model(model.variables, cfg.model), worlds, out, bar)
            found[f"{name}, end to end through {solver}"].append(run)
            num_nonfinite += skipped
    return found, num_nonfinite


def best_partial(results: dict) -> str:
    """The partial-transport variant that loses least on unseen worlds with the consistency solver; ties by the median error."""

    def rank(name: str) -> tuple[float, float]:
        errors = [results["unseen worlds"][name][gap][1][:, :, SOLVERS.index("consistency")] for gap in GAPS]
        return float(np.mean([lost(e).mean() for e in errors])), float(np.mean([np.median(e[..., 0]) for e in errors]))

    return min(PARTIAL, key=rank)


def judge(results: dict, sets: dict, num_nonfinite: int) -> list[Row]:
    """What must hold, and how far the sources differ."""
    fewest = min(len(both.source) for by_gap in sets.values() for both in by_gap.values())
    rows = [Row("fewest pairs in a cell", float(fewest), "", 300.0, True)]
    for gap in GAPS:
        by_solver = {s: [share_lost(results, "recorded", name, gap, s) for name in SOURCES] for s in SOLVERS}
        gain = min(by_solver["procrustes"]) - max(by_solver["consistency"])
        rows.append(
            Row(f"recorded, gap {gap}: lost by the best source with Procrustes, minus by the worst with consistency", gain, "%", 0.0, True)
        )
        spread = max(by_solver["consistency"]) - min(by_solver["consistency"])
        rows.append(Row(f"recorded, gap {gap}: lost with consistency, worst source minus best", spread, "%"))
    rows.append(Row("training steps left out as not finite", float(num_nonfinite), "", 0.0))
    return rows


def main(argv: list[str] | None = None) -> int:
    """Train, measure, print, judge."""
    parser = _harness.parser(__doc__, needs_data=True)
    where = "worlds, checkpoints and weights; an interrupted run goes on"
    parser.add_argument("--out", type=Path, default=Path("runs/partial-transport"), help=where)
    args = parser.parse_args(argv)
    settings = QUICK if args.quick else Settings()
    out = args.out / "quick" if args.quick else args.out
    with _harness.progress() as bar:
        base = replace(training_config(SOURCES["softmax"], 0, settings), num_validation_scenes=1)
        worlds, _ = loop.load_worlds(base, args.out / "worlds", _harness.BarReporter(bar), None)
        models, num_nonfinite = from_scratch(worlds, settings, out, bar)
        sets = test_sets(args.data, settings, args.out, bar)
        results = collect(models, sets, args.out / "measured", bar)
        print_results(results, sets, settings)
        print_differences(results, sets)
        best = best_partial(results)
        print(f"\nBest partial transport on unseen worlds with the consistency solver: {best}\n")
        runs = [(name, "consistency") for name in dict.fromkeys([best, "exact partial OT", "softmax"])]
        retrained, skipped = end_to_end(
            models, [*runs, ("exact partial OT", "procrustes"), ("softmax", "procrustes")], worlds, settings, out, bar
        )
        print_results(collect(retrained, sets, args.out / "measured", bar), sets, settings)
        sweep(models["exact partial OT"], sets, args.out / "measured")
        timing({name: of_seeds[0] for name, of_seeds in models.items()}, sets["recorded"][3])
    return _harness.finish(judge(results, sets, num_nonfinite + skipped), dataclasses.asdict(settings), args)


if __name__ == "__main__":
    _harness.run(main)
