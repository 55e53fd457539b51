"""The model: one params pytree, `encode` once per scan, `solve` once per pair. Pure functions; the caller jits."""

import dataclasses
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from delo_jax.config import NUM_FEATURES, DeloConfig
from delo_jax.geometry import se3
from delo_jax.geometry.point_to_plane import point_to_plane_step
from delo_jax.geometry.se3 import full_float32
from delo_jax.model import fine
from delo_jax.model.coarse import CoarsePose, coarse_pose
from delo_jax.model.dgcnn import EdgeEncoder
from delo_jax.model.evidential import EvidenceHead
from delo_jax.model.matching import Temperature
from delo_jax.model.statistics import NUM_STATISTICS, consensus, statistics
from delo_jax.ops import evidence
from delo_jax.ops.knn import knn
from delo_jax.ops.transport import matching_cost


class Network(nn.Module):
    """All trained layers; each method is one of them."""

    cfg: DeloConfig

    def setup(self):
        """Name the layers."""
        self.encoder = EdgeEncoder(self.cfg.coarse)
        self.matcher = Temperature()
        self.point_embedding = fine.PointEmbedding(self.cfg.fine)
        self.edge_network = fine.EdgeNetwork(self.cfg.fine)
        self.evidence_head = EvidenceHead(self.cfg.evidence)

    def embed(self, features):
        """Point embeddings of the fine stage."""
        return self.point_embedding(features)

    def describe(self, points, features, index, mask):
        """Descriptors of key points."""
        return self.encoder(points, features, index, mask)

    def temperature(self):
        """Factor on the cosine similarities of descriptors."""
        return self.matcher()

    def confidence(self, source, target, geometry):
        """Logits of the fine stage."""
        return self.edge_network(source, target, geometry)

    def evidence(self, statistics):
        """Raw evidence."""
        return self.evidence_head(statistics)

    def everything(self, points, features, geometry, statistics):
        """One call of every layer, for `init`."""
        index = jnp.zeros((points.shape[0], self.cfg.coarse.num_neighbors), jnp.int32)
        descriptors = self.describe(points, jnp.concatenate([points, features], -1), index, jnp.ones(points.shape[0], bool))
        embedding = self.embed(features)
        return descriptors, self.temperature(), self.confidence(embedding, embedding, geometry), self.evidence(statistics)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Model:
    """Weights and the config they belong to. Arrays are leaves, the config is static."""

    variables: dict[str, Any]
    cfg: DeloConfig = dataclasses.field(metadata={"static": True})

    def apply(self, method: str, *args):
        """One layer of the network with these weights."""
        return Network(self.cfg).apply(self.variables, *args, method=method)

    def confidence(self, source, target, geometry):
        """Logits of the fine stage, as a function to pass on."""
        return self.apply("confidence", source, target, geometry)


class Encoding(NamedTuple):
    """What is computed once per scan and kept."""

    cloud: fine.Cloud
    keypoints: Float[Array, "k 3"]
    keypoint_normals: Float[Array, "k 3"]
    keypoint_mask: Bool[Array, " k"]
    descriptors: Float[Array, "k d"]


class Registration(NamedTuple):
    """Answer of one pair; arrays only."""

    T_target_source: Float[Array, "4 4"]
    information: Float[Array, "6 6"]  # of the planes, for a right perturbation of the pose, per unit of weight
    nig: evidence.NIG  # of log(T_pred^-1 T_true), order [omega, v], rad and m
    confidence: Float[Array, ""]  # probability that the pair is not lost
    statistics: Float[Array, " s"]
    used_coarse: Bool[Array, ""]  # the pose came from the coarse stage, not from T_init
    finite: Bool[Array, ""]


def init(cfg: DeloConfig, key: Key[Array, ""]) -> Model:
    """Model with random weights, for training only."""
    points, features = jnp.zeros((4, 3)), jnp.zeros((4, NUM_FEATURES))
    geometry, _, _ = fine.match_geometry(points, points, points, points, jnp.ones(4, bool))
    variables = Network(cfg).init(key, points, features, geometry, jnp.zeros(NUM_STATISTICS), method="everything")
    return Model(dict(variables), cfg)


def encode(model: Model, scan) -> Encoding:
    """Point embeddings and key point descriptors of a `Scan`."""
    cloud = fine.Cloud(scan.points, scan.normals, model.apply("embed", scan.features), scan.mask)
    rows, mask = scan.keypoint_index, scan.keypoint_mask
    points, normals = scan.points[rows], scan.normals[rows]
    index = knn(points, mask, model.cfg.coarse.num_neighbors)
    features = jnp.concatenate([normals, scan.features[rows]], axis=-1)
    return Encoding(cloud, points, normals, mask, model.apply("describe", points, features, index, mask))


def matching_scores(model: Model, source: Encoding, target: Encoding) -> Float[Array, "n m"]:
    """Scores between the key points of two scans."""
    return model.apply("temperature") * (source.descriptors @ target.descriptors.T)


def coarse(model: Model, source: Encoding, target: Encoding) -> CoarsePose:
    """Pose with no prior, from the key points alone."""
    cost = matching_cost(source.descriptors, target.descriptors, model.apply("temperature"), target.keypoint_mask)
    return coarse_pose(cost, source.keypoints, target.keypoints, source.keypoint_mask, target.keypoint_mask, cfg=model.cfg.coarse)


def refine_pose(model: Model, source: fine.Cloud, target: fine.Cloud, T_init, *, num_iters: int) -> Float[Array, "t 4 4"]:
    """Fine stage from a start; `target` is any cloud with normals and embeddings."""
    return fine.refine(model.confidence, source, target, T_init, num_iters=num_iters, cfg=model.cfg.fine)


@full_float32
def solve(model: Model, source: Encoding, target: Encoding, T_init: Float[Array, "4 4"]) -> Registration:
    """Pose of a pair, its information, evidence and statistics.

    Two hypotheses, the start and the coarse pose, are refined side by side on half of the points; the one that more
    points agree with is finished on all of them. A good start is never spoilt by a bad coarse pose,
    and a bad start never hides a good one.

    Args:
        model: weights and config.
        source: encoding of the source scan.
        target: encoding of the target scan.
        T_init: start; the identity when nothing is known.

    Returns:
        Registration with T_target_source.
    """
    cfg = model.cfg.fine
    points, half = _first(source.cloud, cfg.num_points), _first(source.cloud, cfg.num_points // 2)
    first = coarse(model, source, target)
    starts = jnp.stack([T_init, first.T_target_source])
    num_first = cfg.num_iters // 2
    refined = jax.vmap(lambda T: refine_pose(model, half, target.cloud, T, num_iters=num_first)[-1])(starts)
    scores = jax.vmap(lambda T: consensus(fine.match(model.confidence, half, target.cloud, T)))(refined)
    best = jnp.argmax(scores)
    T = refine_pose(model, points, target.cloud, refined[best], num_iters=cfg.num_iters - num_first)[-1]
    matches = fine.match(model.confidence, points, target.cloud, T)
    T_delta, information = fine.step(matches, cfg=cfg)
    disagreement = se3.inverse(refined[1 - best]) @ refined[best]
    stats = statistics(matches, information, T, T_delta, disagreement, first.inlier_share, scores[1 - best])
    nig, success_logit = predict_evidence(model, stats)
    planes = _plane_information(matches, T)
    finite = jnp.all(jnp.isfinite(T)) & jnp.all(jnp.isfinite(stats)) & jnp.all(jnp.isfinite(planes))
    return Registration(T, planes, nig, nn.sigmoid(success_logit), stats, best == 1, finite)


def predict_evidence(model: Model, stats: Float[Array, " s"]) -> tuple[evidence.NIG, Float[Array, ""]]:
    """Evidence of the pose error in rad and m, and the logit of the pair not being lost."""
    raw, success_logit = model.apply("evidence", stats)
    nig, unit = evidence.constrain(raw), evidence_units(model.cfg)
    return evidence.NIG(nig.gamma * unit, nig.nu, nig.alpha, nig.beta * unit**2), success_logit


def evidence_units(cfg: DeloConfig) -> Float[Array, "6"]:
    """Units in which the evidence head counts errors, order [omega, v], rad and m."""
    return jnp.repeat(jnp.array([cfg.evidence.rotation_scale_rad, cfg.evidence.translation_scale_m]), 3)


def _first(cloud: fine.Cloud, num: int) -> fine.Cloud:
    return jax.tree.map(lambda array: array[:num], cloud)


def _plane_information(matches: fine.Matches, T: Float[Array, "4 4"]) -> Float[Array, "6 6"]:
    """Gauss-Newton matrix of the plane distances alone, carried from the left twist to the right perturbation of T."""
    step = point_to_plane_step(*matches[:3], matches.weights, jnp.zeros_like(matches.weights), damping=0.0)
    Ad = se3.adjoint(T)
    return Ad.T @ step.information @ Ad / (jnp.sum(matches.weights) + 1e-6)
