"""Covariances that fit the errors: pairs of worlds that no training has seen, and a small head fitted on them."""

import functools
import hashlib
import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from scipy.stats import norm

from delo_jax import inference
from delo_jax.geometry import se3
from delo_jax.model import delo
from delo_jax.ops import spread
from delo_jax.ops.evidence import NIG
from delo_jax.train.worlds import SIMULATOR, World, scan_of, stored_world, write_arrays
from delo_jax.uncertainty import gate

NUM_FRAMES = 6
FRAMES = tuple(itertools.permutations(range(NUM_FRAMES), 2))  # (source, target) of a world's pairs
WIDTH = 8
WEIGHT_DECAY = 1e-2
NUM_FOLDS = 4
MAX_STEPS = 1000
LEVELS = (0.68, 0.95)  # coverages between which the last scale of each axis is chosen


class Pairs(NamedTuple):
    """Solved pairs of worlds and what they got wrong, row by row."""

    errors: np.ndarray  # (n, 6) float64: log(T_estimated^-1 T_true), [omega, v]
    Ts_target_source: np.ndarray  # (n, 4, 4) estimated
    statistics: np.ndarray  # (n, s)
    nig: NIG  # arrays (n, 6)
    confidence: np.ndarray  # (n,)
    information: np.ndarray  # (n, 6, 6)
    worlds: np.ndarray  # (n,) number of the world
    gaps: np.ndarray  # (n,) frames from source to target

    def rows(self, which: np.ndarray) -> "Pairs":
        """Some of them."""
        return jax.tree.map(lambda array: array[which], self)

    def lost(self, model: delo.Model) -> np.ndarray:
        """Which are off by more than the config's limits."""
        limits = model.cfg.status
        far = np.linalg.norm(self.errors[:, 3:], axis=1) > limits.lost_translation_m
        return far | (np.linalg.norm(self.errors[:, :3], axis=1) > np.radians(limits.lost_rotation_deg))


def stored_pairs(
    folder: Path, name: str, model: delo.Model, count: int, seed: int, *, on_world: Callable[[], None] = lambda: None
) -> Pairs:
    """Pairs of the worlds `seed`, `seed + 1`, ..., read from `folder`, or solved and written there with their worlds.

    Args:
        folder: store; pairs of other weights do not get mixed up, since the file name holds a fingerprint.
        name: of these worlds.
        model: weights.
        count: how many worlds.
        seed: of the first.
        on_world: called after each world, for progress.
    """
    folder.mkdir(parents=True, exist_ok=True)
    key, rows = fingerprint(model, SIMULATOR, seed, FRAMES), []
    for index in range(count):
        path = folder / f"{name}_pairs_{key}_{index:05d}.npz"
        if not path.exists():
            world = stored_world(folder, name, index, seed, num_frames=NUM_FRAMES, cfg=model.cfg.preprocess)
            pairs = solved_pairs(model, world, index)
            write_arrays(path, **{field: array for field, array in pairs._asdict().items() if field != "nig"}, **pairs.nig._asdict())
        with np.load(path) as stored:
            nig = NIG(*(stored[field] for field in NIG._fields))
            rows.append(Pairs(**{field: nig if field == "nig" else stored[field] for field in Pairs._fields}))
        on_world()
    return jax.tree.map(lambda *arrays: np.concatenate(arrays), *rows)


def fingerprint(model: delo.Model, *what: Any) -> str:
    """Eight characters that change with the network, its settings, or anything else that results depend on; not with a calibration."""
    cfg = replace(model.cfg, evidence=replace(model.cfg.evidence, covariance_width=0))
    digest = hashlib.sha256(json.dumps([*what, asdict(cfg)]).encode())
    for array in jax.tree.leaves(jax.device_get(model.variables["params"])):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:8]


def solved_pairs(model: delo.Model, world: World, number: int) -> Pairs:
    """The pairs `FRAMES` of a world of `NUM_FRAMES` scans, from the identity and without a motion prior."""
    encodings, rows = [inference.encode(model, scan_of(world, frame, model.cfg.preprocess)) for frame in range(NUM_FRAMES)], []
    for source, target in FRAMES:
        T_true = se3.inverse(world.Ts_world_lidar[target]) @ world.Ts_world_lidar[source]
        rows.append(solved_pair(model, encodings[source], encodings[target], T_true)._replace(gaps=np.array(target - source)))
    return joined(rows)._replace(worlds=np.full(len(rows), number))


def joined(rows: Sequence[Pairs]) -> Pairs:
    """Single rows as a table."""
    return jax.tree.map(lambda *arrays: np.stack(arrays), *rows)


def solved_pair(model: delo.Model, source: delo.Encoding, target: delo.Encoding, T_true: np.ndarray) -> Pairs:
    """One row, from the identity and without a motion prior: of world 0, at gap 1."""
    result = jax.device_get(inference.solve(model, source, target, jnp.eye(4)))
    T = se3.orthonormal(np.asarray(result.T_target_source, np.float64))
    error = se3.log(se3.inverse(T) @ T_true)
    return Pairs(error, T, result.statistics, result.nig, result.confidence, result.information, np.array(0), np.array(1))


def halves(model: delo.Model, weights: spread.Weights, pairs: Pairs) -> np.ndarray:
    """(n, 6, 6) float64 H with H H^T the covariance of each pair."""
    units = delo.evidence_units(model.cfg)
    said = _said(pairs, units)
    one = jax.vmap(spread.half, in_axes=(None, 0, 0, None))
    return np.asarray(jax.jit(one)(weights, said, pairs.Ts_target_source.astype(np.float32), units), np.float64)


def doubts(model: delo.Model, weights: spread.Weights, pairs: Pairs) -> np.ndarray:
    """(n,) float64 share of each covariance that is doubt of the model."""
    said = _said(pairs, delo.evidence_units(model.cfg))
    return np.asarray(jax.jit(jax.vmap(spread.doubt, in_axes=(None, 0)))(weights, said), np.float64)


def fit(
    model: delo.Model,
    pairs: Pairs,
    counts: np.ndarray | None = None,
    *,
    seed: int = 0,
    likelihood: Callable[..., jax.Array] = spread.negative_log_likelihood,
    more: spread.Weights | None = None,
) -> spread.Weights:
    """Weights of `ops.spread` that make the errors of these pairs most likely, lost pairs apart (BFGS of optimistix).

    Args:
        model: weights.
        pairs: from `stored_pairs`.
        counts: (n,) how many times each pair counts, 0 for none; once each by default.
        seed: of the hidden layer's start.
        likelihood: minus the logarithm of it, of one pair.
        more: start of further numbers that this likelihood reads from the weights.
    """
    counts = np.where(pairs.lost(model), 0, np.ones(len(pairs.errors), int) if counts is None else counts)
    units = delo.evidence_units(model.cfg)
    said = _said(pairs, units)
    start = spread.init(said.shape[1], WIDTH, jax.random.key(seed)) | (more or {})
    counted = said[np.repeat(np.arange(len(counts)), counts)]
    fixed = {"mean": jnp.mean(counted, axis=0), "deviation": jnp.std(counted, axis=0) + 1e-3, "whitener": spread.whitener(counted)}
    free = {name: array for name, array in start.items() if name not in fixed}
    rows = said, jnp.asarray(pairs.Ts_target_source, jnp.float32), jnp.asarray(pairs.errors, jnp.float32)
    solver: Any = optimistix.BFGS(rtol=1e-5, atol=1e-6)
    given = fixed, jnp.asarray(counts, jnp.float32), rows, units
    return optimistix.minimise(_loss(likelihood), solver, free, args=given, max_steps=MAX_STEPS, throw=False).value | fixed


@functools.cache
def _loss(likelihood: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """What a fit minimises; one function for all fits, so that it is compiled once."""
    by_pair = jax.vmap(likelihood, in_axes=(None, 0, 0, 0, None))

    def loss(free, given):
        fixed, counts, rows, units = given
        decay = sum(jnp.sum(free[name] ** 2) for name in ("hidden", "out", "direct"))
        return jnp.sum(counts * by_pair(free | fixed, *rows, units)) / jnp.sum(counts) + WEIGHT_DECAY * decay

    return loss


def calibrate(model: delo.Model, pairs: Pairs, on_fit: Callable[[], None] = lambda: None) -> tuple[delo.Model, np.ndarray]:
    """The model with a fitted covariance and the gate's quantiles, and covariances (n, 6, 6) of the pairs by fits without their worlds.

    Covariances of worlds that a fit has seen are too small for others; by how much, the unseen ones say. Each axis, in the frame of the
    motion, is scaled so that its coverage at 68 % is too high by no more than that at 95 % is too low: errors have heavier tails than a
    Gaussian, so that no one factor satisfies both.

    Args:
        model: weights.
        pairs: from `stored_pairs`.
        on_fit: called after each of the five fits, for progress.
    """
    unseen = np.zeros((len(pairs.errors), 6, 6))
    for fold in range(NUM_FOLDS):
        away = pairs.worlds % NUM_FOLDS == fold
        H = halves(model, fit(model, pairs, np.where(away, 0, 1)), pairs.rows(np.flatnonzero(away)))
        unseen[away] = H @ H.transpose(0, 2, 1)
        on_fit()
    good = ~pairs.lost(model)
    turns = np.asarray(jax.vmap(spread.motion_frame)(jnp.asarray(pairs.Ts_target_source, jnp.float32)), np.float64)
    backs = turns.transpose(0, 2, 1)
    scale = _scale((backs @ pairs.errors[:, :, None])[good, :, 0], (backs @ unseen @ turns)[good])
    weights = fit(model, pairs)
    on_fit()
    weights["out_bias"] = weights["out_bias"].at[spread.DIAGONAL].add(np.log(scale))
    scaled = turns @ np.diag(scale) @ backs
    unseen = scaled @ unseen @ scaled.transpose(0, 2, 1)
    epistemic = doubts(model, weights, pairs)[:, None] * np.diagonal(unseen, axis1=1, axis2=2)
    evidence: Any = replace(model.cfg.evidence, covariance_width=WIDTH)
    variables = model.variables | {"covariance": weights, gate.NAME: gate.Quantiles.fit(epistemic[good]).stored()}
    return delo.Model(variables, replace(model.cfg, evidence=evidence)), unseen


def _scale(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """(6,) what the standard deviations have to be multiplied by, for coverages that add up to those of a Gaussian."""
    sizes = np.abs(errors) / np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    wanted = [sizes / norm.ppf(0.5 + 0.5 * level) for level in LEVELS]
    return np.quantile(np.concatenate(wanted), np.mean(LEVELS), axis=0)


def _said(pairs: Pairs, units) -> jax.Array:
    """(n, i) inputs of the head."""
    one = jax.vmap(spread.inputs, in_axes=(0, 0, 0, None))
    return one(jnp.asarray(pairs.statistics), jax.tree.map(jnp.asarray, pairs.nig), jnp.asarray(pairs.confidence), units)
