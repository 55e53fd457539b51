"""Measured stages of one group, such as `cpu/base/1024`: called only where the machine can bear it."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from delo_jax.bench.roofline import Machine, free_bytes, matrix_product, too_much
from delo_jax.bench.timing import NOT_BUILT, UNKNOWN, Build, Effort, Timing, built, repeated

PRODUCT = "matrix product"
"""Stage that ratios are over: measured in the group itself, so that both sides see the same load."""


class Row(NamedTuple):
    """A stage and its times."""

    group: str
    stage: str
    timing: Timing
    batch: int = 1  # pairs a call


class LeftOut(NamedTuple):
    """What was not measured."""

    group: str
    why: str


class TooMuch(Exception):  # noqa: N818 - no mistake, the end of a group
    """A stage that this machine had better not run; nothing that builds on it can be measured."""


class Group:
    """Measures stage after stage and keeps their rows.

    Args:
        name: of the group.
        machine: rates of this machine.
        effort: when a stage has been measured enough.
    """

    def __init__(self, name: str, machine: Machine, effort: Effort):
        self.name, self.rows = name, list[Row]()
        self._machine, self._effort = machine, effort

    def host(self, stage: str, call: Callable[..., Any], *, setup: Callable[[], tuple] = tuple, batch: int = 1) -> Any:
        """Measures a function that is not compiled as a whole; returns its result."""
        result, timing = repeated(call, self._effort, setup=setup)
        self.rows.append(Row(self.name, stage, timing, batch))
        return result

    def device(self, stage: str, jitted: Any, *args: Any, batch: int = 1) -> Any:
        """Compiles and measures a jitted function; returns its result.

        Raises:
            TooMuch: it would need more memory or time than there is; it was compiled, not called.
        """
        executable, build = self._bearable(stage, jitted, *args)
        result, timing = repeated(lambda: executable(*args), self._effort, build=build)
        self.rows.append(Row(self.name, stage, timing, batch))
        return result

    def device_beside(self, stage: str, jitted: Any, *args: Any, batch: int, other: str, call: Callable[[], Any]) -> None:
        """Like `device`, in turns with another function: whatever else the machine does falls on both stages alike.

        Raises:
            TooMuch: as `device`.
        """
        executable, build = self._bearable(stage, jitted, *args)
        others = []

        def once() -> tuple[()]:
            begin = time.perf_counter()
            jax.block_until_ready(call())
            others.append(1e3 * (time.perf_counter() - begin))
            return ()

        _, timing = repeated(lambda: executable(*args), self._effort, setup=once, build=build)
        self.rows.append(Row(self.name, stage, timing, batch))
        self.rows.append(Row(self.name, other, Timing(NOT_BUILT, others[0], tuple(others[-len(timing.warm_ms) :]))))

    def chained(self, stage: str, jitted: Any, state: Any, *args: Any, batch: int = 1) -> None:
        """Like `device`, of a function that takes its own state again, first of its results, and may use up its memory."""
        executable, build = self._bearable(stage, jitted, state, *args)
        states = [state]

        def step() -> Any:
            states[0], metrics = executable(states[0], *args)
            return states[0], metrics

        _, timing = repeated(step, self._effort, build=build)
        self.rows.append(Row(self.name, stage, timing, batch))

    def _bearable(self, stage: str, jitted: Any, *args: Any) -> tuple[Any, Build]:
        """The executable of a function, and how it was made; raises `TooMuch`."""
        executable, build = built(jitted, *args)
        why = too_much(build.cost, self._machine, free_bytes())
        if why:
            raise TooMuch(f"{stage} {why}")
        return executable, build

    def product(self) -> None:
        """Measures the matrix product that times of this group are compared with."""
        self.host(PRODUCT, matrix_product())

    def add(self, stage: str, warm_ms: list[float]) -> None:
        """Times that were measured elsewhere."""
        self.rows.append(Row(self.name, stage, Timing(NOT_BUILT, UNKNOWN, tuple(warm_ms))))
