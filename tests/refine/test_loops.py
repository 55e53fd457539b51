"""Loop closures."""

from dataclasses import replace

import numpy as np

from delo_jax.geometry import se3
from delo_jax.inference import Estimate
from delo_jax.metrics.ate import absolute_errors
from delo_jax.refine import gtsam_backend, loops
from delo_jax.refine import plan as plans
from tests.refine.graphs import SIGMAS, chained, measured

NUM = 140
COVARIANCE = np.diag(SIGMAS**2)


def round_trip() -> np.ndarray:
    """Once around a circle of 120 m, and 20 m on over the same ground."""
    twist = np.array([0.0, 0.0, 2 * np.pi / 120, 1.0, 0.0, 0.0])
    return np.stack([se3.exp(k * twist) for k in range(NUM)])


def graph(Ts: np.ndarray, seed: int = 0) -> plans.Plan:
    """Its odometry."""
    number = np.arange(NUM - 1)
    rows = measured(Ts, np.stack([number, number + 1], 1), plans.ODOMETRY, np.random.default_rng(seed))
    return plans.Plan(chained(rows), rows)


def aligned(Ts: np.ndarray, pairs: np.ndarray, seed: int, T_wrong: np.ndarray | None = None) -> list[Estimate]:
    """What a network without a prior says of pairs, T_second_first; every one is wrong by the same motion where one is given."""
    rng, result = np.random.default_rng(seed), []
    for first, second in pairs:
        T = se3.inverse(Ts[second]) @ Ts[first] @ se3.exp(SIGMAS * rng.normal(size=6))
        T = T if T_wrong is None else T @ T_wrong
        result.append(replace(Estimate.exact(T), covariance=COVARIANCE, epistemic=np.diag(COVARIANCE)))
    return result


def test_covariance_of_a_far_motion_is_that_of_the_product():
    """Oracle: composition motion by motion."""
    plan = graph(round_trip())
    T, C = (one[0] for one in loops.Chain.of(plan).between(np.array([[20, 65]])))
    composed = np.zeros((6, 6))
    for k in range(20, 65):
        composed = se3.compose_covariance(composed, plan.factors.covariances[k], plan.factors.Ts_source_target[k])
    np.testing.assert_allclose(C, composed, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(T, se3.inverse(plan.Ts_world_lidar[20]) @ plan.Ts_world_lidar[65], atol=1e-12)


def test_places_seen_again_are_proposed():
    """Oracle: the circle: frame k + 120 stands where frame k stood, and only those."""
    pairs = loops.propose(loops.Chain.of(graph(round_trip())), np.ones(NUM, bool))
    assert len(pairs) > 4
    assert np.all(pairs[:, 1] - pairs[:, 0] > 100)


def test_the_less_is_known_the_farther_it_looks():
    """Oracle: the same drive with ten times the uncertainty has more proposals, none farther than the limit."""
    plan = graph(round_trip())
    wide = plan._replace(factors=plan.factors._replace(covariances=100.0 * plan.factors.covariances))
    few, many = (loops.propose(loops.Chain.of(one), np.ones(NUM, bool)) for one in (plan, wide))
    assert len(many) > len(few)
    far = np.linalg.norm(plan.Ts_world_lidar[many[:, 0], :3, 3] - plan.Ts_world_lidar[many[:, 1], :3, 3], axis=1)
    assert far.max() <= loops.MAX_SEARCH_M


def test_frames_without_a_scan_are_not_proposed():
    """Oracle: none is left where the second round was rejected."""
    usable = np.arange(NUM) < 110
    assert len(loops.propose(loops.Chain.of(graph(round_trip())), usable)) == 0


def test_true_loops_bring_the_drive_together():
    """Oracle: the circle; the error of the positions is halved at least."""
    Ts, plan = round_trip(), graph(round_trip())
    chain, local = loops.Chain.of(plan), np.zeros((NUM, 6, 6))
    pairs = loops.propose(chain, np.ones(NUM, bool))
    kept = loops.verify(chain, pairs, aligned(Ts, pairs, 1), aligned(Ts, pairs[:, ::-1], 2), local)
    assert len(kept.sources) >= 0.8 * len(pairs)
    found = gtsam_backend.solve(plan._replace(factors=plans.joined([plan.factors, kept])))
    last = slice(100, None)  # the first part is near the truth anyway
    off = [np.linalg.norm(poses[last, :3, 3] - Ts[last, :3, 3], axis=1).max() for poses in (plan.Ts_world_lidar, found.Ts_world_lidar)]
    assert off[1] < 0.5 * off[0]
    assert absolute_errors(found.Ts_world_lidar, Ts).rmse_m < absolute_errors(plan.Ts_world_lidar, Ts).rmse_m


def test_wrong_loops_are_refused():
    """Oracle: alignments that fail, and such that agree with each other but contradict the chain by 40 m."""
    Ts, plan = round_trip(), graph(round_trip())
    chain, local = loops.Chain.of(plan), np.zeros((NUM, 6, 6))
    pairs = loops.propose(chain, np.ones(NUM, bool))
    there, back = aligned(Ts, pairs, 1), aligned(Ts, pairs[:, ::-1], 2)
    failed = [replace(one, status="low_confidence") for one in back]
    elsewhere = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 40.0, 0.0]))
    moved = [replace(one, T_target_source=one.T_target_source @ elsewhere) for one in there]
    home = [replace(one, T_target_source=se3.inverse(forth.T_target_source)) for one, forth in zip(back, moved, strict=True)]
    for forth, again in ((there, failed), (failed, back), (moved, home)):
        assert len(loops.verify(chain, pairs, forth, again, local).sources) == 0


def test_alignments_that_do_not_undo_each_other_are_refused():
    """Oracle: 0.3 m and 1 deg between there and back, ten sigmas of an alignment, where the chain itself would allow metres."""
    Ts, plan = round_trip(), graph(round_trip())
    wide = plan._replace(factors=plan.factors._replace(covariances=100.0 * plan.factors.covariances))
    chain, local = loops.Chain.of(wide), np.zeros((NUM, 6, 6))
    pairs = loops.propose(chain, np.ones(NUM, bool))
    near = np.linalg.norm(Ts[pairs[:, 0], :3, 3] - Ts[pairs[:, 1], :3, 3], axis=1) < 5.0
    pairs = pairs[near]
    there, back = aligned(Ts, pairs, 1), aligned(Ts, pairs[:, ::-1], 2)
    off = se3.exp(np.array([0.0, 0.0, np.radians(1.0), 0.3, 0.0, 0.0]))
    one_way = [replace(one, T_target_source=one.T_target_source @ off) for one in there]
    both = [replace(one, T_target_source=se3.inverse(forth.T_target_source)) for one, forth in zip(back, one_way, strict=True)]
    assert len(loops.verify(chain, pairs, one_way, both, local).sources) >= 0.8 * len(pairs)  # the chain has nothing against it
    assert len(loops.verify(chain, pairs, one_way, back, local).sources) == 0
