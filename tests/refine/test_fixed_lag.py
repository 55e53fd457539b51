"""The smoother of a stream."""

import numpy as np
import pytest

from delo_jax.errors import DeloError
from delo_jax.geometry import se3
from delo_jax.refine import gtsam_backend
from delo_jax.refine import plan as plans
from delo_jax.refine.fixed_lag import FixedLagSmoother
from tests.refine.graphs import chained, drive, noisy_plan


def streamed(plan: plans.Plan, lag: int) -> FixedLagSmoother:
    """All frames of a plan, one by one."""
    rows = plan.factors
    smoother = FixedLagSmoother(plan.Ts_world_lidar[0], lag=lag)
    for number in range(1, len(plan.Ts_world_lidar)):
        ending = rows.targets == number
        smoother.add(rows.rows(ending & ~rows.robust), rows.rows(ending & rows.robust))
    return smoother


def test_with_everything_in_the_lag_it_is_the_batch_solution():
    """Oracle: Levenberg-Marquardt on the whole graph; robust weights settle after some iterations."""
    plan = noisy_plan(15, seed=1)
    smoother = streamed(plan, lag=20)
    for _ in range(5):
        smoother.iterate()
    batch = gtsam_backend.solve(plan)
    off = se3.log(se3.inverse(batch.Ts_world_lidar) @ np.stack(smoother.Ts_world_lidar))
    sigmas = np.sqrt(np.diagonal(batch.covariances, axis1=1, axis2=2))
    assert np.all(np.abs(off)[1:] < 0.02 * sigmas[1:])


def test_a_long_stream_is_nearer_to_the_truth_than_the_odometry():
    """Oracle: the drive; 400 frames, far beyond the lag, with errors of the motions from frame to frame."""
    plan, Ts = noisy_plan(400, seed=2), drive(400)
    Ts_smoothed = np.stack(streamed(plan, lag=20).Ts_world_lidar)

    def motions(Ts_any, gap):
        return se3.inverse(Ts_any[:-gap]) @ Ts_any[gap:]

    for gap in (1, 10):
        before, after = (se3.log(se3.inverse(motions(Ts, gap)) @ motions(x, gap)) for x in (plan.Ts_world_lidar, Ts_smoothed))
        assert np.all(np.sqrt(np.mean(after**2, axis=0)) < 0.9 * np.sqrt(np.mean(before**2, axis=0)))


def test_a_motion_from_before_the_lag_hangs_on_the_last_frame():
    """Oracle: without other factors poses are those of the chain, whichever frame a motion starts from."""
    plan = noisy_plan(12, seed=3)
    rows = plan.factors.rows(~plan.factors.robust)
    Ts = chained(rows)
    smoother = FixedLagSmoother(Ts[0], lag=3)
    for number in range(1, 12):
        source = 2 if number == 10 else number - 1
        T = se3.inverse(Ts[source]) @ Ts[number]
        smoother.add(plans.factors([source], [number], T[None], rows.covariances[:1], plans.ODOMETRY))
    np.testing.assert_allclose(np.stack(smoother.Ts_world_lidar), Ts, atol=1e-9)


def test_bad_factors_and_frames_out_of_order_are_refused():
    """Oracle: what is wrong was put there; the next good frame goes on."""
    plan = noisy_plan(4, seed=4)
    rows = plan.factors
    smoother = FixedLagSmoother(plan.Ts_world_lidar[0])
    with pytest.raises(DeloError, match="expected one factor to frame 1"):
        smoother.add(rows.rows(np.array([1])))
    with pytest.raises(DeloError, match="a singular one"):
        smoother.add(rows.rows(np.array([0]))._replace(covariances=np.zeros((1, 6, 6))))
    smoother.add(rows.rows(np.array([0])))
    assert len(smoother.Ts_world_lidar) == 2
