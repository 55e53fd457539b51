"""Times of every stage of a pair, by preset and number of source points."""

import tempfile
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from delo_jax import inference, weights
from delo_jax.bench import stages
from delo_jax.bench.rows import Group, LeftOut, TooMuch
from delo_jax.config import DeloConfig
from delo_jax.data.scans import read_scan
from delo_jax.data.writers import write_bin
from delo_jax.model import delo
from delo_jax.preprocess import preprocess
from delo_jax.train.presets import PRESETS

LEAST_TARGET_POINTS = 3072
BATCH = 4  # pairs of a batched call
TOGETHER, SINGLE = "encode twice and solve", "one pair beside it"  # stages that take turns


def sized(cfg: DeloConfig, num_points: int) -> DeloConfig:
    """A network's config with N source points solved for, and M = max(3072, N) target points kept; M = N for raw scans."""
    if cfg.preprocess.sampling == "raw":
        return replace(cfg, preprocess=replace(cfg.preprocess, max_points=num_points, num_keypoints=num_points))
    wider = replace(cfg.preprocess, max_points=max(LEAST_TARGET_POINTS, num_points))
    return replace(cfg, preprocess=wider, fine=replace(cfg.fine, num_points=num_points))


def model_of(preset: str, num_points: int) -> delo.Model:
    """The released weights of `base`, random ones of other presets: times do not depend on them."""
    if preset == "base":
        released = weights.load("delo-base")
        return delo.Model(jax.device_put(released.variables), sized(released.cfg, num_points))
    return delo.init(sized(PRESETS[preset].model, num_points), jax.random.key(0))


def measure_pair(preset: str, num_points: int, scans: list[np.ndarray], group: Group, *, batched: bool = True) -> list[LeftOut]:
    """Adds a row per stage; returns what was left out, and why.

    Args:
        preset: name of the network.
        num_points: N.
        scans: two raw scans (n, 3) [m], the later one first.
        group: takes the rows.
        batched: several pairs at once, too.
    """
    jax.clear_caches()  # what another size has traced
    params = model_of(preset, num_points)
    group.product()
    try:
        _host_stages(scans[0], params.cfg, group)
        _device_stages(params, scans, group, batched)
    except TooMuch as stop:
        return [LeftOut(group.name, str(stop))]
    return []


def _host_stages(points: np.ndarray, cfg: DeloConfig, group: Group) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "000000.bin"
        write_bin(path, points)
        group.host("reading", lambda: read_scan(path, bin_columns=4))
    if cfg.preprocess.sampling == "surface":
        group.host("crop and voxels", lambda: stages.crop_and_voxels(points, cfg.preprocess))
        group.host(
            "normals and features",
            lambda voxels: stages.normals_and_features(voxels, cfg.preprocess),
            setup=lambda: (stages.crop_and_voxels(points, cfg.preprocess),),
        )
    group.host("preprocess", lambda: preprocess(points, cfg.preprocess))


def _device_stages(params: delo.Model, scans: list[np.ndarray], group: Group, batched: bool) -> None:
    """From padded scans to the pose on the host: the whole, then its parts, which profit from what was traced for it."""
    target, source = (inference.prepare(params, points) for points in scans)
    group.host("scan to device", lambda: jax.device_put(target.scan))
    identity = jnp.eye(4)
    ends = group.device("encode", inference.encode, params, source.scan), inference.encode(params, target.scan)
    result = group.device("solve", inference.solve, params, *ends, identity)
    if params.cfg.evidence.covariance_width:
        group.device("covariance", inference.pair_covariance, params, result)
    group.host("result to host", jax.device_get, setup=lambda: (inference.solve(params, *ends, identity),))  # a fresh one: copies are kept
    jax.block_until_ready(source.encoding)

    def whole() -> inference.Estimate:
        return inference.align(params, source, inference.prepare(params, scans[0]), np.eye(4))

    group.host("pair", whole)
    matching = group.device("plan", jax.jit(stages.plan), params, *ends)
    first = group.device("coarse", jax.jit(stages.coarse), params, *ends, matching)
    if params.cfg.fine.num_iters:
        finished = group.device("fine", jax.jit(stages.fine_solve), params, *ends, first, identity)
        group.device("evidence", jax.jit(stages.evidence), params, *ends, matching, first, finished)
    else:
        group.device("evidence", jax.jit(stages.evidence_unrefined), params, *ends, matching, first)
    if batched:
        _batched(params, (source.scan, target.scan), group)


def _batched(params: delo.Model, scans: tuple, group: Group) -> None:
    """Both encodings and the solution, several pairs at once, in turns with one pair."""
    start = jnp.eye(4)

    def single() -> delo.Registration:
        return inference.solve(params, *(inference.encode(params, scan) for scan in scans), start)

    def one(model: delo.Model, source, target) -> delo.Registration:
        return delo.solve(model, delo.encode(model, source), delo.encode(model, target), start)

    stacked = [jax.tree.map(lambda array: np.stack([array] * BATCH), scan) for scan in scans]
    together = jax.jit(jax.vmap(one, in_axes=(None, 0, 0)))
    group.device_beside(TOGETHER, together, params, *stacked, batch=BATCH, other=SINGLE, call=single)
