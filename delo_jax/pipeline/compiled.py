"""Compiles what a stream will call before its first scan, so that no scan waits for a compiler.

Sizes are static: scans of any number of points are padded to the one shape of their preset, neighbours are sought on the host, and a
recovery calls the same functions more often. One call of each, on a scan that shows nothing, is therefore all there is to compile.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from delo_jax import inference
from delo_jax.model.delo import Model
from delo_jax.pipeline.local_map import surfaces_of
from delo_jax.pipeline.scan_to_map import NUM_LEARNED_POINTS, REACH_M, ROBUST_STEPS, SCALE_M, SWEEP_OPTIONS, require_fine_stage


class Part(NamedTuple):
    """One of the functions that are compiled."""

    name: str
    call: Callable[[], object]
    """Compiles it where it is not yet."""


def functions(params: Model, *, use_map: bool) -> list[Part]:
    """All that odometry will call, from scan to scan or on a map.

    Raises:
        ConfigError: a map is asked for, and the network has no fine stage.
    """
    nothing = inference.prepare(params, np.zeros((0, 3), np.float32))
    found = [
        Part("encoder", lambda: nothing.encoding),
        Part("solver", lambda: inference.solve(params, nothing.encoding, nothing.encoding, np.eye(4, dtype=np.float32))),
        Part("covariance", lambda: inference.align(params, nothing, nothing, np.eye(4))),  # and whatever else a pair needs
    ]
    if not use_map:
        return found
    require_fine_stage(params)
    few, many = surfaces_of(nothing.scan, slice(0, NUM_LEARNED_POINTS)), surfaces_of(nothing.scan)
    pose, velocity, times_s = np.eye(4, dtype=np.float32), np.zeros(6, np.float32), np.zeros(len(many.points), np.float32)
    own, matched = (many.points, many.normals, many.mask), (many.points, many.normals)
    robust = {"scale_m": SCALE_M, "reach_m": REACH_M, "num_steps": ROBUST_STEPS}
    return [
        *found,
        Part("learned step", lambda: inference.fine_step(params, few, few, pose)),
        Part("classical steps", lambda: inference.robust_steps(*own, *matched, pose, **robust)),
        Part("steps of a sweep", lambda: inference.sweep_steps(*own, times_s, *matched, pose, velocity, **SWEEP_OPTIONS)),
    ]


def compile_odometry(params: Model, *, use_map: bool = True, begins: Callable[[str], None] = lambda name: None) -> float:
    """Compiles all that odometry will call, and returns how long it took [s].

    Args:
        params: weights.
        use_map: also what registers to a map.
        begins: told the name of each function before it is compiled.

    Raises:
        ConfigError: a map is asked for, and the network has no fine stage.
    """
    begin = time.perf_counter()
    for part in functions(params, use_map=use_map):
        begins(part.name)
        jax.block_until_ready(part.call())
    return time.perf_counter() - begin
