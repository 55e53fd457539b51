"""The model: one params pytree, `encode` once per scan, `solve` once per pair. Pure functions; the caller jits."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from delo_jax.config import DeloConfig
from delo_jax.geometry import se3
from delo_jax.geometry.se3 import AnyArray, full_float32
from delo_jax.model import fine
from delo_jax.model.attention import CloudContext
from delo_jax.model.coarse import CoarsePose, coarse_pose, point_information
from delo_jax.model.network import Network, example_inputs
from delo_jax.model.statistics import NUM_STATISTICS, consensus, statistics
from delo_jax.ops import evidence, spread
from delo_jax.ops.knn import knn

T = TypeVar("T")

STREAM_NUMBERS = ("share", "turn_s", "push_s", "heave_s", "heave_pitch", "drift_share", "drift_forward")
"""Names of the scalars in a model's "stream" variables; `uncertainty.stream` says what they mean."""

GATE_SHAPES = {"sigmas": (101, 6), "ranks": (101,)}
"""Of the arrays in a model's "gate" variables; `uncertainty.gate` says what they mean."""


@runtime_checkable
class Applicable(Protocol):
    """What `encode` and `solve` need of a model: its config, and its layers as functions."""

    @property
    def cfg(self) -> DeloConfig:
        """Of the network."""

    def apply(self, method: str, *args) -> Any:
        """One layer of the network."""

    def confidence(self, source, target, geometry) -> Any:
        """Logits of the fine stage, as a function to pass on."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Model:
    """Weights and the config they belong to. Arrays are leaves, the config is static.

    `variables` holds "params", where the preset has batch normalisation its running statistics, "batch_stats", and once it is
    calibrated the weights of `ops.spread`, "covariance", the numbers of a drive on a map, "stream", and the quantiles
    of held-out pairs, "gate".
    """

    variables: dict[str, Any]
    cfg: DeloConfig = dataclasses.field(metadata={"static": True})

    def apply(self, method: str, *args):
        """One layer of the network with these weights."""
        return Network(self.cfg).apply(self.variables, *args, method=method)

    def confidence(self, source, target, geometry):
        """Logits of the fine stage, as a function to pass on."""
        return self.apply("confidence", source, target, geometry)


@dataclasses.dataclass(frozen=True)
class _InTraining:
    """A network that sees the statistics of its batch and gathers running ones."""

    network: Network
    model: Model

    @property
    def cfg(self):
        return self.model.cfg

    def apply(self, method, *args):
        return getattr(self.network, method)(*args)

    def confidence(self, source, target, geometry):
        return self.model.confidence(source, target, geometry)  # has no statistics, and is called within loops


def apply_in_training(model: Model, function: Callable[..., T], *args) -> tuple[T, dict[str, Any]]:
    """`function(model, *args)` in training mode, and the updated running statistics.

    Args:
        model: weights.
        function: takes a model first; one item, under `jax.vmap(..., axis_name="batch")`.
        args: the rest of its arguments.

    Returns:
        The value of the function, and {"batch_stats": ...}, or {} where the network has no batch normalisation.
    """

    def bound(network, *args):
        return function(_InTraining(network, model), *args)

    return nn.apply(bound, Network(model.cfg, train=True), mutable=["batch_stats"])(model.variables, *args)


class Encoding(NamedTuple):
    """What is computed once per scan and kept."""

    cloud: fine.Cloud
    keypoints: Float[Array, "k 3"]
    keypoint_normals: Float[Array, "s 3"]  # s = k, or 0 where the scan has none
    keypoint_mask: Bool[Array, " k"]
    descriptors: Float[Array, "k d"]
    context: CloudContext  # without rows where the preset has no transformer


class Surfaces(NamedTuple):
    """Points with normals and features: of a scan, or of a map as seen from one pose."""

    points: Float[AnyArray, "n 3"]  # [m]
    normals: Float[AnyArray, "n 3"]  # unit, towards the sensor
    features: Float[AnyArray, "n f"]  # as `preprocess` computes them
    mask: Bool[AnyArray, " n"]


class Matching(NamedTuple):
    """Plan between the key points of two scans, with the descriptors it was made of."""

    source: Float[Array, "n d"]
    target: Float[Array, "m d"]
    plan: Float[Array, "n m"]


class Registration(NamedTuple):
    """Answer of one pair; arrays only."""

    T_target_source: Float[Array, "4 4"]
    information: Float[Array, "6 6"]  # of planes or points, for a right perturbation of the pose, per unit of weight
    nig: evidence.NIG  # `statistics` head: of log(T_pred^-1 T_true), [omega, v]; `embedding`: of pose6 of the true T; `none`: NaN
    confidence: Float[Array, ""]  # that the pair is not lost; `embedding`: the paper's 1 - Var[mu], worst axis; `none`: NaN
    statistics: Float[Array, " s"]  # of the fine stage; empty without one
    used_coarse: Bool[Array, ""]  # the pose came from the coarse stage, not from T_init
    finite: Bool[Array, ""]  # the pose is a number, and the matches determine it


def init(cfg: DeloConfig, key: Key[Array, ""]) -> Model:
    """Model with random weights, for training only."""
    variables = dict(Network(cfg).init(key, *example_inputs(cfg), method="everything"))
    if cfg.evidence.covariance_width:
        variables["covariance"] = spread.init(NUM_STATISTICS + spread.NUM_OWN_INPUTS, cfg.evidence.covariance_width, key)
    return Model(variables, cfg)


def encode(model: Applicable, scan) -> Encoding:
    """Point embeddings and key point descriptors of a `Scan`."""
    cfg, rows, mask = model.cfg, scan.keypoint_index, scan.keypoint_mask
    has_normals = scan.normals.shape[0] > 0
    points, normals = scan.points[rows], scan.normals[rows] if has_normals else scan.normals
    index = knn(points, mask, cfg.encoder.num_neighbors)
    features = jnp.concatenate([normals, scan.features[rows]], axis=-1) if has_normals else scan.features
    descriptors = model.apply("describe", points, features, index, mask)
    embedding = model.apply("embed", scan.features) if cfg.fine.num_iters else scan.features
    if cfg.attention.num_heads:
        context = model.apply("contextualise", descriptors, mask)
    else:
        nothing = descriptors[:0]
        context = CloudContext(nothing, nothing, nothing, nothing, nothing, mask[:0])
    return Encoding(fine.Cloud(scan.points, scan.normals, embedding, scan.mask), points, normals, mask, descriptors, context)


def match(model: Applicable, source: Encoding, target: Encoding) -> Matching:
    """Descriptors, each in the context of the other scan where there is a transformer, and the plan between them."""
    ours, theirs = source.descriptors, target.descriptors
    if model.cfg.attention.num_heads:
        ours, theirs = (model.apply("attend", *pair) for pair in ((source.context, target.context), (target.context, source.context)))
    return Matching(ours, theirs, model.apply("plan", ours, theirs, source.keypoint_mask, target.keypoint_mask))


def coarse(model: Applicable, source: Encoding, target: Encoding, plan: Float[Array, "n m"]) -> CoarsePose:
    """Pose with no prior, from the key points alone."""
    return coarse_pose(plan, source.keypoints, target.keypoints, source.keypoint_mask, cfg=model.cfg.pose)


def refine_pose(model: Applicable, source: fine.Cloud, target: fine.Cloud, T_init, *, num_iters: int) -> Float[Array, "t 4 4"]:
    """Fine stage from a start; `target` is any cloud with normals and embeddings."""
    return fine.refine(model.confidence, source, target, T_init, num_iters=num_iters, cfg=model.cfg.fine)


def cloud_of(model: Applicable, seen: Surfaces) -> fine.Cloud:
    """Surfaces as the fine stage wants them."""
    embedding = model.apply("embed", seen.features)
    return fine.Cloud(jnp.asarray(seen.points), jnp.asarray(seen.normals), embedding, jnp.asarray(seen.mask))


@full_float32
def fine_step(model: Applicable, source: Surfaces, target: Surfaces, T_init: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
    """One iteration of the fine stage towards given matches, for a caller that finds neighbours itself.

    Args:
        model: weights and config.
        source: n points of the source scan.
        target: the match of each, with the features that are seen from where the target frame is; its mask is not read.
        T_init: T_target_source before the step.
    """
    ours, theirs = cloud_of(model, source), cloud_of(model, target)
    T_delta, _ = fine.step(fine.weigh(model.confidence, ours, theirs, T_init), cfg=model.cfg.fine)
    return T_delta @ T_init


@full_float32
def solve(model: Applicable, source: Encoding, target: Encoding, T_init: Float[Array, "4 4"]) -> Registration:
    """Pose of a pair, its information and evidence.

    With a fine stage, two hypotheses, the start and the coarse pose, are refined side by side on half of the points; the
    one that more points agree with is finished on all of them. A good start is never spoilt by a bad coarse pose,
    and a bad start never hides a good one. Without one (the paper's presets) the coarse pose is the answer.

    Args:
        model: weights and config.
        source: encoding of the source scan.
        target: encoding of the target scan.
        T_init: start; the identity when nothing is known.

    Returns:
        Registration with T_target_source.
    """
    matching = match(model, source, target)
    first = coarse(model, source, target, matching.plan)
    if model.cfg.fine.num_iters == 0:
        return _unrefined(model, source, target, matching, first)
    cfg = model.cfg.fine
    points, half = _first(source.cloud, cfg.num_points), _first(source.cloud, cfg.num_points // 2)
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
    planes = fine.plane_information(matches, T)
    finite = jnp.all(jnp.isfinite(T)) & jnp.all(jnp.isfinite(stats)) & jnp.all(jnp.isfinite(planes))
    nig, confidence = predict_evidence(model, source, target, matching, T, stats)
    return Registration(T, planes, nig, confidence, stats, best == 1, finite)


def _unrefined(model, source, target, matching, first):
    """The coarse pose as the answer."""
    T = first.T_target_source
    information = point_information(source.keypoints, first.weights)
    finite = jnp.all(jnp.isfinite(T)) & first.determined
    nig, confidence = predict_evidence(model, source, target, matching, T, jnp.zeros(0))
    return Registration(T, information, nig, confidence, jnp.zeros(0), jnp.ones((), bool), finite)


def predict_evidence(
    model: Applicable, source: Encoding, target: Encoding, matching: Matching, T: Float[Array, "4 4"], stats: Float[Array, " s"]
) -> tuple[evidence.NIG, Float[Array, ""]]:
    """Evidence and confidence of a pose, by the head that the preset has; see `Registration`."""
    head = model.cfg.evidence.head
    if head == "statistics":
        nig, logit = evidence_of_statistics(model, stats)
        return nig, nn.sigmoid(logit)
    if head == "none":
        return evidence.NIG(*[jnp.full(6, jnp.nan)] * 4), jnp.full((), jnp.nan)
    nig = evidence_of_embedding(model, source, target, matching, T)
    return nig, jnp.clip(1.0 - jnp.max(evidence.moments(nig).epistemic), 0.0, 1.0)


def evidence_of_statistics(model: Applicable, stats: Float[Array, " s"]) -> tuple[evidence.NIG, Float[Array, ""]]:
    """Evidence of the pose error in rad and m, and the logit of the pair not being lost."""
    raw, success_logit = model.apply("evidence", stats)
    nig, unit = evidence.constrain(raw), evidence_units(model.cfg)
    return evidence.NIG(nig.gamma * unit, nig.nu, nig.alpha, nig.beta * unit**2), success_logit


def evidence_of_embedding(
    model: Applicable, source: Encoding, target: Encoding, matching: Matching, T: Float[Array, "4 4"]
) -> evidence.NIG:
    """The paper's PU-EPE: evidence of pose6 of the true pose, from pooled descriptors and the predicted pose."""
    pooled = matching[:2] if model.cfg.evidence.embedding == "context" else (source.descriptors, target.descriptors)
    raw = model.apply("evidence", *pooled, source.keypoint_mask, target.keypoint_mask, se3.pose6(T))
    return evidence.constrain(raw, log_beta=False)


class Spread(NamedTuple):
    """Calibrated covariance of a pair's pose, right perturbation."""

    half: Float[Array, "6 6"]  # H with H H^T the covariance [rad, m]
    doubt: Float[Array, ""]  # share of it that is doubt of the model, in [0, 1)


def covariance(model: Model, result: Registration) -> Spread:
    """Of a solved pair, for a model that is calibrated."""
    units, weights = evidence_units(model.cfg), model.variables["covariance"]
    said = spread.inputs(result.statistics, result.nig, result.confidence, units)
    return Spread(spread.half(weights, said, result.T_target_source, units), spread.doubt(weights, said))


def evidence_units(cfg: DeloConfig) -> Float[Array, "6"]:
    """Units in which the `statistics` head counts errors, order [omega, v], rad and m."""
    return jnp.repeat(jnp.array([cfg.evidence.rotation_scale_rad, cfg.evidence.translation_scale_m]), 3)


def _first(cloud: fine.Cloud, num: int) -> fine.Cloud:
    return jax.tree.map(lambda array: array[:num], cloud)
