"""Refining a stream."""

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from delo_jax.config import DeloConfig, RefineConfig
from delo_jax.errors import DeloError
from delo_jax.geometry import se3
from delo_jax.inference import Estimate
from delo_jax.model.delo import Model
from delo_jax.refine import gtsam_backend
from delo_jax.refine.refiner import Refiner, Tracked
from delo_jax.uncertainty import gate
from tests.refine.graphs import SIGMAS, chained, drive, measured

PARAMS = Model({}, DeloConfig())
NUM = 30
COVARIANCE = np.diag(SIGMAS**2)


@dataclass(frozen=True)
class Numbered:
    """Stands for a scan; the network below knows where each was taken."""

    number: int


class NoisyNetwork:
    """`align` with the right motion and noise of the covariance that it states; some pairs fail, some it doubts."""

    def __init__(self, Ts: np.ndarray, *, fails: tuple[int, ...] = (), doubts: tuple[int, ...] = ()):
        self._Ts, self._fails, self._doubts = Ts, fails, doubts
        self.pairs: list[tuple[int, int]] = []

    def __call__(self, params: Any, source: Any, target: Any, T_init: np.ndarray) -> Estimate:
        """T_target_source."""
        self.pairs.append((source.number, target.number))
        T_source_target = se3.inverse(self._Ts[source.number]) @ self._Ts[target.number]
        np.testing.assert_allclose(se3.log(T_init @ T_source_target), 0.0, atol=1.0)  # the start maps source onto target
        rng = np.random.default_rng([source.number, target.number])
        motion = replace(
            Estimate.exact(T_source_target @ se3.exp(SIGMAS * rng.normal(size=6))),
            covariance=COVARIANCE,
            epistemic=np.diag(COVARIANCE) * (100.0 if target.number in self._doubts else 1.0),
            status="rejected" if target.number in self._fails else "ok",
        )
        return motion.inverted()


def tracked(Ts_true: np.ndarray, *, rejected: tuple[int, ...] = ()) -> list[Tracked]:
    """Frames of an odometry whose motions have independent errors."""
    number = np.arange(len(Ts_true) - 1)
    rows = measured(Ts_true, np.stack([number, number + 1], 1), 0, np.random.default_rng(0))
    Ts, C, frames = chained(rows), np.zeros((6, 6)), []
    for k, T in enumerate(Ts):
        if k:
            C = se3.compose_covariance(C, rows.covariances[k - 1], rows.Ts_source_target[k - 1])
        frames.append(Tracked(max(k - 1, 0), T, C, np.zeros((6, 6)), None if k in rejected else Numbered(k)))
    return frames


def refined(frames: list[Tracked], network: NoisyNetwork, cfg: RefineConfig | None = None, params: Model = PARAMS) -> Refiner:
    """All frames through a refiner."""
    with Refiner(params, cfg, align=network) as refiner:
        for frame in frames:
            refiner.add(frame)
    return refiner


def step_errors(Ts: np.ndarray, Ts_true: np.ndarray) -> np.ndarray:
    """(6,) root mean square over two frames."""
    true, found = (se3.inverse(poses[:-2]) @ poses[2:] for poses in (Ts_true, Ts))
    return np.sqrt(np.mean(se3.log(se3.inverse(true) @ found) ** 2, axis=0))


def test_poses_come_nearer_to_the_truth_and_to_the_batch():
    """Oracle: the drive itself; and the batch solution of the same factors, which the smoother nears while everything is in its lag."""
    Ts = drive(NUM)
    network = NoisyNetwork(Ts)
    refiner = refined(tracked(Ts), network)
    plan = refiner.record.plan()
    batch = gtsam_backend.solve(plan).Ts_world_lidar
    before, online, after = (step_errors(poses, Ts).sum() for poses in (plan.Ts_world_lidar, refiner.Ts_world_lidar, batch))
    assert after < 0.9 * before
    assert online < 0.95 * before
    assert set(network.pairs) == {(f, f + 2) for f in range(NUM - 2)} | {(f, f + 4) for f in range(0, NUM - 4, 4)}
    assert len(refiner.record.smooth_s) == NUM


def test_frames_without_a_scan_and_lost_pairs_leave_no_factor():
    """Oracle: by hand, the pairs that touch frame 7, which was rejected, or end at frame 12, which the network loses."""
    Ts = drive(NUM)
    refiner = refined(tracked(Ts, rejected=(7,)), NoisyNetwork(Ts, fails=(12,)))
    rows = refiner.record.plan().factors
    ends = {(int(s), int(t)) for s, t in zip(rows.sources[rows.robust], rows.targets[rows.robust], strict=True)}
    expected = {(f, f + 2) for f in range(NUM - 2)} | {(f, f + 4) for f in range(0, NUM - 4, 4)}
    assert ends == {pair for pair in expected if 7 not in pair and pair[1] != 12}
    assert refiner.record.counts["no factor (rejected)"] == 2


def test_the_gate_leaves_confident_key_frames_out():
    """Oracle: quantiles under which every pair stands in the middle, but for the two that the network doubts."""
    Ts = drive(NUM)
    quantiles = gate.Quantiles.fit(SIGMAS**2 * np.exp(np.random.default_rng(0).normal(size=(500, 6))))
    params = replace(PARAMS, variables={"gate": quantiles.stored()})
    refiner = refined(tracked(Ts), NoisyNetwork(Ts, doubts=(8, 20)), RefineConfig(odometry_gap=0, theta_min=0.2, theta_max=0.7), params)
    rows = refiner.record.plan().factors
    assert rows.targets[rows.robust].tolist() == [8, 20]
    assert refiner.record.counts == {"skip (confident)": 5, "refine (under-confident)": 2}


def test_what_is_wrong_with_a_pose_alone_goes_to_its_pairs_and_not_down_the_chain():
    """Oracle: the covariances by hand: motions grow by what is handed on, pairs by the local parts of both ends."""
    Ts = drive(6)
    local = np.diag((3.0 * SIGMAS) ** 2)
    frames = [frame._replace(covariance=frame.covariance + local, local=local) for frame in tracked(Ts)]
    rows = refined(frames, NoisyNetwork(Ts), RefineConfig(odometry_gap=0)).record.plan().factors
    Ad = se3.adjoint(se3.inverse(rows.Ts_source_target[-1]))
    np.testing.assert_allclose(rows.covariances[-1], COVARIANCE + Ad @ local @ Ad.T + local, rtol=1e-9, atol=1e-15)
    without = refined(tracked(Ts), NoisyNetwork(Ts), RefineConfig(odometry_gap=0)).record.plan().factors
    np.testing.assert_allclose(rows.covariances[:5], without.covariances[:5], rtol=1e-6, atol=1e-15)


def test_an_error_in_the_thread_reaches_whoever_closes_and_nobody_waits():
    """Oracle: the error that was put there; three hundred frames are taken all the same."""

    def broken(*_):
        raise RuntimeError("no network")

    refiner = Refiner(PARAMS, align=broken)
    for frame in tracked(drive(NUM)) * 10:
        refiner.add(frame)
    with pytest.raises(DeloError, match="refinement: RuntimeError: no network"):
        refiner.close()
    refiner.stop()


def test_who_leaves_by_an_error_does_not_wait_for_the_passes():
    """Oracle: the passes that were made, of the eighteen that wait."""
    Ts, made = drive(20), []

    def slow(*arguments):
        made.append(1)
        time.sleep(0.05)
        return NoisyNetwork(Ts)(*arguments)

    def leave_early():
        with Refiner(PARAMS, align=slow) as refiner:
            for frame in tracked(Ts):
                refiner.add(frame)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        leave_early()
    assert len(made) < 10
