"""Point-to-plane registration: one damped Gauss-Newton step, and a few robust ones towards given matches."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from delo_jax.config import LEVER_M
from delo_jax.geometry import se3
from delo_jax.geometry.se3 import full_float32

SWEEP_S = 0.03  # about the spread of times in a sweep; conditions the velocity's part of the system


class PlaneStep(NamedTuple):
    """What one step found."""

    T_delta: Float[Array, "4 4"]
    """Correction in the target frame: the pose becomes `T_delta @ T_target_source`."""
    information: Float[Array, "6 6"]
    """Undamped Gauss-Newton matrix of the left twist `[omega, v]` about the origin of the target frame.

    With weights 1/sigma^2 [1/m^2] it is an inverse covariance. For the right perturbation of T_target_source:
    `Ad.T @ information @ Ad` with `Ad = se3.adjoint(T_target_source)`.
    """


def _cross(a, b):
    """Cross product of planar vectors (3, n): rows as long as the number of points keep a CPU's vector units busy."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _turned(T, vectors):
    """Planar vectors in another frame."""
    return T[:3, :1] * vectors[:1] + T[:3, 1:2] * vectors[1:2] + T[:3, 2:3] * vectors[2:]


def _moved(T, points):
    """Planar points in another frame."""
    return _turned(T, points) + T[:3, 3:]


@full_float32
def _normal_equations(arms, errors, normals, plane, point):
    """Hessian (6, 6) and gradient (6,) of half the objective, for the twist of planar points at `arms`; weights are (1, n)."""
    rows = jnp.concatenate([_cross(arms, normals), normals])  # derivatives of the distances to the planes
    distances = jnp.sum(normals * errors, axis=0, keepdims=True)
    # The derivative of an error is J = [-[a]x, I]; the sums of J^T J and J^T e over points need their moments alone.
    moment, first, mass = (point * arms) @ arms.T, jnp.sum(point * arms, axis=1), jnp.sum(point)
    eye, cross = jnp.eye(3, dtype=arms.dtype), se3.skew(first)
    at_points = jnp.block([[jnp.trace(moment) * eye - moment, cross], [cross.T, mass * eye]])
    towards_points = jnp.sum(jnp.concatenate([_cross(arms, errors), errors]) * point, axis=1)
    return (plane * rows) @ rows.T + at_points, jnp.sum(rows * (plane * distances), axis=1) + towards_points


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
    return _planar_step(points.T, targets.T, normals.T, weights, tangential, damping)


def _planar_step(points, targets, normals, weights, tangential, damping):
    total = jnp.sum(weights + tangential)
    safe_total = jnp.where(total > 0, total, 1.0)
    plane, point = (weights / safe_total)[None], (tangential / safe_total)[None]
    centre = jnp.sum((plane + point) * points, axis=1, keepdims=True)
    arms = points - centre
    radius2 = jnp.sum((plane + point) * arms * arms)
    radius = jnp.sqrt(jnp.where(radius2 > 0, radius2, 1.0))
    hessian, gradient = _normal_equations(arms / radius, points - targets, normals, plane, point)

    eye = jnp.eye(6, dtype=points.dtype)
    ridge = damping + 64 * jnp.finfo(points.dtype).eps
    factor = jax.scipy.linalg.cho_factor(hessian + ridge * eye, lower=True)
    step = -jax.scipy.linalg.cho_solve(factor, gradient)

    T_centred = se3.exp(jnp.concatenate([step[:3] / radius, step[3:]]))
    shift = centre[:, 0] - T_centred[:3, :3] @ centre[:, 0]  # from the twist about the mean to the one about the origin
    to_scaled = eye.at[:3, :3].mul(radius).at[3:, :3].set(-se3.skew(centre[:, 0]))
    return PlaneStep(T_centred.at[:3, 3].add(shift), total * (to_scaled.T @ hessian @ to_scaled))


class RobustFit(NamedTuple):
    """Where a few robust steps ended."""

    T_target_source: Float[Array, "4 4"]
    score: Float[Array, ""]
    """Mean robust weight of all source points, in [0, 1]: a point without a match within reach counts as 0."""
    rms_m: Float[Array, ""]
    """Weighted root mean square distance to the planes [m]."""
    information: Float[Array, "6 6"]
    """Of the planes, for a right perturbation of T_target_source, order [omega, v], per unit of weight."""


@full_float32
def robust_point_to_plane(
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    targets: Float[Array, "n 3"],
    target_normals: Float[Array, "n 3"],
    T_init: Float[Array, "4 4"],
    *,
    scale_m: float,
    reach_m: float,
    num_steps: int,
) -> RobustFit:
    """Iteratively reweighted point-to-plane steps (Geman and McClure 1987) towards given matches.

    A match counts by (scale^2 / (scale^2 + distance^2))^2, where distance is that to the target's plane; one beyond reach, or whose
    normals are more than 45 degrees apart, not at all.

    Args:
        points: source points [m].
        normals: theirs, unit.
        mask: True where a source point is real.
        targets: target of each source point [m].
        target_normals: theirs, unit.
        T_init: T_target_source to start from.
        scale_m: distance at which a match counts a quarter [m].
        reach_m: a match farther apart than this is none [m].
        num_steps: static.
    """
    points, normals, targets, target_normals = points.T, normals.T, targets.T, target_normals.T
    no_tangential = jnp.zeros_like(points[0])

    def weigh(T):
        moved = _moved(T, points)
        return moved, *_robust_weights(moved, _turned(T, normals), mask, targets, target_normals, scale_m, reach_m)

    def iterate(T, _):
        moved, weights, _ = weigh(T)
        return _planar_step(moved, targets, target_normals, weights, no_tangential, damping=0.0).T_delta @ T, None

    T, _ = jax.lax.scan(iterate, T_init, length=num_steps)
    moved, weights, distance = weigh(T)
    total = jnp.sum(weights) + 1e-9
    information = _planar_step(moved, targets, target_normals, weights, no_tangential, damping=0.0).information
    Ad = se3.adjoint(T)
    rms = jnp.sqrt(jnp.sum(weights * distance**2) / total)
    return RobustFit(T, total / jnp.maximum(jnp.sum(mask.astype(points.dtype)), 1.0), rms, Ad.T @ information @ Ad / total)


def _robust_weights(moved, turned, mask, targets, target_normals, scale_m, reach_m):
    """Weight of each match of planar points, and its signed distance to the target's plane."""
    offset = moved - targets
    distance = jnp.sum(offset * target_normals, axis=0)
    near = jnp.sum(offset * offset, axis=0) < reach_m**2
    agrees = jnp.sum(turned * target_normals, axis=0) > 0.5**0.5
    return jnp.where(mask & near & agrees, (scale_m**2 / (scale_m**2 + distance**2)) ** 2, 0.0), distance


class SweepFit(NamedTuple):
    """Where a few robust steps on pose and velocity ended."""

    T_target_source: Float[Array, "4 4"]
    velocity: Float[Array, "6"]
    """Of the body, order [omega rad/s, v m/s], that the points still have to be de-skewed with."""
    score: Float[Array, ""]
    rms_m: Float[Array, ""]
    information: Float[Array, "6 6"]
    """As in `RobustFit`, of the pose with the velocity free: what a turn of the sweep could also explain is not known."""


@full_float32
def robust_sweep_to_plane(
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    times_s: Float[Array, " n"],
    targets: Float[Array, "n 3"],
    target_normals: Float[Array, "n 3"],
    T_init: Float[Array, "4 4"],
    velocity_prior: Float[Array, "6"],
    *,
    scale_m: float,
    reach_m: float,
    num_steps: int,
    sigma_velocity: tuple[float, float],
    sigma_m: float,
) -> SweepFit:
    """The same for a sweep whose points were measured while the sensor moved: its velocity is solved for with its pose.

    A point measured at t relative to the stamp lies at T (x + t (omega x x + v)), so that twelve numbers are estimated
    (Dellenbach et al. 2022 let a pose at either end of the sweep go free). The velocity is held by a prior, since some
    of it, along a straight street, hardly moves a plane.

    Args:
        points: as measured, or de-skewed with some velocity, which the one found here comes on top of [m].
        normals: theirs, unit.
        mask: True where a source point is real.
        times_s: of each, relative to the stamp.
        targets: target of each source point [m].
        target_normals: theirs, unit.
        T_init: T_target_source to start from.
        velocity_prior: (6,) expected of the velocity found here: 0 where points are de-skewed with the expected one.
        scale_m: distance at which a match counts a quarter [m].
        reach_m: a match farther apart than this is none [m].
        num_steps: static.
        sigma_velocity: standard deviations of the prior [rad/s, m/s].
        sigma_m: standard deviation of the mean plane distance of all matches [m].
    """
    lever = jnp.repeat(jnp.array([1.0 / LEVER_M, 1.0], points.dtype), 3)
    scale = jnp.concatenate([lever, lever / SWEEP_S])
    pull = jnp.repeat((sigma_m / jnp.array(sigma_velocity, points.dtype)) ** 2, 3)

    points, normals, targets, target_normals = points.T, normals.T, targets.T, target_normals.T

    def place(T, velocity):
        omega, v = velocity[:3, None], velocity[3:, None]
        swept = points + times_s[None] * (_cross(omega, points) + v)
        weights, distance = _robust_weights(_moved(T, swept), _turned(T, normals), mask, targets, target_normals, scale_m, reach_m)
        direction = _turned(T.T, target_normals)  # in the source frame
        row = jnp.concatenate([_cross(swept, direction), direction])
        rows = jnp.concatenate([row, times_s[None] * row]) * scale[:, None]
        share = weights / (jnp.sum(weights) + 1e-9)
        hessian = (share[None] * rows) @ rows.T + jnp.diag(jnp.concatenate([jnp.zeros(6), pull]) * scale**2)
        return weights, distance, share, rows, hessian

    def iterate(state, _):
        T, velocity = state
        _, distance, share, rows, hessian = place(T, velocity)
        gradient = jnp.sum(rows * (share * distance)[None], axis=1)
        gradient = gradient.at[6:].add(pull * (velocity - velocity_prior) * scale[6:])
        factor = jax.scipy.linalg.cho_factor(hessian + 1e-6 * jnp.eye(12, dtype=points.dtype), lower=True)
        step = -scale * jax.scipy.linalg.cho_solve(factor, gradient)
        return (T @ se3.exp(step[:6]), velocity + step[6:]), None

    (T, velocity), _ = jax.lax.scan(iterate, (T_init, jnp.zeros_like(velocity_prior)), length=num_steps)
    weights, distance, share, _, hessian = place(T, velocity)
    coupling = hessian[:6, 6:]
    marginal = hessian[:6, :6] - coupling @ jnp.linalg.solve(hessian[6:, 6:] + 1e-9 * jnp.eye(6, dtype=points.dtype), coupling.T)
    count = jnp.maximum(jnp.sum(mask.astype(points.dtype)), 1.0)
    rms = jnp.sqrt(jnp.sum(share * distance**2))
    return SweepFit(T, velocity, jnp.sum(weights) / count, rms, marginal / (lever[:, None] * lever[None, :]))
