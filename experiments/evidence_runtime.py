"""What the evidence costs: time of a pair with and without the evidence head, its covariance, and the paper's head.

The paper gives 30 to 41 ms for its network with the head. Both variants are solved in turn in one process, so that ratios do not depend on
how busy the machine is; compile time apart, results awaited. Encoding, which both share, is printed apart.

- `delo-base`: pose alone; with the statistics head's evidence; with the calibrated covariance as well.
- `paper` preset, N = 1,024, D = 512, random weights (time does not depend on them): pose alone, and with the PU-EPE head.

"Pose alone" is the same function, compiled for what a pose needs: XLA drops the rest. Ratios are medians over the turns.

Run:     python experiments/evidence_runtime.py     (about 4 minutes on 2 cores)
Expect:  all bounds kept; the picture is written to --out.
"""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import _harness
import jax
import jax.numpy as jnp
import numpy as np
from _harness import Row
from matplotlib.figure import Figure
from rich.progress import Progress

import delo_jax
from delo_jax import inference
from delo_jax.model import delo
from delo_jax.preprocess import Scan, preprocess
from delo_jax.sim import simulate_clip
from delo_jax.train.presets import PRESETS

WORLD = ("urban", 760_000)
ENCODE, POSE, EVIDENCE, COVARIANCE = "encode a scan", "pose alone", "with evidence", "with evidence and covariance"
MAX_RATIO = {"delo-base": 1.3, "paper": 1.2}  # measured 1.05 to 1.11 and 0.92 to 0.99 on a busy machine
LABELS = {ENCODE: "encode\na scan", POSE: "pose\nalone", EVIDENCE: "with\nevidence", COVARIANCE: "evidence,\ncovariance"}
COLORS = {ENCODE: "#b8bfc6", POSE: "#5b6770", EVIDENCE: "#1f5fa8", COVARIANCE: "#2a9d5c"}


@dataclasses.dataclass(frozen=True)
class Settings:
    """Repeats, after the warm-up."""

    num_base: int = 200
    num_paper: int = 50
    warm_up: int = 5


QUICK = Settings(num_base=10, num_paper=2, warm_up=1)


class Timing(NamedTuple):
    """Of one variant."""

    compile_s: float  # first call
    spent_ms: np.ndarray  # (n,)

    @property
    def p50_ms(self) -> float:
        """Median."""
        return float(np.median(self.spent_ms))

    @property
    def p95_ms(self) -> float:
        """95th percentile."""
        return float(np.percentile(self.spent_ms, 95))

    def over(self, other: "Timing") -> float:
        """Median of the ratios to what was measured in the same turn."""
        return float(np.median(self.spent_ms / other.spent_ms))


def encoded(model: delo.Model, scan: Scan) -> delo.Encoding:
    """Descriptors of a scan; a function of its own, so that its first call compiles."""
    return delo.encode(model, scan)


def pose_alone(model: delo.Model, source: delo.Encoding, target: delo.Encoding, T_init: jax.Array) -> jax.Array:
    """T_target_source."""
    return delo.solve(model, source, target, T_init).T_target_source


def with_evidence(model: delo.Model, source: delo.Encoding, target: delo.Encoding, T_init: jax.Array) -> Any:
    """Pose, evidence and confidence."""
    found = delo.solve(model, source, target, T_init)
    return found.T_target_source, found.nig, found.confidence


def with_covariance(model: delo.Model, source: delo.Encoding, target: delo.Encoding, T_init: jax.Array) -> Any:
    """Everything that an estimate says: also information, statistics, and the calibrated covariance."""
    found = delo.solve(model, source, target, T_init)
    return found, delo.covariance(model, found)


def in_turn(functions: dict[str, tuple[Callable, tuple]], num: int, warm_up: int, bar: Progress, title: str) -> dict[str, Timing]:
    """First calls, then all functions one after the other, beginning with another one each time."""
    compile_s, names = {}, list(functions)
    for name, (function, arguments) in functions.items():
        begin = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        compile_s[name] = time.perf_counter() - begin
    spent: dict[str, list[float]] = {name: [] for name in names}
    for number in bar.track(range(warm_up + num), description=title):
        first = number % len(names)
        for name in names[first:] + names[:first]:
            function, arguments = functions[name]
            begin = time.perf_counter()
            jax.block_until_ready(function(*arguments))
            if number >= warm_up:
                spent[name].append(1e3 * (time.perf_counter() - begin))
    return {name: Timing(compile_s[name], np.array(spent[name])) for name in names}


def timings(model: delo.Model, num: int, warm_up: int, bar: Progress, title: str) -> dict[str, Timing]:
    """All variants that the model has, on a simulated pair one frame apart."""
    scans = [preprocess(scan.points, model.cfg.preprocess) for scan in simulate_clip(*WORLD, num_frames=2)]
    source, target = (jax.block_until_ready(inference.encode(model, scan)) for scan in scans)
    pair = model, source, target, jnp.eye(4)
    functions: dict[str, tuple[Callable, tuple]] = {
        ENCODE: (jax.jit(encoded), (model, scans[0])),
        POSE: (jax.jit(pose_alone), pair),
        EVIDENCE: (jax.jit(with_evidence), pair),
    }
    if model.cfg.evidence.covariance_width:
        functions[COVARIANCE] = (jax.jit(with_covariance), pair)
    return in_turn(functions, num, warm_up, bar, title)


def show(found: dict[str, dict[str, Timing]]) -> None:
    """All times, and what each costs beside the pose alone."""
    print("| network | part | p50 ms | p95 ms | / pose alone | first call s |\n|---|---|---:|---:|---:|---:|")
    for network, by_part in found.items():
        for part, one in by_part.items():
            ratio = "" if part == ENCODE else f"{one.over(by_part[POSE]):.3f}"
            print(f"| {network} | {part} | {one.p50_ms:.1f} | {one.p95_ms:.1f} | {ratio} | {one.compile_s:.1f} |")


def draw(found: dict[str, dict[str, Timing]], path: Path) -> None:
    """Medians as bars, 95th percentiles as whiskers."""
    figure = Figure(figsize=(7.0, 3.4), layout="constrained")
    for ax, (network, by_part) in zip(figure.subplots(1, len(found), squeeze=False)[0], found.items(), strict=True):
        for place, (part, one) in enumerate(by_part.items()):
            above = [[0.0], [one.p95_ms - one.p50_ms]]
            ax.bar(place, one.p50_ms, 0.7, color=COLORS[part], yerr=above, capsize=4, error_kw={"lw": 1.0})
            ink = "black" if part == ENCODE else "white"
            ax.annotate(f"{one.p50_ms:.1f}", (place, 0.0), xytext=(0, 4), textcoords="offset points", ha="center", fontsize=9, color=ink)
        ax.set_xticks(range(len(by_part)), [LABELS[part] for part in by_part], fontsize=8)
        ax.set_title(network, fontsize=10)
        ax.set_ylabel("time [ms]: median, 95 % quantile")
        ax.grid(alpha=0.3, axis="y")
        ax.set_axisbelow(True)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150, metadata={"Software": None})
    print(f"\nfigure: {path}")


def judge(found: dict[str, dict[str, Timing]]) -> list[Row]:
    """Bounds on ratios within the run."""
    rows = []
    for network, by_part in found.items():
        whole = list(by_part)[-1]
        bound = next(ratio for name, ratio in MAX_RATIO.items() if network.startswith(name))
        rows.append(Row(f"{network}: {whole} / {POSE}", by_part[whole].over(by_part[POSE]), "", bound))
    return rows


def main(argv: list[str] | None = None) -> int:
    """Measure, print, draw, judge."""
    parser = _harness.parser(__doc__, needs_data=False)
    parser.add_argument("--out", type=Path, default=Path("runs/figures"), help="folder of the picture")
    args = parser.parse_args(argv)
    settings, paper = QUICK if args.quick else Settings(), PRESETS["paper"].model
    if args.quick:
        paper = replace(paper, preprocess=replace(paper.preprocess, max_points=256, num_keypoints=256))
    size = f"paper preset, N = {paper.preprocess.num_keypoints}, D = {paper.encoder.embedding_dim}"
    with _harness.progress() as bar:
        base = timings(delo_jax.load("delo-base"), settings.num_base, settings.warm_up, bar, "delo-base")
        big = timings(delo.init(paper, jax.random.key(0)), settings.num_paper, min(2, settings.warm_up), bar, "paper preset")
    found = {"delo-base": base, size: big}
    show(found)
    draw(found, args.out / "evidence_runtime.png")
    return _harness.finish(judge(found), dataclasses.asdict(settings), args)


if __name__ == "__main__":
    _harness.run(main)
