"""Plans and poses of a trained matcher, measured: what its plan looks like, and where each pose solver ends on it."""

import hashlib
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import _pairs
import jax
import jax.numpy as jnp
import numpy as np
from _pairs import Pairs

from delo_jax.config import SOLVERS, PoseConfig
from delo_jax.geometry import se3
from delo_jax.model import delo
from delo_jax.ops.matching import uniform_marginal
from delo_jax.ops.transport import marginal_excess
from delo_jax.preprocess import Scan

LOST_M, LOST_DEG, INLIER_M = 0.5, 2.0, 1.0


class PlanNumbers(NamedTuple):
    """What a plan looks like."""

    variation: Any  # standard deviation over mean of the row sums
    inlier_mass: Any  # share of the mass between points that are truly within a metre
    sharpness: Any  # largest entry of a row over its sum, averaged with the mass
    excess: Any  # relative excess of the worst row or column sum over its cap


@jax.jit
def encode(model: delo.Model, scans: Scan) -> delo.Encoding:
    """Encodings of scans with a leading axis."""
    return jax.lax.map(lambda scan: delo.encode(model, scan), scans)


@jax.jit
def measure(model: delo.Model, sources: delo.Encoding, targets: delo.Encoding, Ts_true: jax.Array):
    """Numbers of the plans, and the errors [m, rad] of every solver, pair by pair."""

    def one(pair):
        source, target, T_true = pair
        plan = delo.match(model, source, target).plan
        errors = []
        for solver in SOLVERS:
            solved = delo.coarse(delo.Model(model.variables, replace(model.cfg, pose=PoseConfig(solver=solver))), source, target, plan)
            error = se3.inverse(solved.T_target_source) @ T_true
            errors.append(jnp.stack([jnp.linalg.norm(error[:3, 3]), se3.rotation_angle(error[:3, :3])]))
        return describe(plan, source, target, T_true), jnp.stack(errors)

    return jax.lax.map(one, (sources, targets, Ts_true))


def describe(plan, source: delo.Encoding, target: delo.Encoding, T_true) -> PlanNumbers:
    """Numbers of one plan."""
    rows, total = jnp.sum(plan, axis=1), jnp.sum(plan) + 1e-12
    mask = source.keypoint_mask
    count = jnp.maximum(jnp.sum(mask), 1)
    mean = total / count
    variation = jnp.sqrt(jnp.sum(jnp.where(mask, (rows - mean) ** 2, 0.0)) / count) / mean
    moved = se3.transform(T_true, source.keypoints)
    squared = sum((moved[:, None, axis] - target.keypoints[None, :, axis]) ** 2 for axis in range(3))
    excess = marginal_excess(plan, uniform_marginal(mask), uniform_marginal(target.keypoint_mask))
    return PlanNumbers(
        variation, jnp.sum(jnp.where(squared < INLIER_M**2, plan, 0.0)) / total, jnp.sum(jnp.max(plan, axis=1)) / total, excess
    )


def rows_of(tree: Any, rows: np.ndarray) -> Any:
    """These rows of every array."""
    return jax.tree.map(lambda array: array[rows], tree)


def remembered(model: delo.Model, both: Pairs, folder: Path) -> tuple[PlanNumbers, np.ndarray]:
    """`measure_all`, kept in `folder` under a name that says what was measured, so that a study that goes on measures nothing twice."""
    content = hashlib.sha256(repr(model.cfg).encode())
    for array in (*jax.tree.leaves(jax.device_get(model.variables)), *both.frames, *both[1:]):
        content.update(np.ascontiguousarray(array).tobytes())
    path = folder / f"measured_{content.hexdigest()[:16]}.npz"
    if not path.exists():
        numbers, errors = measure_all(model, both)
        folder.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}.part.npz")
        np.savez(part, **numbers._asdict(), errors=errors)
        part.replace(path)
    with np.load(path) as stored:
        return PlanNumbers(*(stored[name] for name in PlanNumbers._fields)), stored["errors"]


def measure_all(model: delo.Model, both: Pairs, size: int = 100) -> tuple[PlanNumbers, np.ndarray]:
    """`measure` of all pairs, in pieces of one shape: numbers (n,), errors (n, solvers, 2)."""
    num_frames, num = len(both.frames.mask), len(both.source)
    used = np.unique(np.r_[both.source, both.target])
    encoded = [jax.device_get(encode(model, rows_of(both.frames, used[rows]))) for rows in _pairs.in_pieces(len(used), size)]
    encodings = jax.tree.map(lambda *arrays: np.concatenate(arrays), *encoded)
    place = np.zeros(num_frames, int)
    place[used] = np.arange(len(used))
    pieces = []
    for rows in _pairs.in_pieces(num, size):
        ends = rows_of(encodings, place[both.source[rows]]), rows_of(encodings, place[both.target[rows]])
        pieces.append(jax.device_get(measure(model, *ends, both.T_target_source[rows].astype(np.float32))))
    numbers = PlanNumbers(*(np.concatenate(values)[:num] for values in zip(*(piece[0] for piece in pieces), strict=True)))
    return numbers, np.concatenate([piece[1] for piece in pieces])[:num]


def lost(errors: np.ndarray) -> np.ndarray:
    """Whether each pair is off by more than the limits; an error that is no number is."""
    return ~((errors[..., 0] <= LOST_M) & (np.degrees(errors[..., 1]) <= LOST_DEG))


def interval(values: np.ndarray, group: np.ndarray, statistic, seed: int = 0) -> tuple[float, float]:
    """95 % bootstrap interval of a statistic of `values`, (seeds, pairs): groups of pairs are drawn, with all their seeds."""
    rng, members = np.random.default_rng(seed), [np.flatnonzero(group == number) for number in np.unique(group)]
    draws = []
    for _ in range(400):
        rows = np.concatenate([members[number] for number in rng.integers(len(members), size=len(members))])
        draws.append(statistic(values[:, rows]))
    return float(np.percentile(draws, 2.5)), float(np.percentile(draws, 97.5))


def timing(models: dict[str, delo.Model], both: Pairs) -> None:
    """Milliseconds of plan and of each solver, one pair at a time, compiled and warm, sources in turn."""
    scans = [rows_of(both.frames, frames[0]) for frames in (both.source, both.target)]
    functions: dict = {}
    for name, model in models.items():
        source, target = (jax.jit(delo.encode)(model, scan) for scan in scans)
        plan_of = jax.jit(lambda s, t, model=model: delo.match(model, s, t).plan)
        functions[name, "plan"] = plan_of, (source, target)
        plan = plan_of(source, target)
        for solver in SOLVERS:
            solving = delo.Model(model.variables, replace(model.cfg, pose=PoseConfig(solver=solver)))
            functions[name, solver] = jax.jit(lambda s, t, p, m=solving: delo.coarse(m, s, t, p)), (source, target, plan)
    spent: dict = {key: [] for key in functions}
    for number in range(23):
        for key, (function, arguments) in functions.items():
            begin = time.perf_counter()
            jax.block_until_ready(function(*arguments))
            spent[key] += [1e3 * (time.perf_counter() - begin)] if number >= 3 else []
    print(f"\n### Time of one pair, warm, median of 20 [ms]\n\n| matching | plan | {' | '.join(SOLVERS)} |\n|---|{'---:|' * 4}")
    for name in models:
        print(f"| {name} | " + " | ".join(f"{np.median(spent[name, part]):.1f}" for part in ("plan", *SOLVERS)) + " |")
