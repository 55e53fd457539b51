"""What was measured as named metrics, as tables and as JSON, and how it compares with an earlier run."""

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from delo_jax.bench.roofline import Machine
from delo_jax.bench.rows import LeftOut, Row
from delo_jax.errors import ConfigError

DIRECTIONS = ("lower", "higher")


class Metric(NamedTuple):
    """A named number."""

    name: str  # platform/what/N/stage/quantity
    value: float
    unit: str
    direction: str  # which is better, one of `DIRECTIONS`
    tolerance: float = 0.0  # share by which it may be worse than the baseline; 0: compared, never a gate


class Compared(NamedTuple):
    """A metric beside its value in the baseline."""

    metric: Metric  # with the tolerance of the baseline
    baseline: float
    worse: float  # factor; below 1 it is better
    ok: bool  # a gate that holds, or no gate


class Report(NamedTuple):
    """All of one run."""

    device: str
    machines: dict[str, Machine]  # by platform
    rows: list[Row]
    metrics: list[Metric]
    left_out: list[LeftOut]


def metrics_of_row(row: Row, machine: Machine) -> list[Metric]:
    """Every number of a row that is known; absolute ones are no gates."""
    timing, cost, prefix = row.timing, row.timing.build.cost, f"{row.group}/{row.stage}"
    percentiles = [(f"p{percent}", timing.percentile(percent), "ms") for percent in (50, 95, 99)]
    build = [("trace", timing.build.trace_ms, "ms"), ("lower", timing.build.lower_ms, "ms"), ("compile", timing.build.compile_ms, "ms")]
    costs = [("flops", cost.flops, "flop"), ("bytes", cost.bytes_accessed, "byte"), ("peak memory", cost.peak_bytes, "byte")]
    found = [*build, ("first call", timing.first_ms, "ms"), *percentiles, *costs]
    found.append(("roofline gap", machine.gap(timing.percentile(50), cost), "ratio"))
    metrics = [Metric(f"{prefix}/{name}", value, unit, "lower") for name, value, unit in found]
    if row.stage in ("train step", "input pipeline"):
        metrics.append(Metric(f"{prefix}/rate", 1e3 * row.batch / timing.percentile(50), "pairs/s", "higher"))
    return known(metrics)


def known(metrics: Iterable[Metric]) -> list[Metric]:
    """Those that are numbers."""
    return [metric for metric in metrics if math.isfinite(metric.value)]


def compare(metrics: list[Metric], baseline: list[Metric]) -> list[Compared]:
    """Metrics that the baseline has too, each with its gate: the tolerance of the baseline."""
    before = {metric.name: metric for metric in baseline}
    found = []
    for metric in metrics:
        if (old := before.get(metric.name)) is not None:
            worse = _factor(metric.value, old.value) if old.direction == "lower" else _factor(old.value, metric.value)
            ok = old.tolerance == 0.0 or worse <= 1.0 + old.tolerance
            found.append(Compared(metric._replace(tolerance=old.tolerance), old.value, worse, ok))
    return found


def _factor(above: float, below: float) -> float:
    return above / below if below > 0 else math.inf


def missing(metrics: list[Metric], baseline: list[Metric], left_out: list[LeftOut], groups: Iterable[str]) -> list[str]:
    """Names of gates of the baseline that this run should have measured and has not.

    Args:
        metrics: of this run.
        baseline: of an earlier one.
        left_out: groups that this machine could not bear do not count as missing.
        groups: that were asked for, such as `cpu/base/1024`.
    """
    measured, excused = {metric.name for metric in metrics}, {entry.group for entry in left_out}
    asked = tuple(f"{group}/" for group in groups if group not in excused)
    return [old.name for old in baseline if old.tolerance > 0 and old.name not in measured and old.name.startswith(asked)]


def to_json(report: Report, *, quick: bool, time: str) -> str:
    """The record of a run; a whole one can be the baseline of later ones."""
    record: dict[str, Any] = {"device": report.device, "time": time, "quick": quick}
    record["machines"] = {name: machine._asdict() for name, machine in report.machines.items()}
    record["left_out"] = [entry._asdict() for entry in report.left_out]
    record["metrics"] = [metric._asdict() for metric in report.metrics]
    return json.dumps(record, indent=1, allow_nan=False) + "\n"


def read_metrics(path: Path) -> list[Metric]:
    """The metrics of a record.

    Raises:
        ConfigError: not a record of a run.
    """
    try:
        metrics = [Metric(**row) for row in json.loads(path.read_text(encoding="utf-8"))["metrics"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path}: expected the JSON of delo bench, got {type(error).__name__}: {error}; write one with --json") from error
    for metric in metrics:
        if metric.direction not in DIRECTIONS or not metric.unit or metric.tolerance < 0:
            raise ConfigError(f"{path}: expected a unit, a direction of {DIRECTIONS} and a tolerance of at least 0, got {metric}")
    return metrics


def table(rows: list[Row], machine: Machine) -> str:
    """A Markdown table of one group: stages that are compiled with all their numbers, others with their percentiles."""
    if all(math.isnan(row.timing.build.compile_ms) for row in rows):
        lines = [f"| {rows[0].group} | p50 ms | p95 ms | p99 ms |", "|---|---:|---:|---:|"]
        return "\n".join([*lines, *(f"| {_stage(row)} | {_percentiles(row, '.1f')} |" for row in rows)])
    heads = "trace ms", "lower ms", "compile ms", "first ms", "p50 ms", "p95 ms", "p99 ms", "calls", "MFLOP", "MB", "peak MB", "gap"
    lines = [f"| {rows[0].group} | " + " | ".join(heads) + " |", "|---|" + "---:|" * len(heads)]
    for row in rows:
        timing, cost = row.timing, row.timing.build.cost
        before = [timing.build.trace_ms, timing.build.lower_ms, timing.build.compile_ms, timing.first_ms]
        after = [1e-6 * cost.flops, 1e-6 * cost.bytes_accessed, 1e-6 * cost.peak_bytes, machine.gap(timing.percentile(50), cost)]
        cells = [*(_cell(value, ".1f") for value in before), _percentiles(row, ".2f"), str(len(timing.warm_ms))]
        lines.append(f"| {_stage(row)} | " + " | ".join([*cells, *(_cell(value, ".1f") for value in after)]) + " |")
    return "\n".join(lines)


def _stage(row: Row) -> str:
    return row.stage if row.batch == 1 else f"{row.stage}, {row.batch} pairs"


def _percentiles(row: Row, form: str) -> str:
    return " | ".join(_cell(row.timing.percentile(percent), form) for percent in (50, 95, 99))


def _cell(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else ""


def tables(report: Report) -> str:
    """All groups, one table each, in the order in which they were measured."""
    groups: dict[str, list[Row]] = {}
    for row in report.rows:
        groups.setdefault(row.group, []).append(row)
    return "\n\n".join(table(rows, report.machines[group.split("/")[0]]) for group, rows in groups.items())


def comparison(found: list[Compared]) -> str:
    """A Markdown table of gates, and of rates and medians beside the baseline."""
    lines = ["| metric | value | unit | baseline | times worse | gate | ok |", "|---|---:|---|---:|---:|---|---|"]
    for metric, baseline, worse, ok in (entry for entry in found if _is_shown(entry)):
        gate = f"<= {1 + metric.tolerance:g}" if metric.tolerance else ""
        verdict = ("yes" if ok else "NO") if metric.tolerance else "-"
        lines.append(f"| {metric.name} | {metric.value:.4g} | {metric.unit} | {baseline:.4g} | {worse:.2f} | {gate} | {verdict} |")
    return "\n".join(lines)


def _is_shown(entry: Compared) -> bool:
    return entry.metric.tolerance > 0 or not entry.ok or entry.metric.name.endswith(("/p50", "/rate"))
