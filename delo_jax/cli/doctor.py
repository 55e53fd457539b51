"""`delo doctor`: does it work on this machine?"""

import dataclasses
import os
import platform
import statistics
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple

from delo_jax.cli.command import Command
from delo_jax.errors import DeloError

PACKAGES = ("jax", "numpy", "scipy", "flax", "safetensors", "matplotlib", "gtsam")
BOUND_CM, BOUND_DEG = 5.0, 0.3  # of the self-test, about twice what range noise alone leaves
NUM_TIMED = 10


class Check(NamedTuple):
    """One line of the report."""

    what: str
    found: str
    remedy: str = ""
    """What to do; empty when the check passed."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Doctor(Command):
    """Versions, devices, weights, compile times and a self-test on a simulated pair.

    Example: delo doctor
    """

    weights: str = "delo-base"
    """Weights for the self-test: released ones by name, or a .safetensors file."""

    def run(self) -> int:
        """Prints one line per check; 1 if one failed."""
        from delo_jax.cli.console import print_table, working

        with working("checking"):
            checks = [*_versions(), *_devices(), *_weights(), *_works(self.weights)]
        rows = [(check.what, check.found, "problem" if check.remedy else "ok", check.remedy) for check in checks]
        print_table("doctor", ("check", "found", "state", "remedy"), rows)
        return int(any(check.remedy for check in checks))


def _versions() -> Iterator[Check]:
    yield Check("python", platform.python_version())
    for name in PACKAGES:
        try:
            yield Check(name, version(name))
        except PackageNotFoundError:
            yield Check(name, "missing", f"pip install {name}")


def _devices() -> Iterator[Check]:
    import jax

    try:
        names = [device.device_kind for device in jax.devices()]
        yield Check("devices", f"{', '.join(names)}; {os.cpu_count()} cores")
        yield Check("compiled code", jax.config.values["jax_compilation_cache_dir"] or "not kept")
    except RuntimeError as error:
        yield Check("devices", " ".join(str(error).split())[:200], "set JAX_PLATFORMS=cpu, or reinstall jax for this machine")


def _weights() -> Iterator[Check]:
    from delo_jax import weights

    names = weights.released()
    if not names:
        yield Check("released weights", "none", "reinstall delo-jax: its weights are part of the package")
    for name in names:
        try:
            weights.load(name)
            yield Check(f"weights {name}", f"hash ok, SHA-256 {weights.read_card(name)['sha256'][:12]}...")
        except DeloError as error:
            yield Check(f"weights {name}", str(error), "reinstall delo-jax")


def _works(name: str) -> Iterator[Check]:
    """Compile times, the self-test and the time of a pair."""
    import numpy as np

    import delo_jax
    from delo_jax.metrics.registration import pose_errors
    from delo_jax.pipeline.compiled import compile_odometry
    from delo_jax.sim import simulate_drive

    try:
        params = delo_jax.load(name)
    except DeloError as error:
        yield Check("self-test", f"not run: {error}", "give weights that can be used by --weights")
        return
    yield Check("compiling odometry", f"{compile_odometry(params, use_map=params.cfg.fine.num_iters > 0):.1f} s")
    begin = time.perf_counter()
    target, source = simulate_drive("mixed", 500_103, 2)
    yield Check("compiling the simulator", f"{time.perf_counter() - begin:.1f} s")
    estimate, seconds = _timed(params, source.points, target.points)
    T_true = np.linalg.inv(target.T_world_lidar) @ source.T_world_lidar
    errors = pose_errors(estimate.T_target_source[None], T_true[None])
    cm, deg = 100 * float(errors.translation_m[0]), float(np.rad2deg(errors.rotation_rad[0]))
    good = cm <= BOUND_CM and deg <= BOUND_DEG and estimate.status == "ok"
    remedy = "" if good else f"expected at most {BOUND_CM:g} cm, {BOUND_DEG:g} deg and ok; reinstall, then report it with this table"
    yield Check("self-test: a simulated pair", f"{cm:.1f} cm, {deg:.3f} deg, {estimate.status}", remedy)
    yield Check("time of a pair, no scan cached", f"{1e3 * seconds:.0f} ms (median of {NUM_TIMED})")


def _timed(params: Any, source: Any, target: Any) -> tuple[Any, float]:
    """The estimate of a pair and the median time [s] it takes."""
    import delo_jax

    seconds = []
    for _ in range(NUM_TIMED):
        begin = time.perf_counter()
        estimate = delo_jax.odometry(params, source, target)
        seconds.append(time.perf_counter() - begin)
    return estimate, statistics.median(seconds)
