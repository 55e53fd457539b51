"""How long a function takes: to trace, lower and compile, on its first call, and warm."""

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

UNKNOWN = float("nan")


class Cost(NamedTuple):
    """What the compiler says of an executable; NaN where it says nothing. The body of a loop counts once."""

    flops: float
    bytes_accessed: float  # of all operations; what stays in a cache counts too
    peak_bytes: float  # of arguments, results and scratch memory together


class Build(NamedTuple):
    """The way from a function to an executable."""

    trace_ms: float
    lower_ms: float
    compile_ms: float
    cost: Cost


class Timing(NamedTuple):
    """Calls of a function, each until its result was there."""

    build: Build
    first_ms: float
    warm_ms: tuple[float, ...]  # NaN where a stage did not run

    def percentile(self, percent: int) -> float:
        """Of the warm calls [ms]; NaN without any."""
        known = [value for value in self.warm_ms if not np.isnan(value)]
        return float(np.percentile(known, percent)) if known else UNKNOWN


class Effort(NamedTuple):
    """When enough has been measured."""

    max_calls: int
    budget_s: float  # no further call after so long
    min_calls: int = 2
    warm_up: int = 2  # calls between the first one and those that count; left out where one call takes the budget


NOT_BUILT = Build(UNKNOWN, UNKNOWN, UNKNOWN, Cost(UNKNOWN, UNKNOWN, UNKNOWN))
"""Of functions that are not compiled."""


@contextlib.contextmanager
def nothing_kept() -> Iterator[None]:
    """Compiles everything anew meanwhile, whatever is kept on disk."""
    before = jax.config.values["jax_enable_compilation_cache"]
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()  # JAX looks at the switch once
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", before)
        compilation_cache.reset_cache()


def built(jitted: Any, *args: Any, clock: Callable[[], float] = time.perf_counter) -> tuple[Any, Build]:
    """The executable of a jitted function for these arguments, and how long it took to make.

    Args:
        jitted: from `jax.jit`, not yet compiled for such arguments: JAX keeps what it has compiled.
        args: as in a call.
        clock: seconds.
    """
    marks = [clock()]
    traced = jitted.trace(*args)
    marks.append(clock())
    lowered = traced.lower()
    marks.append(clock())
    executable = lowered.compile()
    marks.append(clock())
    trace_ms, lower_ms, compile_ms = (1e3 * np.diff(marks)).tolist()
    return executable, Build(trace_ms, lower_ms, compile_ms, cost_of(executable))


def cost_of(executable: Any) -> Cost:
    """What the compiler says of an executable."""
    said, memory = executable.cost_analysis(), executable.memory_analysis()
    said = said[0] if isinstance(said, list) else said or {}
    peak = UNKNOWN
    if memory is not None:
        sizes = memory.argument_size_in_bytes, memory.output_size_in_bytes, memory.temp_size_in_bytes
        peak = float(sum(sizes) - memory.alias_size_in_bytes)
    return Cost(float(said.get("flops", UNKNOWN)), float(said.get("bytes accessed", UNKNOWN)), peak)


def paired_ratio(above: Timing, below: Timing) -> float:
    """Median of the ratios of what was measured in the same turn."""
    return float(np.median(np.divide(above.warm_ms, below.warm_ms)))


def repeated(
    call: Callable[..., Any],
    effort: Effort,
    *,
    setup: Callable[[], tuple] = tuple,
    build: Build = NOT_BUILT,
    clock: Callable[[], float] = time.perf_counter,
) -> tuple[Any, Timing]:
    """The result of the last call, and the times of all.

    Args:
        call: the function; its result is awaited.
        effort: when to stop.
        setup: arguments of each call, made before its time begins.
        build: of the function, to hand on.
        clock: seconds.
    """

    def once() -> tuple[Any, float]:
        args = jax.block_until_ready(setup())
        begin = clock()
        result = jax.block_until_ready(call(*args))
        return result, 1e3 * (clock() - begin)

    result, first_ms = once()
    begin, warm_ms = clock(), list[float]()
    warm_up = effort.warm_up if first_ms < 1e3 * effort.budget_s else 0
    for number in range(warm_up + effort.max_calls):
        if len(warm_ms) >= effort.min_calls and clock() - begin > effort.budget_s:
            break
        result, value = once()
        if number >= warm_up:
            warm_ms.append(value)
    return result, Timing(build, first_ms, tuple(warm_ms))
