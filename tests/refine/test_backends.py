"""Both backends of a pose graph."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform

from delo_jax.errors import DeloError
from delo_jax.geometry import se3
from delo_jax.refine import gtsam_backend, jax_backend
from delo_jax.refine import plan as plans
from tests.fixtures import QUICKLY
from tests.refine.graphs import drive, measured, multi_frame_pairs, noisy_plan

NUM_POSES = 12
BACKENDS = {"gtsam": gtsam_backend.solve, "jax": jax_backend.solve}


def dense(plan: plans.Plan) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses, whitened residuals and marginals by scipy: its own rigid transforms, dense least squares, numerical derivatives."""
    factors, start = plan.factors, plan.Ts_world_lidar
    whiteners = np.linalg.inv(np.linalg.cholesky(factors.covariances))
    Ts_measured = RigidTransform.from_matrix(factors.Ts_source_target)

    def moved(x, Ts):
        return RigidTransform.from_matrix(Ts) * RigidTransform.from_exp_coords(np.concatenate([np.zeros(6), x]).reshape(-1, 6))

    def residuals(x, Ts):
        T = moved(x, Ts)
        off = Ts_measured.inv() * (T[factors.sources].inv() * T[factors.targets])
        white = (whiteners @ off.as_exp_coords()[..., None])[..., 0]
        ratio = np.sum(white**2, axis=1, keepdims=True) / plans.CAUCHY_SCALE**2
        return (white * np.where(factors.robust[:, None], np.sqrt(np.log1p(ratio) / ratio), 1.0)).ravel()

    zero = np.zeros(6 * (len(start) - 1))
    options = {"method": "trf", "xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-12, "x_scale": "jac"}
    Ts = moved(least_squares(residuals, zero, args=(start,), **options).x, start).as_matrix()
    solved = least_squares(residuals, zero, args=(Ts,), jac="3-point", **options)
    return Ts, solved.fun, np.linalg.inv(solved.jac.T @ solved.jac)


@pytest.fixture(scope="module")
def graph():
    """A graph and its dense solution."""
    plan = noisy_plan(NUM_POSES, seed=3)
    return plan, *dense(plan)


@pytest.mark.parametrize("backend", BACKENDS)
def test_poses_error_and_marginals_are_those_of_dense_least_squares(backend, graph):
    """Oracle: scipy on its own rigid transforms; marginals differ by the robust loss's curvature alone."""
    plan, Ts, residuals, covariance = graph
    found = BACKENDS[backend](plan)
    np.testing.assert_allclose(se3.log(se3.inverse(Ts) @ found.Ts_world_lidar), 0.0, atol=1e-6)  # its derivatives are differences
    np.testing.assert_allclose(found.error_after, 0.5 * np.sum(residuals**2), rtol=1e-9)
    assert found.error_before > found.error_after
    np.testing.assert_array_equal(found.Ts_world_lidar[0], plan.Ts_world_lidar[0])
    blocks = covariance.reshape(NUM_POSES - 1, 6, NUM_POSES - 1, 6)
    sigmas = np.sqrt([np.diag(blocks[i, :, i]) for i in range(NUM_POSES - 1)])
    np.testing.assert_allclose(np.sqrt(np.diagonal(found.covariances[1:], axis1=1, axis2=2)), sigmas, rtol=0.05)
    assert not found.covariances[0].any()


def test_marginals_of_both_backends_agree():
    """Oracle: each other; one from a Bayes tree, one from a dense inverse."""
    plan = noisy_plan(NUM_POSES, seed=4)
    a, b = gtsam_backend.solve(plan), jax_backend.solve(plan)
    scale = np.sqrt(np.diagonal(b.covariances[1:], axis1=1, axis2=2))
    np.testing.assert_allclose((a.covariances - b.covariances)[1:] / (scale[:, :, None] * scale[:, None, :]), 0.0, atol=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_graph_without_noise_stays_as_it_is(backend):
    """Oracle: the poses that the factors were made of."""
    Ts, rng = drive(NUM_POSES), np.random.default_rng(5)
    number = np.arange(NUM_POSES - 1)
    steps = measured(Ts, np.stack([number, number + 1], 1), plans.ODOMETRY, rng, noise=0.0)
    multi = measured(Ts, multi_frame_pairs(NUM_POSES), plans.MULTI_FRAME, rng, noise=0.0)
    found = BACKENDS[backend](plans.Plan(Ts, plans.joined([steps, multi])))
    np.testing.assert_allclose(found.Ts_world_lidar, Ts, atol=1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_wrong_loop_moves_nothing_that_others_hold(backend):
    """Oracle: the same graph without that loop, which is off by 5 m where sigmas are centimetres."""
    plan = noisy_plan(NUM_POSES, seed=6)
    wrong = plans.factors([0], [NUM_POSES - 1], np.eye(4)[None], 1e-4 * np.eye(6)[None], plans.LOOP)
    plan = plan._replace(factors=plan.factors.rows(np.arange(len(plan.factors.sources) - 1)))  # as many as before: nothing is compiled anew
    without = gtsam_backend.solve(plan)
    found = BACKENDS[backend](plan._replace(factors=plans.joined([plan.factors, wrong])))
    moved = se3.log(se3.inverse(without.Ts_world_lidar) @ found.Ts_world_lidar)
    assert np.abs(moved[:, :3]).max() < 2e-3
    assert np.abs(moved[:, 3:]).max() < 0.02


@pytest.mark.slow  # it compiles for long
def test_the_solution_can_be_differentiated():
    """Oracle: central differences of GTSAM's solution for a turned factor."""
    plan = noisy_plan(6, seed=7)

    def turned(angle):
        Ts = plan.factors.Ts_source_target.copy()
        Ts[2] = Ts[2] @ se3.exp(np.array([0.0, 0.0, angle, 0.0, 0.0, 0.0]))
        return plan._replace(factors=plan.factors._replace(Ts_source_target=Ts))

    step = 1e-4
    ends = [gtsam_backend.solve(turned(angle)).Ts_world_lidar[-1, 1, 3] for angle in (step, -step)]
    with jax.enable_x64(True):
        problem = jax_backend.problem_of(plan)

        def end(angle):
            T = problem.Ts_source_target[2] @ se3.exp(jnp.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]) * angle)
            return jax_backend.refined_poses(problem._replace(Ts_source_target=problem.Ts_source_target.at[2].set(T)))[0][-1, 1, 3]

        gradient = float(jax.jit(jax.grad(end)).lower(jnp.float64(0.0)).compile(QUICKLY)(jnp.float64(0.0)))
    assert abs(gradient) > 0.1  # a metre a frame behind it
    np.testing.assert_allclose(gradient, (ends[0] - ends[1]) / (2 * step), rtol=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_bad_plan_ends_in_a_sentence(backend):
    """Oracle: a covariance of zeros, which would end GTSAM's process or give NaN."""
    plan = noisy_plan(NUM_POSES, seed=8)
    plan.factors.covariances[2] = 0.0
    with pytest.raises(DeloError, match="factor 2 .* a singular one"):
        BACKENDS[backend](plan)


def test_marginals_of_a_long_drive_are_left_to_the_sparse_backend():
    """Oracle: the limit in the message."""
    plan = noisy_plan(jax_backend.MAX_DENSE_POSES + 1, seed=9)
    with pytest.raises(DeloError, match="at most 1000 for marginals"):
        jax_backend.solve(plan)
