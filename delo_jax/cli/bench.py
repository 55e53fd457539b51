"""`delo bench`: how long does everything take on this machine?"""

import dataclasses
import time
from pathlib import Path
from typing import Any, Literal

from delo_jax.cli.command import Command
from delo_jax.config import require

PresetName = Literal["tiny", "base", "paper"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bench(Command):
    """Times of every stage of a pair, of streams and of training, on simulated HDL-64E scans, beside what the machine can do.

    Tracing, lowering, compiling, first call and warm calls are apart; operations and bytes are the compiler's, which counts the body of a
    loop once. About ten minutes on two cores; what needs more memory or time than there is, is left out and named.

    Example: delo bench --presets base --points 1024
    """

    presets: list[PresetName] = dataclasses.field(default_factory=lambda: ["tiny", "base", "paper"])  # lists, which TOML has, too
    """Networks; base has the released weights, the others random ones."""
    points: list[int] = dataclasses.field(default_factory=lambda: [256, 512, 1024, 2048, 4096])
    """Source points of a pair."""
    weights: str = "delo-base"
    """Weights of the streams: released ones by name, or a .safetensors file."""
    quick: bool = False
    """The first preset with the fewest points, few calls: a look, never a verdict."""
    json: str = ""
    """Also write all metrics to this file; of a whole run it can be the baseline of later ones."""
    baseline: str = ""
    """JSON of an earlier run to compare with; ratios within a run are gates, times are not."""

    def run(self) -> int:
        """Prints the tables; 1 if a gate of the baseline is missed and the run was not quick."""
        require(bool(self.presets), "presets", "at least one", self.presets)
        require(bool(self.points) and min(self.points, default=0) >= 16, "points", "at least one number, none below 16", self.points)
        from delo_jax.bench.report import read_metrics, tables, to_json
        from delo_jax.bench.suite import Settings, quick, run
        from delo_jax.cli.console import working

        baseline = read_metrics(Path(self.baseline)) if self.baseline else []  # before minutes are spent
        settings = Settings(presets=tuple(self.presets), points=tuple(self.points), weights=self.weights)
        with working("starting") as status:
            report = run(quick(settings) if self.quick else settings, lambda what: status.update(what))
        print(report.device)
        for name, machine in report.machines.items():
            print(f"{name}: {machine.bandwidth / 1e9:.1f} GB/s, {machine.gemm / 1e9:.1f} GFLOP/s in float32 products")
        print(f"\n{tables(report)}")
        for entry in report.left_out:
            print(f"\nleft out: {entry.group}: {entry.why}")
        if self.json:
            Path(self.json).write_text(to_json(report, quick=self.quick, time=time.strftime("%Y-%m-%dT%H:%M:%S%z")), encoding="utf-8")
        return self._verdict(report, baseline)

    def _verdict(self, report: Any, baseline: list) -> int:
        """Prints the comparison with the baseline; the exit code."""
        from delo_jax.bench.report import compare, comparison, missing

        found = compare(report.metrics, baseline)
        if found:
            print(f"\n{comparison(found)}")
        if self.quick:
            print("\nquick run, no verdict")
            return 0
        if not baseline:
            print("\nno baseline, no verdict")
            return 0
        absent = missing(report.metrics, baseline, report.left_out, {row.group for row in report.rows})
        gates = [entry for entry in found if entry.metric.tolerance > 0]
        missed = sum(not entry.ok for entry in gates)
        for name in absent:
            print(f"\nnot measured: {name}")
        print(f"\n{len(gates) - missed} of {len(gates) + len(absent)} gates kept")
        return int(missed > 0 or bool(absent))
