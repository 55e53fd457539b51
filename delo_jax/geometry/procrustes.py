"""Closed-form rigid alignment: the weighted orthogonal Procrustes problem."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from delo_jax.geometry.se3 import full_float32


def _signed_svd(M):
    """M = u diag(p) vt with u @ vt a rotation; the last entry of p may be negative."""
    u, s, vt = jnp.linalg.svd(M)
    sign = jnp.ones((1, 3), M.dtype).at[0, 2].set(jnp.sign(jnp.linalg.det(u @ vt)))
    return u * sign, s * sign[0], vt


@jax.custom_jvp
@full_float32
def nearest_rotation(M: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Rotation R in SO(3) maximising tr(R^T M).

    The JVP is written out: differentiating through `svd` divides by
    `s_i - s_j` and is NaN on symmetric clouds, while R needs only `p_i + p_j`.
    """
    u, _, vt = _signed_svd(M)
    return u @ vt


@nearest_rotation.defjvp
@full_float32
def _nearest_rotation_jvp(primals, tangents):
    (M,), (dM,) = primals, tangents
    u, p, vt = _signed_svd(M)
    R = u @ vt
    skew = vt @ (R.T @ dM - dM.T @ R) @ vt.T
    gap = p[:, None] + p[None, :]
    regular = jnp.abs(gap) > jnp.finfo(M.dtype).tiny
    omega = jnp.where(regular, skew / jnp.where(regular, gap, 1.0), 0.0)
    return R, R @ vt.T @ omega @ vt


def _centre(source, target, weights):
    """Weights (n, 1) that sum to one, and both weighted means (1, 3); zeros when all weights are zero."""
    total = jnp.sum(weights)
    w = (weights / jnp.where(total > 0, total, 1.0))[:, None]
    return w, jnp.sum(w * source, axis=0, keepdims=True), jnp.sum(w * target, axis=0, keepdims=True)


def _cross_covariance(source, target, weights):
    """Weighted cross-covariance M (3, 3) [m^2], whose nearest rotation maps source onto target, and both means."""
    w, source_mean, target_mean = _centre(source, target, weights)
    return (w * (target - target_mean)).T @ (source - source_mean), source_mean, target_mean


def _pose(R, source_mean, target_mean):
    """Pose with rotation R that maps one mean onto the other."""
    t = (target_mean - source_mean @ R.T)[0]
    return jnp.eye(4, dtype=R.dtype).at[:3, :3].set(R).at[:3, 3].set(t)


@full_float32
def weighted_procrustes(
    source: Float[Array, "n 3"],
    target: Float[Array, "n 3"],
    weights: Float[Array, " n"],
) -> Float[Array, "4 4"]:
    """Rigid pose that best maps `source` onto `target`, row by row.

    Minimises sum_i w_i |R s_i + t - t_i|^2 over SE(3) (Umeyama 1991, no scale).

    Args:
        source: points in the source frame [m].
        target: their matches in the target frame [m].
        weights: match weights, non-negative, any scale; the identity is returned when all are zero.

    Returns:
        T_target_source.
    """
    M, source_mean, target_mean = _cross_covariance(source, target, weights)
    return _pose(nearest_rotation(M), source_mean, target_mean)


@full_float32
def is_determined(
    source: Float[Array, "n 3"],
    target: Float[Array, "n 3"],
    weights: Float[Array, " n"],
    tolerance: float = 1e-5,
) -> Bool[Array, ""]:
    """Whether the matches fix the rotation of `weighted_procrustes`.

    With the singular values s1 >= s2 >= s3 of the weighted cross-covariance and d = +-1 the sign of its determinant, the
    best rotation is unique exactly when s2 + d s3 > 0 (Umeyama 1991), which is also the smallest divisor of its
    derivative. Planar clouds pass (s3 = 0 < s2); collinear and coincident ones do not (s2 = 0), nor does a mirrored
    cloud as wide as it is thick (d = -1, s2 = s3), nor anything that is not finite.

    Args:
        source: points in the source frame [m].
        target: their matches in the target frame [m].
        weights: match weights, non-negative, any scale.
        tolerance: static; least (s2 + d s3) / s1. Float32 leaves 1e-7 to 1e-6 where it should be zero; s is a variance,
            so 1e-5 is a line of 50 m with a scatter of 16 cm.

    Returns:
        False also when all weights are zero. Carries no derivative.
    """
    source, target, weights = jax.lax.stop_gradient((source, target, weights))
    M, _, _ = _cross_covariance(source, target, weights)
    _, p, _ = _signed_svd(M)
    return (jnp.sum(weights) > 0) & (p[1] + p[2] > tolerance * p[0])


@full_float32
def planar_procrustes(
    source: Float[Array, "n 3"],
    target: Float[Array, "n 3"],
    weights: Float[Array, " n"],
) -> Float[Array, "4 4"]:
    """The same with rotation about z only: four degrees of freedom, yaw and x, y, z.

    The yaw is the angle of sum_i w_i conj(s_i) t_i, with centred horizontal coordinates as complex numbers. Made for
    vehicles, where a few noisy matches fix a yaw but not a roll and a pitch.

    Args:
        source: points in the source frame [m].
        target: their matches in the target frame [m].
        weights: match weights, non-negative, any scale; the identity is returned when all are zero.

    Returns:
        T_target_source.
    """
    w, source_mean, target_mean = _centre(source, target, weights)
    s, t = w * (source - source_mean), target - target_mean
    sin = jnp.sum(s[:, 0] * t[:, 1] - s[:, 1] * t[:, 0])
    cos = jnp.sum(s[:, 0] * t[:, 0] + s[:, 1] * t[:, 1])
    defined = (sin != 0) | (cos != 0)  # atan2(0, 0) has no derivative
    yaw = jnp.arctan2(jnp.where(defined, sin, 0.0), jnp.where(defined, cos, 1.0))
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    R = jnp.eye(3, dtype=source.dtype).at[:2, :2].set(jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])]))
    return _pose(R, source_mean, target_mean)
