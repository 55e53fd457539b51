"""What the machine can do, measured in the same run: memory bandwidth, float32 products, free memory."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp

from delo_jax.bench.timing import UNKNOWN, Cost
from delo_jax.geometry.se3 import full_float32

NUM_FLOATS = 1 << 24  # 64 MiB an array: more than caches hold
GEMM_SIZE = 1024
REPEATS = 10
MEMORY_SHARE, LONGEST_S = 0.6, 20.0  # of the free memory, of a call: what needs more is left out
USUAL_GAP = 3.0  # between the roofline and a call


class Machine(NamedTuple):
    """Best of several trials each."""

    bandwidth: float  # bytes/s of scale (2 arrays) or triad (3 arrays), in place, whichever is more
    gemm: float  # float32 operations/s of a product of two square matrices of `GEMM_SIZE` rows

    def least_s(self, cost: Cost) -> float:
        """No call takes less than its operations at the rate of products, or its bytes at the bandwidth; NaN where neither is known."""
        bounds = [value for value in (cost.flops / self.gemm, cost.bytes_accessed / self.bandwidth) if value == value]
        return max(bounds, default=UNKNOWN)

    def gap(self, call_ms: float, cost: Cost) -> float:
        """How many times as long as that a call takes.

        Below 1 where most bytes come from a cache; too large where loops, which count once, do most of the work.
        """
        least_s = self.least_s(cost)
        return 1e-3 * call_ms / least_s if least_s > 0 else UNKNOWN


def measure_machine(*, repeats: int = REPEATS, clock: Callable[[], float] = time.perf_counter) -> Machine:
    """Bandwidth and product rate of the default device."""
    scale = jax.jit(lambda a: 1.0001 * a, donate_argnums=0)  # in place: fresh memory would measure the operating system
    triad = jax.jit(lambda a, b: a + 1.0001 * b, donate_argnums=0)
    product, b = matrix_product(), jnp.ones(NUM_FLOATS)
    a = jax.block_until_ready(triad(scale(jnp.ones(NUM_FLOATS)), b))
    bandwidth, gemm = 0.0, 0.0
    for _ in range(repeats):
        marks = [clock()]
        a = jax.block_until_ready(scale(a))
        marks.append(clock())
        a = jax.block_until_ready(triad(a, b))
        marks.append(clock())
        jax.block_until_ready(product())
        marks.append(clock())
        rates = [amount / (after - before) for amount, before, after in zip(_amounts(), marks[:-1], marks[1:], strict=True)]
        bandwidth, gemm = max(bandwidth, *rates[:2]), max(gemm, rates[2])
    return Machine(bandwidth, gemm)


def matrix_product() -> Callable[[], jax.Array]:
    """The product that `Machine.gemm` is of, compiled; its time is the unit in which other times are compared between runs."""
    product, square = jax.jit(full_float32(jnp.matmul)), jnp.ones((GEMM_SIZE, GEMM_SIZE))
    jax.block_until_ready(product(square, square))
    return lambda: product(square, square)


def _amounts() -> tuple[float, float, float]:
    """Bytes of scale and of triad, operations of the product."""
    return 2 * 4.0 * NUM_FLOATS, 3 * 4.0 * NUM_FLOATS, 2.0 * GEMM_SIZE**3


def best(first: Machine, second: Machine) -> Machine:
    """Of two measurements."""
    return Machine(*map(max, first, second))


def free_bytes() -> float:
    """Memory that is free on the default device; NaN where nobody says."""
    device = jax.config.values["jax_default_device"] or jax.devices()[0]
    stats = device.memory_stats() or {}
    if "bytes_limit" in stats:
        return float(stats["bytes_limit"] - stats.get("bytes_in_use", 0))
    try:
        lines = Path("/proc/meminfo").read_text(encoding="utf-8").splitlines()
        return next(1024.0 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        names = os.sysconf_names if hasattr(os, "sysconf_names") else {}
        known = "SC_AVPHYS_PAGES" in names and "SC_PAGE_SIZE" in names
        return float(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")) if known else UNKNOWN


def too_much(cost: Cost, machine: Machine, free: float) -> str:
    """Why a compiled function is better not called here; empty when nothing speaks against it.

    Args:
        cost: of the function, known before any call.
        machine: rates of this machine.
        free: free memory [bytes].
    """
    expected_s = USUAL_GAP * machine.least_s(cost)
    if cost.peak_bytes > MEMORY_SHARE * free:
        return f"needs {cost.peak_bytes / 1e9:.1f} GB, {free / 1e9:.1f} GB are free"
    if expected_s > LONGEST_S:
        return f"would take about {expected_s:.0f} s a call"
    return ""
