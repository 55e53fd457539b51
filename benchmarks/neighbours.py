"""Nearest neighbours six ways: in XLA by arg-min, top-k, approximate minimum or an arg-min packed in integers, and by a tree on the host.

Sources and targets are points of one simulated scan, prepared; the targets of the larger rows are those of several. The tree is timed
with its building (a scan is asked once) and without (a map's tree is asked several times a frame); results on the host are on the way to
the device again. All ways take turns; medians.

Run:     python benchmarks/neighbours.py [--quick]     (about a minute on 2 cores)
Expect:  the packed arg-min at least twice as fast as the other exact ways in XLA; exits 1 otherwise.
"""

import argparse
import functools
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from delo_jax.bench.suite import device_line
from delo_jax.config import PreprocessConfig
from delo_jax.geometry.neighbors import tree_of
from delo_jax.ops.knn import nearest
from delo_jax.preprocess import preprocess
from delo_jax.sim import simulate_drive

SIZES = ((512, 3072), (1024, 3072), (3072, 3072), (512, 9216), (3072, 9216))
CALLS, QUICK_CALLS, WARM_UP = 40, 5, 3
SEED, AT_LEAST = 1_741_000, 2.0


def squared(sources: jax.Array, targets: jax.Array) -> jax.Array:
    """(n, m)."""
    x, y, z = (sources[:, None, axis] - targets[None, :, axis] for axis in range(3))
    return x * x + y * y + z * z


PACKED = "packed arg-min"
WAYS: dict[str, Callable] = {
    PACKED: lambda sources, targets: nearest(sources, targets, jnp.ones(len(targets), bool))[0],
    "argmin": lambda sources, targets: jnp.argmin(squared(sources, targets), axis=1),
    "top_k": lambda sources, targets: jax.lax.top_k(-squared(sources, targets), 1)[1][:, 0],
    "approx_min_k": lambda sources, targets: jax.lax.approx_min_k(squared(sources, targets), 1)[1][:, 0],
}
EXACT = "argmin", "top_k"


def measure(sources: np.ndarray, targets: np.ndarray, calls: int) -> dict[str, np.ndarray]:
    """Milliseconds of every call, by way."""
    on_device, tree = (jnp.asarray(sources), jnp.asarray(targets)), tree_of(targets)
    ways: dict[str, Callable] = {name: functools.partial(jax.jit(way), *on_device) for name, way in WAYS.items()}
    ways["tree, asked"] = lambda: jnp.asarray(tree.query(np.asarray(on_device[0]))[1])
    ways["tree, built and asked"] = lambda: jnp.asarray(tree_of(targets).query(np.asarray(on_device[0]))[1])
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(WARM_UP + calls):
        for name, way in ways.items():
            begin = time.perf_counter()
            jax.block_until_ready(way())
            times[name].append(1e3 * (time.perf_counter() - begin))
    return {name: np.array(values[WARM_UP:]) for name, values in times.items()}


def main() -> int:
    """Measure, print, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_CALLS} calls, no verdict")
    args = parser.parse_args()
    scans = [preprocess(scan.points, PreprocessConfig()) for scan in simulate_drive("urban", SEED, 4)]
    points = np.concatenate([scan.points[scan.mask] + np.float32(0.2 * number) for number, scan in enumerate(scans)])
    print(f"| sources | targets | {' | '.join([*WAYS, 'tree, asked', 'tree, built and asked'])} |\n|---:|---:|{'---:|' * (len(WAYS) + 2)}")
    worst = np.inf
    for num_sources, num_targets in SIZES:
        found = measure(points[:num_sources] + np.float32(0.1), points[:num_targets], QUICK_CALLS if args.quick else CALLS)
        medians = {name: float(np.median(values)) for name, values in found.items()}
        worst = min(worst, *(medians[name] / medians[PACKED] for name in EXACT))
        print(f"| {num_sources} | {min(num_targets, len(points))} | {' | '.join(f'{value:.2f} ms' for value in medians.values())} |")
    print(f"\n{device_line()}; the packed arg-min is at least {worst:.1f} times as fast as {' and '.join(EXACT)}", end="")
    print("; quick run, no verdict" if args.quick else f" (bound: {AT_LEAST:g})")
    return 0 if args.quick or worst >= AT_LEAST else 1


if __name__ == "__main__":
    sys.exit(main())
