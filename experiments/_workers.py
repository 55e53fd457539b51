"""Work spread over processes, each on cores of its own, with one bar for all of them."""

import multiprocessing
import os
import queue
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from typing import Any

from rich.progress import Progress

POLL_S = 0.5
_units: Any = None  # queue of this process to the one with the bar
_shares: Any = None  # queue of cores that nobody has
_own: list[int] = []  # cores of this process


class Counting(Progress):
    """In place of a bar where there is no terminal: what is tracked is counted in the process with the bar."""

    def __init__(self) -> None:
        super().__init__(disable=True)

    def track(self, sequence: Iterable, *_: Any, **__: Any) -> Iterator:
        """The items; each is counted when it is done with."""
        for item in sequence:
            yield item
            _units.put(1)


def cores() -> list[int]:
    """Cores that this process may run on."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


def spread(function: Callable[..., None], tasks: list[tuple], num_workers: int, bar: Progress, title: str, total: int) -> None:
    """Call a function of a module for every task, each in a process of its own, whose memory goes with it, in the order given.

    Args:
        function: of arguments that can be pickled; what it tracks with `Counting` is shown.
        tasks: its arguments, the longest first.
        num_workers: processes at a time; the cores are dealt out among them.
        bar: progress.
        title: of the bar.
        total: units in all tasks.
    """
    context = multiprocessing.get_context("spawn")
    units, shares, known = context.Queue(), context.Queue(), cores()
    for number in range(num_workers):
        shares.put(known[number::num_workers] or known)
    task = bar.add_task(title, total=total)
    with ProcessPoolExecutor(num_workers, context, _start, (units, shares), max_tasks_per_child=1) as pool:
        running = {pool.submit(_call, function, arguments) for arguments in tasks}
        try:
            while running:
                done, running = wait(running, timeout=POLL_S, return_when=FIRST_EXCEPTION)
                for future in done:
                    future.result()
                bar.advance(task, _drained(units))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _start(units: Any, shares: Any) -> None:
    """Of a worker, before anything computes: libraries make as many threads as they find cores."""
    global _units, _shares, _own
    _units, _shares, _own = units, shares, shares.get()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, _own)


def _call(function: Callable[..., None], arguments: tuple) -> None:
    try:
        function(*arguments)
    finally:
        _shares.put(_own)


def _drained(units: Any) -> int:
    count = 0
    while True:
        try:
            count += units.get_nowait()
        except queue.Empty:
            return count
