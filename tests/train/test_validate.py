"""Errors on unseen worlds."""

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.linalg import expm

from delo_jax.train import validate as module
from delo_jax.train.validate import validate
from tests.fixtures import TINY_TRAINING, street_world, tiny_model
from tests.oracles.registration import hat


class Answer(NamedTuple):
    T_target_source: np.ndarray
    confidence: float


@pytest.fixture
def solver(monkeypatch):
    """Stands in for the network: the truth, off by what `errors[gap]` says for the world at hand; starts are kept."""
    state = SimpleNamespace(errors={}, confidences={}, starts=[], worlds=[])

    def solve(model, source, target, T_init):
        state.starts.append(np.asarray(T_init))
        for number, world in enumerate(state.worlds):
            frames = {points.tobytes(): k for k, points in enumerate(world.scans.points)}
            if source.points.tobytes() in frames:
                assert frames[source.points.tobytes()] == 0
                gap = frames[target.points.tobytes()]
                T = np.linalg.inv(world.Ts_world_lidar[gap]) @ world.Ts_world_lidar[0]
                return Answer(T @ expm(-hat(state.errors[gap][number])), state.confidences[gap][number])
        raise AssertionError("a scan of no world")

    monkeypatch.setattr(module, "inference", SimpleNamespace(encode=lambda model, scan: scan, solve=solve))
    return state


def world_at(shift, num_frames=6):
    """The street's world with its points moved a little, so that it can be told apart."""
    world = street_world(TINY_TRAINING.model.preprocess, num_frames)
    return world._replace(scans=world.scans._replace(points=world.scans.points + np.float32(shift)))


def test_errors_and_shares_are_counted_per_gap(solver):
    """Oracle: by hand; known errors in cm and deg, lost beyond 0.5 m or 2 deg, confident from 0.5 on."""
    solver.worlds = [world_at(shift) for shift in (0.0, 1.0, 2.0, 3.0)]
    metres = {1: [0.01, 0.02, 0.03, 0.04], 2: [0.1, 0.1, 0.1, 0.1], 3: [0.6, 0.02, 0.02, 0.7], 5: [0.0, 0.0, 0.0, 0.0]}
    degrees = {1: [0.1, 0.1, 0.1, 0.1], 2: [0.0, 3.0, 0.5, 0.5], 3: [0.0, 0.0, 0.0, 0.0], 5: [0.3, 0.2, 0.2, 0.1]}
    solver.confidences = {1: [0.9] * 4, 2: [0.9, 0.9, 0.4, 0.9], 3: [0.9, 0.9, 0.9, 0.1], 5: [0.1] * 4}
    for gap in (1, 2, 3, 5):
        twists = [np.r_[0, 0, np.radians(a), 0, 0, d] for a, d in zip(degrees[gap], metres[gap], strict=True)]
        solver.errors[gap] = twists
    rows = validate(tiny_model(), solver.worlds)
    assert [row.gap for row in rows] == [1, 2, 3, 5]
    assert {row.num_pairs for row in rows} == {4}
    np.testing.assert_allclose([row.median_cm for row in rows], [2.5, 10.0, 31.0, 0.0], atol=1e-6)
    np.testing.assert_allclose([row.p95_cm for row in rows], [3.85, 10.0, 68.5, 0.0], atol=1e-6)
    np.testing.assert_allclose([row.median_deg for row in rows], [0.1, 0.5, 0.0, 0.2], atol=1e-6)
    assert [row.lost_share for row in rows] == [0.0, 0.25, 0.5, 0.0]
    assert [row.false_alarm_share for row in rows] == [0.0, 1 / 3, 0.0, 1.0]  # of the pairs not lost
    assert [row.missed_share for row in rows] == [0.0, 1.0, 0.5, 0.0]  # of the lost ones


def test_starts_are_the_identity(solver):
    """Oracle: the call; no motion prior."""
    solver.worlds = [world_at(0.0)]
    solver.errors = {gap: [np.zeros(6)] for gap in (1, 2, 3, 5)}
    solver.confidences = {gap: [1.0] for gap in (1, 2, 3, 5)}
    validate(tiny_model(), solver.worlds)
    assert len(solver.starts) == 4
    assert all(np.array_equal(start, np.eye(4)) for start in solver.starts)


def test_short_worlds_have_the_gaps_they_have(solver):
    """Oracle: three frames hold gaps 1 and 2."""
    solver.worlds = [world_at(0.0, 3)]
    solver.errors, solver.confidences = {1: [np.zeros(6)], 2: [np.zeros(6)]}, {1: [1.0], 2: [1.0]}
    assert [row.gap for row in validate(tiny_model(), solver.worlds)] == [1, 2]


def test_an_answer_that_is_no_number_is_lost(solver):
    """Oracle: by hand; NaN is within no limit."""
    solver.worlds = [world_at(0.0, 2)]
    solver.errors, solver.confidences = {1: [np.full(6, np.nan)]}, {1: [0.9]}
    (row,) = validate(tiny_model(), solver.worlds)
    assert (row.lost_share, row.missed_share) == (1.0, 1.0)
