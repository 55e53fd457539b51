"""The stages of a pair, each as a function of its own. Together they are `preprocess` and `delo.solve`; tests hold them to that."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from delo_jax import preprocess as pre
from delo_jax.config import PreprocessConfig
from delo_jax.geometry import se3
from delo_jax.geometry.neighbors import meanwhile, tree_of
from delo_jax.geometry.se3 import full_float32
from delo_jax.model import delo, fine
from delo_jax.model.coarse import CoarsePose, point_information
from delo_jax.model.delo import Applicable, Encoding, Matching, Registration
from delo_jax.model.statistics import consensus, statistics


class Voxels(NamedTuple):
    """A scan after crop and voxels."""

    cloud: np.ndarray  # (v, 3) means of the voxels [m]
    rows: np.ndarray  # (p,) of the cloud, those that are described
    rng: np.random.Generator  # as it stands then


class Finished(NamedTuple):
    """What the fine stage hands on."""

    T_target_source: Float[Array, "4 4"]
    hypotheses: Float[Array, "2 4 4"]
    scores: Float[Array, "2"]  # of the hypotheses
    best: Int[Array, ""]


def crop_and_voxels(points: np.ndarray, cfg: PreprocessConfig) -> Voxels:
    """First half of `preprocess` of a scan without times, surface sampling.

    Args:
        points: (n, 3) in the sensor frame [m].
        cfg: sizes and thresholds.
    """
    rng = np.random.default_rng(0)
    columns = pre._crop(points.take(pre._thinned(len(points), cfg.max_raw_points, rng), axis=0), cfg)
    cloud = pre.voxel_mean(columns, cfg.voxel_m)
    return Voxels(np.ascontiguousarray(cloud), pre.one_per_voxel(cloud, cfg.point_voxel_m, rng)[: 2 * cfg.max_points], rng)


def normals_and_features(voxels: Voxels, cfg: PreprocessConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Second half: points, normals and features that are kept, and the rows of the key points, without padding."""
    centers, normals, features, valid = pre._describe(voxels.cloud, meanwhile(tree_of, voxels.cloud), voxels.rows, cfg)
    kept = pre._select(normals, valid, cfg, voxels.rng)
    points, normals = centers[kept], normals[kept]
    return points, normals, features[kept], pre._keypoints(points, normals, cfg, voxels.rng)


@full_float32
def plan(model: Applicable, source: Encoding, target: Encoding) -> Matching:
    """Descriptors in context, scores and transport."""
    return delo.match(model, source, target)


@full_float32
def coarse(model: Applicable, source: Encoding, target: Encoding, matching: Matching) -> CoarsePose:
    """Pose from the plan."""
    return delo.coarse(model, source, target, matching.plan)


@full_float32
def fine_solve(model: Applicable, source: Encoding, target: Encoding, first: CoarsePose, T_init: Float[Array, "4 4"]) -> Finished:
    """Both hypotheses on half of the points, the choice, and the rest of the iterations on all of them."""
    cfg = model.cfg.fine
    points, half = (jax.tree.map(lambda array, num=num: array[:num], source.cloud) for num in (cfg.num_points, cfg.num_points // 2))
    starts, num_first = jnp.stack([T_init, first.T_target_source]), cfg.num_iters // 2
    refined = jax.vmap(lambda T: delo.refine_pose(model, half, target.cloud, T, num_iters=num_first)[-1])(starts)
    scores = jax.vmap(lambda T: consensus(fine.match(model.confidence, half, target.cloud, T)))(refined)
    best = jnp.argmax(scores)
    T = delo.refine_pose(model, points, target.cloud, refined[best], num_iters=cfg.num_iters - num_first)[-1]
    return Finished(T, refined, scores, best)


@full_float32
def evidence(
    model: Applicable, source: Encoding, target: Encoding, matching: Matching, first: CoarsePose, finished: Finished
) -> Registration:
    """Information, statistics and evidence at the finished pose."""
    T, cfg, best = finished.T_target_source, model.cfg.fine, finished.best
    points = jax.tree.map(lambda array: array[: cfg.num_points], source.cloud)
    matches = fine.match(model.confidence, points, target.cloud, T)
    T_delta, information = fine.step(matches, cfg=cfg)
    disagreement = se3.inverse(finished.hypotheses[1 - best]) @ finished.hypotheses[best]
    stats = statistics(matches, information, T, T_delta, disagreement, first.inlier_share, finished.scores[1 - best])
    planes = fine.plane_information(matches, T)
    finite = jnp.all(jnp.isfinite(T)) & jnp.all(jnp.isfinite(stats)) & jnp.all(jnp.isfinite(planes))
    nig, confidence = delo.predict_evidence(model, source, target, matching, T, stats)
    return Registration(T, planes, nig, confidence, stats, best == 1, finite)


@full_float32
def evidence_unrefined(model: Applicable, source: Encoding, target: Encoding, matching: Matching, first: CoarsePose) -> Registration:
    """The same of a preset without a fine stage."""
    T, nothing = first.T_target_source, jnp.zeros(0)
    finite = jnp.all(jnp.isfinite(T)) & first.determined
    nig, confidence = delo.predict_evidence(model, source, target, matching, T, nothing)
    return Registration(T, point_information(source.keypoints, first.weights), nig, confidence, nothing, jnp.ones((), bool), finite)
