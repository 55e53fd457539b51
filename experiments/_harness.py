"""What every experiment shares: rows with bounds, one table, a JSON record, --quick, --data, the exit code."""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from delo_jax.errors import DeloError


@dataclass(frozen=True)
class Row:
    """One measured number and the bound it must keep; no bound: printed only."""

    metric: str
    value: float
    unit: str
    bound: float | None = None
    higher_is_better: bool = False

    @property
    def ok(self) -> bool:
        """Whether the bound holds; NaN never does."""
        if self.bound is None:
            return True
        return self.value >= self.bound if self.higher_is_better else self.value <= self.bound


def parser(doc: str | None, *, needs_data: bool) -> argparse.ArgumentParser:
    """Arguments that all experiments take; `doc` is the script's docstring."""
    result = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    result.add_argument("--quick", action="store_true", help="small problem, prints the table, no verdict")
    result.add_argument("--json", type=Path, help="also write the rows, settings, commit and device here")
    if needs_data:
        default = os.environ.get("DELO_DATA")
        text = "tree of real sequences; default $DELO_DATA"
        result.add_argument("--data", type=Path, default=default, required=default is None, help=text)
    return result


def finish(rows: list[Row], settings: Any, args: argparse.Namespace) -> int:
    """Print the table of bounded rows, write the JSON; the exit code: 1 if a bound is missed and the run was not quick."""
    print("\n| metric | value | unit | bound | ok |\n|---|---:|---|---:|---|")
    for row in rows:
        sign = "" if row.bound is None else f"{'>=' if row.higher_is_better else '<='} {row.bound:g}"
        verdict = "-" if args.quick or row.bound is None else ("yes" if row.ok else "NO")
        print(f"| {row.metric} | {row.value:.3f} | {row.unit} | {sign} | {verdict} |")
    missed = sum(not row.ok for row in rows)
    bounded = sum(row.bound is not None for row in rows)
    print(f"\n{device()}; " + ("quick run, no verdict" if args.quick else f"{bounded - missed} of {bounded} bounds kept"))
    if args.json:
        record = {"rows": [asdict(row) | {"ok": row.ok} for row in rows], "settings": settings, "quick": args.quick}
        record |= {"commit": commit(), "device": device(), "time": time.strftime("%Y-%m-%dT%H:%M:%S%z")}
        args.json.write_text(json.dumps(record, indent=2, default=str) + "\n")
    return 0 if args.quick or not missed else 1


class Rate(ProgressColumn):
    """Units per second."""

    def render(self, task: Task) -> Text:
        """The rate, once there is one."""
        return Text("" if task.speed is None else f"{task.speed:.1f}/s")


def run(main: Callable[[], int]) -> NoReturn:
    """Exit with the code of `main`; a missing or wrong input ends the script with its sentence, not with a traceback."""
    try:
        sys.exit(main())
    except DeloError as error:
        sys.exit(str(error))


def needed(value: np.ndarray | None, what: str) -> np.ndarray:
    """The value; ends the script with a sentence where the data tree lacks it."""
    if value is None:
        sys.exit(f"{what}: expected in the data tree, got none; check --data")
    return value


def progress() -> Progress:
    """A bar with count and time left, on stderr, so that stdout holds the tables alone."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), Rate(), TimeRemainingColumn()
    return Progress(*columns, console=Console(file=sys.stderr))


class BarReporter:
    """Progress of a training as bars; validations are kept, in a file too, so that a run that goes on has its whole curve."""

    def __init__(self, bar: Progress, name: str = "", curve: Path | None = None):
        self._bar, self._name, self._curve = bar, name, curve
        self._task: Any = None
        self.validations: dict[int, list[dict[str, float]]] = {}
        if curve is not None and curve.exists():
            self.validations = {int(step): rows for step, rows in json.loads(curve.read_text()).items()}

    def start(self, what: str, total: int, done: int = 0) -> None:
        """A new bar."""
        self._task = self._bar.add_task(f"{self._name}: {what}" if self._name else what, total=total, completed=done)

    def advance(self, note: str = "") -> None:
        """One unit further."""
        self._bar.advance(self._task)

    def validated(self, step: int, errors: list) -> None:
        """Errors on unseen worlds after `step` steps."""
        self.validations[step] = [row._asdict() for row in errors]
        if self._curve is not None:
            self._curve.parent.mkdir(parents=True, exist_ok=True)
            self._curve.write_text(json.dumps(self.validations))


def device() -> str:
    """Versions and devices of this run, in a line."""
    import jax

    devices = ", ".join(str(d.device_kind) for d in jax.devices())
    return f"{platform.machine()}, {os.cpu_count()} cores, JAX {jax.__version__} on {devices}, delo-jax {version('delo-jax')} at {commit()}"


def commit() -> str:
    """Short commit of the checkout, 'unknown' outside one."""
    found = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=Path(__file__).parent, capture_output=True, text=True, check=False
    )
    return found.stdout.strip() or "unknown"
