"""Solves a plan with optimistix: Levenberg-Marquardt, matrix-free and differentiable, in float64.

The unknowns are the motions from frame to frame, each in units of its own uncertainty: poses are their running product, so that the
odometry's own residuals are the unknowns themselves and conjugate gradients need few steps, however long the drive.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax
import numpy as np
import optimistix
from jaxtyping import Array, Float, Int

from delo_jax.errors import DeloError
from delo_jax.geometry import se3
from delo_jax.refine.plan import CAUCHY_SCALE, Plan, Refined, check

MAX_STEPS = 100
TOLERANCE = 1e-9  # of the unknowns, in standard deviations
MAX_DENSE_POSES = 1_000  # whose marginals are taken from a dense matrix


class Problem(NamedTuple):
    """A plan as arrays of a pure function."""

    T_world_first: Float[Array, "4 4"]
    Ts_step: Float[Array, "s 4 4"]  # from each frame to the next, where to begin
    units: Float[Array, "s 6 6"]  # of the unknowns: a factor of the covariance of each step
    sources: Int[Array, " k"]
    targets: Int[Array, " k"]
    Ts_source_target: Float[Array, "k 4 4"]
    whiteners: Float[Array, "k 6 6"]  # W with W C W^T = 1
    robust: Float[Array, " k"]  # 1 or 0


def problem_of(plan: Plan) -> Problem:
    """Arrays of a checked plan."""
    Ts, factors = plan
    units = np.broadcast_to(np.diag(np.repeat([1e-3, 1e-2], 3)), (len(Ts) - 1, 6, 6)).copy()
    halves = np.linalg.cholesky(factors.covariances)
    next_to = factors.targets == factors.sources + 1
    units[factors.sources[next_to]] = halves[next_to]
    numbers = Ts[0], se3.inverse(Ts[:-1]) @ Ts[1:], units, factors.sources, factors.targets, factors.Ts_source_target
    return Problem(*(jnp.asarray(array) for array in (*numbers, np.linalg.inv(halves), factors.robust.astype(np.float64))))


def poses(problem: Problem, unknowns: Float[Array, "s 6"]) -> Float[Array, "n 4 4"]:
    """Poses that these steps lead to."""
    steps = problem.Ts_step @ se3.exp((problem.units @ unknowns[..., None])[..., 0])
    return jax.lax.associative_scan(jnp.matmul, jnp.concatenate([problem.T_world_first[None], steps]))


def whitened(problem: Problem, Ts_world_lidar: Float[Array, "n 4 4"]) -> Float[Array, "k 6"]:
    """What the factors are off by, in standard deviations."""
    between = se3.inverse(Ts_world_lidar[problem.sources]) @ Ts_world_lidar[problem.targets]
    off = se3.log(se3.inverse(problem.Ts_source_target) @ between)
    return (problem.whiteners @ off[..., None])[..., 0]


def damped(problem: Problem, residuals: Float[Array, "k 6"]) -> Float[Array, "k 6"]:
    """Half their sum of squares is the loss: Cauchy's c^2/2 log(1 + |r|^2/c^2) of robust factors."""
    ratio = jnp.sum(residuals**2, axis=1, keepdims=True) / CAUCHY_SCALE**2
    small = ratio < 1e-4
    safe = jnp.where(small, 1.0, ratio)
    scale = jnp.sqrt(jnp.where(small, 1.0 - ratio / 2 + ratio**2 / 3, jnp.log1p(safe) / safe))
    return residuals * jnp.where(problem.robust[:, None] > 0, scale, 1.0)


def refined_poses(problem: Problem) -> tuple[Float[Array, "n 4 4"], Int[Array, ""]]:
    """Poses that fit best and the number of steps; differentiable with respect to everything in the problem, by the implicit function."""

    def residuals(unknowns, problem):
        return damped(problem, whitened(problem, poses(problem, unknowns)))

    solver: Any = lineax.Normal(lineax.CG(rtol=1e-8, atol=1e-10))
    search: Any = optimistix.LevenbergMarquardt(rtol=TOLERANCE, atol=TOLERANCE, linear_solver=solver)
    start = jnp.zeros((len(problem.Ts_step), 6), problem.Ts_step.dtype)
    adjoint: Any = optimistix.ImplicitAdjoint(linear_solver=solver)
    found: Any = optimistix.least_squares(residuals, search, start, args=problem, max_steps=MAX_STEPS, adjoint=adjoint, throw=False)
    return poses(problem, found.value), found.stats["num_steps"]


@jax.jit
def _solve(problem: Problem) -> tuple[Array, ...]:
    Ts, num_steps = refined_poses(problem)
    start = poses(problem, jnp.zeros((len(problem.Ts_step), 6)))
    errors = [0.5 * jnp.sum(damped(problem, whitened(problem, T)) ** 2) for T in (start, Ts)]
    return Ts, _marginals(problem, Ts), jnp.stack(errors), num_steps


def _marginals(problem: Problem, Ts: Float[Array, "n 4 4"]) -> Float[Array, "n 6 6"]:
    """Diagonal blocks of the inverse Gauss-Newton matrix, robust factors at their last weight."""

    def of_ends(source, target, row):
        one = jax.tree.map(lambda array: array[row][None], problem)._replace(sources=jnp.array([0]), targets=jnp.array([1]))
        moved = jnp.stack([Ts[problem.sources[row]] @ se3.exp(source), Ts[problem.targets[row]] @ se3.exp(target)])
        return whitened(one, moved)[0]

    count, zero = len(Ts), jnp.zeros(6)
    rows = jnp.arange(len(problem.sources))
    J = jnp.concatenate(jax.vmap(jax.jacfwd(of_ends, argnums=(0, 1)), in_axes=(None, None, 0))(zero, zero, rows), axis=2)  # (k, 6, 12)
    ratio = jnp.sum(whitened(problem, Ts) ** 2, axis=1) / CAUCHY_SCALE**2
    weights = jnp.where(problem.robust > 0, 1.0 / (1.0 + ratio), 1.0)
    blocks = weights[:, None, None] * (J.transpose(0, 2, 1) @ J)
    index = 6 * jnp.stack([problem.sources, problem.targets], 1)[:, :, None] + jnp.arange(6)[None, None]
    index = index.reshape(len(rows), 12)
    H = jnp.zeros((6 * count, 6 * count)).at[index[:, :, None], index[:, None, :]].add(blocks)[6:, 6:]
    inverse = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(H, lower=True), jnp.eye(6 * count - 6))
    own = jnp.moveaxis(jnp.diagonal(inverse.reshape(count - 1, 6, count - 1, 6), axis1=0, axis2=2), -1, 0)
    return jnp.concatenate([jnp.zeros((1, 6, 6)), own])


def solve(plan: Plan) -> Refined:
    """The poses that fit the factors best, with their marginal covariances; compiled once per number of poses and factors.

    Args:
        plan: what holds which; up to 1,000 poses.

    Raises:
        DeloError: a plan that cannot be solved, see `plan.check`, too long a drive, or no solution.
    """
    check(plan)
    check_length(len(plan.Ts_world_lidar))
    with jax.enable_x64(True):
        Ts, Cs, errors, num_steps = jax.device_get(_solve(problem_of(plan)))
    if not (np.isfinite(Ts).all() and np.isfinite(Cs).all()):
        raise DeloError("graph: expected one that determines all poses, got none that are finite; take the gtsam backend")
    return Refined(Ts, Cs, float(errors[0]), float(errors[1]), int(num_steps), bool(num_steps < MAX_STEPS))


def check_length(num_poses: int) -> None:
    """Raise a DeloError where the marginals of so many poses are too much for a dense matrix."""
    if num_poses > MAX_DENSE_POSES:
        raise DeloError(f"poses: expected at most {MAX_DENSE_POSES} for marginals, got {num_poses}; take the gtsam backend")
