"""Fine stage: point-to-plane registration whose confidence per point is learned."""

from collections.abc import Callable
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from delo_jax.config import FineConfig
from delo_jax.geometry import se3
from delo_jax.geometry.point_to_plane import point_to_plane_step
from delo_jax.geometry.se3 import full_float32
from delo_jax.ops.knn import nearest

MAX_TANGENTIAL = 0.1  # the learned point-to-point term stays small against point-to-plane


class Cloud(NamedTuple):
    """What the fine stage needs of a scan, or of any other cloud with normals."""

    points: Float[Array, "m 3"]  # [m]
    normals: Float[Array, "m 3"]  # unit
    embedding: Float[Array, "m e"]  # of PointEmbedding
    mask: Bool[Array, " m"]


class Matches(NamedTuple):
    """Source points against their nearest target points, at one pose."""

    points: Float[Array, "n 3"]  # source points in the target frame
    targets: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]  # of the targets
    plane_distance: Float[Array, " n"]  # signed, along the target's normal [m]
    agreement: Float[Array, " n"]  # cosine between the two normals
    weights: Float[Array, " n"]  # learned confidence in [0, 1], 0 where masked
    tangential: Float[Array, " n"]  # learned weight of the point-to-point term


class PointEmbedding(nn.Module):
    """Embedding of a point from its own features; computed once per scan."""

    cfg: FineConfig

    @nn.compact
    def __call__(self, features: Float[Array, "m f"]) -> Float[Array, "m e"]:
        """Embeddings, one row per point."""
        return nn.Dense(self.cfg.point_dim)(nn.relu(nn.Dense(self.cfg.point_width)(features)))


class EdgeNetwork(nn.Module):
    """Confidence of a match from both embeddings, its geometry and the state of the whole pair."""

    cfg: FineConfig

    @nn.compact
    def __call__(self, source: Float[Array, "n e"], target: Float[Array, "n e"], geometry: Float[Array, "n g"]):
        """Logits of the confidence and of the tangential weight, (n, 2)."""
        hidden = nn.relu(nn.Dense(self.cfg.edge_width)(jnp.concatenate([source, target, geometry], axis=-1)))
        hidden = nn.relu(nn.Dense(self.cfg.edge_width)(hidden))
        return nn.Dense(2)(hidden)


def match_geometry(
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    targets: Float[Array, "n 3"],
    target_normals: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
) -> tuple[Float[Array, "n g"], Float[Array, " n"], Float[Array, " n"]]:
    """Numbers that describe a match, invariant to yaw, with the signed plane distance and the agreement of the normals.

    The last three columns are means over the whole pair: they tell the network how far the alignment has come,
    so that one network is wide at the start and strict at the end.
    """
    offset = points - targets
    distance = jnp.sqrt(jnp.sum(offset**2, axis=1) + 1e-8)
    along_target = jnp.sum(offset * target_normals, axis=1)
    along_source = jnp.sum(offset * normals, axis=1)
    agreement = jnp.sum(normals * target_normals, axis=1)
    log_distance, log_plane = jnp.log(distance + 0.01), jnp.log(jnp.abs(along_target) + 0.01)
    valid = mask / jnp.maximum(jnp.sum(mask), 1)
    means = [jnp.sum(valid * value) for value in (log_distance, log_plane, agreement)]
    local = [
        jnp.clip(along_target, -2.0, 2.0),
        jnp.clip(along_source, -2.0, 2.0),
        jnp.tanh(along_target / 0.1),
        jnp.tanh(along_source / 0.1),
        jnp.tanh(along_target / 0.5),
        jnp.minimum(distance, 4.0),
        log_distance,
        log_plane,
        jnp.clip(offset[:, 2], -2.0, 2.0),
        agreement,
        0.5 * jnp.log(jnp.sum(points**2, axis=1) + 1.0) - 2.7,
        jnp.abs(target_normals[:, 2]),
    ]
    columns = local + [jnp.broadcast_to(mean, distance.shape) for mean in means]
    return jnp.stack(columns, axis=1), along_target, agreement


Confidence = Callable[[Array, Array, Array], Array]  # embeddings of source and target, geometry -> logits (n, 2)


@full_float32
def match(confidence: Confidence, source: Cloud, target: Cloud, T_target_source: Float[Array, "4 4"]) -> Matches:
    """Nearest target of every source point at a pose, with the learned confidence of each match."""
    points = se3.transform(T_target_source, source.points)
    index, _ = nearest(jax.lax.stop_gradient(points), target.points, target.mask)
    return weigh(confidence, source, jax.tree.map(lambda array: array[index], target), T_target_source)


@full_float32
def weigh(confidence: Confidence, source: Cloud, matched: Cloud, T_target_source: Float[Array, "4 4"]) -> Matches:
    """Learned confidence of given matches at a pose: row i of `matched` is the target of source point i."""
    points = se3.transform(T_target_source, source.points)
    normals = source.normals @ T_target_source[:3, :3].T
    geometry, plane_distance, agreement = match_geometry(points, normals, matched.points, matched.normals, source.mask)
    logits = confidence(source.embedding, matched.embedding, geometry)
    weights = jnp.where(source.mask, nn.sigmoid(logits[:, 0]), 0.0)
    tangential = MAX_TANGENTIAL * weights * nn.sigmoid(logits[:, 1])
    return Matches(points, matched.points, matched.normals, plane_distance, agreement, weights, tangential)


def step(matches: Matches, *, cfg: FineConfig) -> tuple[Float[Array, "4 4"], Float[Array, "6 6"]]:
    """Weighted point-to-plane step and information matrix (about a left twist in the target frame)."""
    return point_to_plane_step(matches.points, matches.targets, matches.normals, matches.weights, matches.tangential, damping=cfg.damping)


@full_float32
def refine(
    confidence: Confidence,
    source: Cloud,
    target: Cloud,
    T_init: Float[Array, "4 4"],
    *,
    num_iters: int,
    cfg: FineConfig,
) -> Float[Array, "t 4 4"]:
    """Poses T_target_source after each of `num_iters` iterations; the pose is detached between them."""

    def iterate(T, _):
        T = jax.lax.stop_gradient(T)
        T_delta, _ = step(match(confidence, source, target, T), cfg=cfg)
        T_next = T_delta @ T
        return T_next, T_next

    return jax.lax.scan(iterate, T_init, length=num_iters)[1]


def plane_information(matches: Matches, T: Float[Array, "4 4"]) -> Float[Array, "6 6"]:
    """Gauss-Newton matrix of the plane distances alone, carried from the left twist to the right perturbation of T."""
    step = point_to_plane_step(*matches[:3], matches.weights, jnp.zeros_like(matches.weights), damping=0.0)
    Ad = se3.adjoint(T)
    return Ad.T @ step.information @ Ad / (jnp.sum(matches.weights) + 1e-6)
