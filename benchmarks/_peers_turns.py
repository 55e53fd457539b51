"""Calls that take turns, so that whatever else the machine does falls on all of them alike."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax

from delo_jax.bench.timing import NOT_BUILT, Timing

PAUSE_S = 0.02
"""Before each timed call of several packages: threads that the one before has left spinning are asleep by then; JAX's own, too."""


class Clock(NamedTuple):
    """Time and its passing; a test has its own."""

    now: Callable[[], float] = time.perf_counter
    """Seconds."""
    sleep: Callable[[float], None] = time.sleep


REAL = Clock()


class Timed(NamedTuple):
    """Who was timed, and for how long."""

    name: str
    seconds: float


def order(names: Sequence[str], turn: int) -> list[str]:
    """All names; another one is first each turn."""
    first = turn % len(names)
    return [*names[first:], *names[:first]]


def collected(times: Iterable[Timed], warm_up: int) -> dict[str, Timing]:
    """Times by name: the first one apart, those of the warm-up left out."""
    found: dict[str, list[float]] = {}
    for name, seconds in times:
        found.setdefault(name, []).append(1e3 * seconds)
    return {name: Timing(NOT_BUILT, values[0], tuple(values[warm_up:])) for name, values in found.items()}


def in_turns(
    calls: Mapping[str, Callable[[int], Any]], num: int, *, warm_up: int, pause_s: float = PAUSE_S, clock: Clock = REAL
) -> dict[str, Timing]:
    """Times of calls, each until its result is there.

    Args:
        calls: functions of the number of the turn, which says what scans they get.
        num: turns that count.
        warm_up: turns before them, at least one: the first calls compile.
        pause_s: before each call.
        clock: time.
    """
    times, names = [], list(calls)
    for turn in range(warm_up + num):
        for name in order(names, turn):
            clock.sleep(pause_s)
            begin = clock.now()
            jax.block_until_ready(calls[name](turn))
            times.append(Timed(name, clock.now() - begin))
    return collected(times, warm_up)


def table(title: str, timings: Mapping[str, Timing], more: Mapping[str, str] | None = None, heading: str = "") -> str:
    """A Markdown table of times, and of another column where there is one."""
    heads = ["first ms", "p50 ms", "p95 ms", "p99 ms", "calls", *([heading] if more else [])]
    lines = [f"| {title} | " + " | ".join(heads) + " |", "|---|" + "---:|" * len(heads)]
    for name, timing in timings.items():
        cells = [f"{timing.first_ms:.0f}", *(f"{timing.percentile(percent):.2f}" for percent in (50, 95, 99)), str(len(timing.warm_ms))]
        lines.append(f"| {name} | " + " | ".join([*cells, *([more.get(name, "")] if more else [])]) + " |")
    return "\n".join(lines)
