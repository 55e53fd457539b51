"""The plan of a pose graph."""

import numpy as np
import pytest

from delo_jax.errors import DeloError
from delo_jax.geometry import se3
from delo_jax.refine import plan as plans
from tests.refine.graphs import chained, drive, measured, noisy_plan


def test_odometry_factors_lead_to_the_poses_again():
    """Oracle: chaining the factors over rejected frames gives the poses that they were made of."""
    Ts, none = drive(6), np.zeros((6, 6, 6))
    since = np.array([0, 0, 1, 1, 1, 4])  # frames 2 and 3 were rejected
    rows = plans.odometry_factors(Ts, since, none, none)
    again = [Ts[0]]
    for source, T in zip(rows.sources, rows.Ts_source_target, strict=True):
        again.append(again[source] @ T)
    assert rows.targets.tolist() == [1, 2, 3, 4, 5]
    assert not rows.robust.any()
    np.testing.assert_allclose(np.stack(again), Ts, atol=1e-12)


def test_a_factor_holds_what_the_covariance_has_grown_by():
    """Oracle: covariances composed by hand from known steps, with a part of each pose that is not handed on."""
    Ts, rng = drive(5), np.random.default_rng(0)
    halves = rng.normal(size=(5, 6, 6))
    steps, local = 1e-4 * halves @ halves.transpose(0, 2, 1), 1e-3 * np.tile(np.eye(6), (5, 1, 1))
    handed_on = [np.zeros((6, 6))]
    for k in range(1, 5):
        handed_on.append(se3.compose_covariance(handed_on[-1], steps[k], se3.inverse(Ts[k - 1]) @ Ts[k]))
    rows = plans.odometry_factors(Ts, np.array([0, 0, 1, 2, 3]), np.stack(handed_on) + local, local)
    np.testing.assert_allclose(rows.covariances, steps[1:] + np.diag(plans.STILL**2), rtol=1e-6, atol=1e-12)


def test_frames_before_the_first_usable_one_hang_on_each_other():
    """Oracle: by hand; frames 0 and 1 were unusable, frame 2 defines the world, frame 3 was measured from it."""
    none = np.zeros((4, 6, 6))
    rows = plans.odometry_factors(drive(4), np.array([0, 1, 2, 2]), none, none)
    assert rows.sources.tolist() == [0, 1, 2]
    np.testing.assert_allclose(rows.covariances, np.tile(np.diag(plans.STILL**2), (3, 1, 1)), rtol=1e-9)


def test_a_covariance_that_is_no_number_is_named():
    """Oracle: the frame that it was put to."""
    covariances = np.zeros((5, 6, 6))
    covariances[3, 2, 2] = np.nan
    with pytest.raises(DeloError, match="pose 3: expected a finite covariance"):
        plans.odometry_factors(drive(5), np.array([0, 0, 1, 2, 3]), covariances, np.zeros((5, 6, 6)))


def test_factors_between_frames_hold_what_is_wrong_with_both_ends():
    """Oracle: sampling: the motion between two poses, each off by its own local error."""
    rng, Ts = np.random.default_rng(1), drive(4)
    halves = 1e-2 * rng.normal(size=(4, 6, 6))
    local, T = halves @ halves.transpose(0, 2, 1), se3.inverse(Ts[0]) @ Ts[3]
    row = plans.between_frames(np.array([[0, 3]]), T[None], 1e-12 * np.eye(6)[None], local, plans.LOOP)
    first, last = (se3.exp((halves[k] @ rng.normal(size=(20_000, 6, 1)))[..., 0]) for k in (0, 3))
    twists = se3.log(se3.inverse(T) @ se3.inverse(first) @ T @ last)
    sampled = np.cov(twists.T)
    scale = np.sqrt(np.diag(sampled))
    np.testing.assert_allclose(row.covariances[0] / np.outer(scale, scale), sampled / np.outer(scale, scale), atol=0.05)


def test_a_good_plan_passes():
    """Oracle: nothing is wrong with it."""
    plan = noisy_plan(12, seed=0)
    assert plans.check(plan) is plan


def spoiled(**changes) -> plans.Plan:
    """A plan of which the fourth factor is replaced in part."""
    plan = noisy_plan(8, seed=1)
    rows = plan.factors._asdict()
    for name, value in changes.items():
        rows[name] = rows[name].copy()
        rows[name][3] = value
    return plan._replace(factors=plans.Factors(**rows))


NAN = np.full((4, 4), np.nan)
TILTED = np.eye(4) + 1e-3 * np.eye(4, k=1)
MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"Ts_source_target": NAN}, r"factor 3 \(frame 3 to 4, odometry\): expected finite numbers, got 16"),
        ({"Ts_source_target": TILTED}, "expected an orthonormal rotation"),
        ({"Ts_source_target": MIRROR}, "a reflection"),
        ({"covariances": np.full((6, 6), np.inf)}, "not finite"),
        ({"covariances": np.zeros((6, 6))}, "a singular one"),
        ({"covariances": np.ones((6, 6))}, "a singular one"),
        ({"covariances": -np.eye(6)}, "a singular one"),
        ({"covariances": np.eye(6) + np.eye(6, k=1)}, "not symmetric"),
        ({"targets": 8}, "two different frames of 0 to 7, got 3 and 8"),
        ({"targets": 3}, "two different frames"),
        ({"sources": -1}, "two different frames"),
    ],
)
def test_what_no_backend_could_solve_is_refused(changes, says):
    """Oracle: what is wrong was put there."""
    with pytest.raises(DeloError, match=says):
        plans.check(spoiled(**changes))


def test_a_graph_in_parts_is_refused():
    """Oracle: without the factors across frame 4 and 5, frames 5 to 9 hang on nothing."""
    plan = noisy_plan(10, seed=2)
    across = (plan.factors.sources <= 4) & (plan.factors.targets >= 5)
    with pytest.raises(DeloError, match="got 2: nothing holds frame 5 to frame 0"):
        plans.check(plan._replace(factors=plan.factors.rows(~across)))


@pytest.mark.parametrize("Ts", [np.eye(4)[None], np.zeros((3, 3, 3)), np.stack([np.eye(4), NAN])])
def test_poses_that_are_none_are_refused(Ts):
    """Oracle: one pose, another shape, not a number."""
    rows = plans.factors([0], [1], np.eye(4)[None], np.eye(6)[None], plans.ODOMETRY)
    with pytest.raises(DeloError, match="expected"):
        plans.check(plans.Plan(Ts, rows))


def test_joined_factors_keep_their_kind():
    """Oracle: order of the lots; only the odometry is trusted altogether."""
    Ts, rng = drive(4), np.random.default_rng(0)
    both = plans.joined([measured(Ts, np.array([[0, 1]]), plans.ODOMETRY, rng), measured(Ts, np.array([[0, 3]]), plans.LOOP, rng)])
    assert both.robust.tolist() == [False, True]
    np.testing.assert_allclose(chained(both.rows(np.array([0])))[1], se3.exp(se3.log(both.Ts_source_target[0])), atol=1e-12)
