"""What commands show: progress on stderr, tables on stdout, Ctrl-C between two scans."""

import itertools
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.status import Status
from rich.table import Table
from rich.text import Text


class Row(NamedTuple):
    """One line of a summary."""

    what: str
    value: str
    unit: str = ""


class RateColumn(ProgressColumn):
    """Units of work per second."""

    def __init__(self, unit: str):
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        """Rate over the last seconds, or over the whole task when it is done."""
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.1f} {self._unit}/s")


def progress(unit: str = "scans") -> Progress:
    """A bar with count, rate and time left, or time taken once it is done; on stderr, so that stdout holds results alone."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        RateColumn(unit),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
    note = TextColumn("{task.fields[note]}")
    return Progress(*columns, note, console=Console(stderr=True), redirect_stdout=sys.stdout.isatty())  # a table in a file stays there


def working(what: str) -> Status:
    """A sign of life on stderr while something runs that has no steps to count; a context manager."""
    return Console(stderr=True).status(what)


@contextmanager
def parts(what: str, total: int) -> Iterator[Callable[[str], None]]:
    """A bar over parts that take nobody knows how long, with the time so far; on stderr, and gone when they are done.

    Yields what to call with the name of each part before it begins.
    """
    console = Console(stderr=True)
    if not console.is_interactive:  # a bar that goes leaves nothing in a file
        yield lambda part: None
        return
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.fields[note]}")
    with Progress(*columns, console=console, redirect_stdout=sys.stdout.isatty(), transient=True) as bar:
        task, number = bar.add_task(what, total=total, note=""), itertools.count()
        yield lambda part: bar.update(task, completed=next(number), note=part, refresh=True)


def print_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]], *, right: Sequence[int] = ()) -> None:
    """A table on stdout; columns numbered in `right` hold numbers."""
    table = Table(title=title, title_justify="left")
    for number, name in enumerate(header):
        table.add_column(name, justify="right" if number in right else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    Console().print(table)


def print_summary(rows: Sequence[Row], title: str = "summary") -> None:
    """Rows of a summary with their units."""
    print_table(title, ("", "value", "unit"), rows, right=(1,))


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Ctrl-C is noted rather than raised: a loop asks between two scans, so that files hold whole frames. The second one raises."""
    asked = False

    def note(*_: object) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    try:
        before = signal.signal(signal.SIGINT, note)
    except ValueError:  # not in the main thread, which alone receives signals
        yield lambda: False
        return
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, before)
