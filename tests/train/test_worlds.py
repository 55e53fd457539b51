"""Worlds on disk: made once, told apart by what they were made from."""

import dataclasses

import numpy as np
import pytest

from delo_jax.config import PreprocessConfig
from delo_jax.preprocess import preprocess
from delo_jax.sim import KINDS, SimulatedScan
from delo_jax.train import worlds as module
from delo_jax.train.worlds import worlds
from tests.fixtures import TINY_TRAINING
from tests.oracles import street

CFG = dataclasses.replace(TINY_TRAINING, num_scenes=7, num_validation_scenes=2, num_frames=2)


def sweep(T_world_lidar, times_s=0.0):
    """A scan of the street as the simulator delivers it."""
    points = street.scan(T_world_lidar, num_rings=8, num_columns=180).points
    num = len(points)
    ids = np.zeros(num, np.int32)
    return SimulatedScan(points, np.full(num, times_s), np.zeros((num, 3)), ids, ids, np.zeros(num, bool), T_world_lidar)


@pytest.fixture
def simulator(monkeypatch):
    """Stands in for the simulator: the street from poses that depend on the seed; remembers its calls."""
    calls = []

    def simulate_clip(kind, seed, *, num_frames, sensor):
        calls.append((kind, seed, sensor))
        poses = [street.pose(0.001 * (seed % 1000) + k) for k in range(num_frames)]
        return [sweep(T) for T in poses]

    monkeypatch.setattr(module, "simulate_clip", simulate_clip)
    return calls


def test_worlds_are_simulated_once_and_read_back(simulator, tmp_path):
    """Oracle: the scans preprocessed by hand; normals and features are kept in half precision."""
    progress = []
    first = list(worlds(CFG, tmp_path, validation=False, on_world=lambda: progress.append(1)))
    assert (len(first), len(progress), len(simulator)) == (7, 7, 7)
    again = list(worlds(CFG, tmp_path, validation=False))
    assert len(simulator) == 7
    for index, (world, read) in enumerate(zip(first, again, strict=True)):
        assert all(a.tobytes() == b.tobytes() for a, b in zip(world.scans, read.scans, strict=True))
        for frame in range(2):
            T = street.pose(0.001 * index + frame)
            np.testing.assert_array_equal(world.Ts_world_lidar[frame], T)
            expected = preprocess(street.scan(T, num_rings=8, num_columns=180).points, CFG.model.preprocess)
            for name, array in expected._asdict().items():
                found = getattr(world.scans, name)[frame]
                assert found.dtype == array.dtype
                np.testing.assert_allclose(found, array, **({"rtol": 1e-3, "atol": 1e-3} if name in ("normals", "features") else {}))


def test_kinds_take_turns_and_validation_is_apart(simulator, tmp_path):
    """Oracle: the list of kinds; no seed of a validation world is one of a training world."""
    list(worlds(CFG, tmp_path, validation=False))
    training = simulator.copy()
    simulator.clear()
    list(worlds(CFG, tmp_path, validation=True))
    assert [kind for kind, _, _ in training] == [KINDS[index % len(KINDS)] for index in range(7)]
    assert len(simulator) == 2
    assert not {seed for _, seed, _ in training} & {seed for _, seed, _ in simulator}
    assert min(seed for _, seed, _ in simulator) >= module.VALIDATION_SEED


def test_runs_of_different_seeds_share_no_world(simulator, tmp_path):
    """Oracle: the calls of the simulator, over three seeds, training and validation."""
    for seed in range(3):
        for validation in (False, True):
            list(worlds(dataclasses.replace(CFG, seed=seed), tmp_path, validation=validation))
    seeds = [seed for _, seed, _ in simulator]
    assert len(seeds) == len(set(seeds)) == 3 * (7 + 2)


def test_worlds_of_another_simulator_are_made_anew(simulator, tmp_path, monkeypatch):
    """Oracle: the calls of the simulator."""
    list(worlds(CFG, tmp_path, validation=False))
    monkeypatch.setattr(module, "SIMULATOR", module.SIMULATOR + 1)
    list(worlds(CFG, tmp_path, validation=False))
    assert len(simulator) == 2 * 7


def test_interrupted_run_goes_on(simulator, tmp_path):
    """Oracle: the calls of the simulator; what was written stays, half a file does not count."""
    whole = list(worlds(CFG, tmp_path, validation=False))
    files = sorted(tmp_path.iterdir())
    files[4].rename(files[4].with_suffix(".part"))
    files[5].unlink()
    simulator.clear()
    again = list(worlds(CFG, tmp_path, validation=False))
    assert len(simulator) == 2
    for one, other in zip(whole, again, strict=True):
        assert all(a.tobytes() == b.tobytes() for a, b in zip(one.scans, other.scans, strict=True))


@pytest.mark.parametrize(
    "changed",
    [
        {"seed": 1},
        {"num_frames": 3},
        {"model": dataclasses.replace(CFG.model, preprocess=PreprocessConfig(max_points=100, num_keypoints=32))},
    ],
)
def test_worlds_of_another_making_are_not_mixed_up(simulator, tmp_path, changed):
    """Oracle: the calls of the simulator; other frames, seed or preprocessing are made anew, another learning rate is not."""
    list(worlds(CFG, tmp_path, validation=False))
    simulator.clear()
    list(worlds(dataclasses.replace(CFG, learning_rate=1e-5, num_steps=20), tmp_path, validation=False))
    assert len(simulator) == 0
    list(worlds(dataclasses.replace(CFG, **changed), tmp_path, validation=False))
    assert len(simulator) == 7


def test_two_thirds_of_the_worlds_are_deskewed(monkeypatch):
    """Oracle: the drive's own velocity. All points are 50 ms late: a de-skewed scan is 0.45 m ahead, within what the velocity is off."""
    poses = [street.pose(0.9 * k) for k in range(3)]
    monkeypatch.setattr(module, "simulate_clip", lambda *_arguments, **_options: [sweep(T, 0.05) for T in poses])
    raw = module.preprocess(sweep(poses[0]).points, CFG.model.preprocess)
    shifts = []
    for index in range(60):
        scans = module.make_world(index, seed=0, num_frames=3, cfg=CFG.model.preprocess).scans
        shift = (scans.points[0] - raw.points)[raw.mask]
        shifts.append(np.median(shift[:, 0]))
    still = np.array(shifts) != 0.0
    assert abs(still.mean() - 2 / 3) < 5 * np.sqrt(2 / 9 / 60)
    np.testing.assert_allclose(np.array(shifts)[still], 0.45, atol=5 * 0.2 * 0.05 + 0.1)
