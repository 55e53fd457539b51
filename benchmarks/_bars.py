"""Bars of a benchmark: measured numbers with bounds, their table, their record, and the exit code."""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple


class Bar(NamedTuple):
    """One number of a run and the bound that it must keep; no bound: printed only."""

    what: str
    value: float
    unit: str = "ratio"
    bound: float | None = None
    at_least: bool = False
    """The bound is the least that will do, not the most."""

    @property
    def ok(self) -> bool:
        """Whether the bound holds; NaN never does."""
        if self.bound is None:
            return True
        return self.value >= self.bound if self.at_least else self.value <= self.bound


def table(bars: Sequence[Bar], *, quick: bool) -> str:
    """A Markdown table; a quick run has no verdicts."""
    lines = ["| bar | value | unit | bound | ok |", "|---|---:|---|---:|---|"]
    for bar in bars:
        bound = "" if bar.bound is None else f"{'>=' if bar.at_least else '<='} {bar.bound:g}"
        verdict = "-" if quick or bar.bound is None else ("yes" if bar.ok else "NO")
        lines.append(f"| {bar.what} | {bar.value:.3f} | {bar.unit} | {bound} | {verdict} |")
    return "\n".join(lines)


def verdict(bars: Sequence[Bar], left_out: Sequence[str], *, quick: bool) -> str:
    """How many bounds were kept, in words."""
    if quick:
        return "quick run, no verdict"
    bounded = [bar for bar in bars if bar.bound is not None]
    missing = f"; not measured: {'; '.join(left_out)}" if left_out else ""
    return f"{sum(bar.ok for bar in bounded)} of {len(bounded)} bars kept{missing}"


def exit_code(bars: Sequence[Bar], left_out: Sequence[str], *, quick: bool) -> int:
    """1 when a bar was missed, or could not be measured, and the run was not quick."""
    return 0 if quick or (all(bar.ok for bar in bars) and not left_out) else 1


def write(path: Path, bars: Sequence[Bar], facts: dict[str, Any]) -> None:
    """The bars as JSON, after what is known of the run."""
    record = facts | {"time": time.strftime("%Y-%m-%dT%H:%M:%S%z"), "bars": [bar._asdict() | {"ok": bar.ok} for bar in bars]}
    path.write_text(json.dumps(record, indent=1, default=str) + "\n", encoding="utf-8")
