"""One damped Gauss-Newton step of point-to-plane registration."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from delo_jax.geometry import se3
from delo_jax.geometry.se3 import full_float32


class PlaneStep(NamedTuple):
    """What one step found."""

    T_delta: Float[Array, "4 4"]
    """Correction in the target frame: the pose becomes `T_delta @ T_target_source`."""
    information: Float[Array, "6 6"]
    """Undamped Gauss-Newton matrix of the left twist `[omega, v]` about the origin of the target frame.

    With weights 1/sigma^2 [1/m^2] it is an inverse covariance. For the right perturbation of T_target_source:
    `Ad.T @ information @ Ad` with `Ad = se3.adjoint(T_target_source)`.
    """


@full_float32
def _normal_equations(arms, errors, normals, plane, point):
    """Hessian (6, 6) and gradient (6, 1) of half the objective, for the twist of points at `arms`."""
    eye = jnp.broadcast_to(jnp.eye(3, dtype=arms.dtype)[None], (*arms.shape, 3))
    jacobians = jnp.concatenate([-se3.skew(arms), eye], axis=2)  # of the errors
    rows = jnp.concatenate([jnp.cross(arms, normals), normals], axis=1)  # of the distances to the planes
    distances = jnp.sum(normals * errors, axis=1, keepdims=True)
    hessian = rows.T @ (plane * rows) + jnp.sum(jacobians.mT @ (point[:, :, None] * jacobians), axis=0)
    gradient = rows.T @ (plane * distances) + jnp.sum(jacobians.mT @ (point * errors)[:, :, None], axis=0)
    return hessian, gradient


@full_float32
def point_to_plane_step(
    points: Float[Array, "n 3"],
    targets: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    weights: Float[Array, " n"],
    tangential: Float[Array, " n"],
    *,
    damping: float,
) -> PlaneStep:
    """Pose correction that brings `points` onto the planes through `targets`.

    One step on sum_i weights_i (n_i . e_i)^2 + tangential_i |e_i|^2 with e_i = T_delta p_i - q_i (Chen and Medioni
    1991; the second term is point-to-point and holds the directions that no plane constrains).

    Inside, coordinates are centred at the weighted mean and divided by the weighted radius, and weights sum to one:
    the normal matrix is then of order one whatever the scene, float32 is enough for its Cholesky factor, and
    `damping` means the same everywhere.

    Args:
        points: source points, already moved into the target frame by the present pose [m].
        targets: the matched points [m].
        normals: unit normals of the targets, any sign.
        weights: point-to-plane weights >= 0, any scale.
        tangential: point-to-point weights >= 0, on the scale of `weights`.
        damping: added to the diagonal of the scaled normal matrix, >= 0, 1e-4 say; a floor of 64 machine epsilons
            keeps the factor real where the scene leaves a direction free.

    Returns:
        The step; the identity and a zero matrix when all weights are zero.
    """
    total = jnp.sum(weights + tangential)
    safe_total = jnp.where(total > 0, total, 1.0)
    plane, point = (weights / safe_total)[:, None], (tangential / safe_total)[:, None]
    centre = jnp.sum((plane + point) * points, axis=0, keepdims=True)
    arms = points - centre
    radius2 = jnp.sum((plane + point) * arms * arms)
    radius = jnp.sqrt(jnp.where(radius2 > 0, radius2, 1.0))
    hessian, gradient = _normal_equations(arms / radius, points - targets, normals, plane, point)

    eye = jnp.eye(6, dtype=points.dtype)
    ridge = damping + 64 * jnp.finfo(points.dtype).eps
    factor = jax.scipy.linalg.cho_factor(hessian + ridge * eye, lower=True)
    step = -jax.scipy.linalg.cho_solve(factor, gradient)[:, 0]

    T_centred = se3.exp(jnp.concatenate([step[:3] / radius, step[3:]]))
    shift = (centre - centre @ T_centred[:3, :3].T)[0]  # from the twist about the mean to the one about the origin
    to_scaled = eye.at[:3, :3].mul(radius).at[3:, :3].set(-se3.skew(centre[0]))
    return PlaneStep(T_centred.at[:3, 3].add(shift), total * (to_scaled.T @ hessian @ to_scaled))
