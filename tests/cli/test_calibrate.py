"""`delo calibrate`, on worlds that a small simulator makes."""

import dataclasses

import jax
import numpy as np
import pytest

import delo_jax
from delo_jax import weights
from delo_jax.config import EvidenceConfig
from delo_jax.model import delo
from delo_jax.sim import SimulatedScan
from delo_jax.train import calibrate, worlds
from delo_jax.train.presets import PRESETS
from tests.oracles import street


def sweep(T_world_lidar, seed):
    """A scan of the street as the simulator delivers it."""
    points = street.scan(T_world_lidar, noise_m=0.02, seed=seed).points
    num = len(points)
    ids = np.zeros(num, np.int32)
    return SimulatedScan(points, np.zeros(num), np.zeros((num, 3)), ids, ids, np.zeros(num, bool), T_world_lidar)


@pytest.fixture
def simulator(monkeypatch):
    """Clips of the analytic street instead of simulated ones; returns the seeds asked for. Fits are short."""
    seeds = []

    def simulate_clip(kind, seed, *, num_frames, sensor):
        seeds.append(seed)
        return [sweep(street.pose(0.1 * (seed % 7) + 0.8 * frame), seed + frame) for frame in range(num_frames)]

    monkeypatch.setattr(worlds, "simulate_clip", simulate_clip)
    monkeypatch.setattr(calibrate, "MAX_STEPS", 5)
    monkeypatch.setattr(calibrate, "NUM_FOLDS", 2)
    monkeypatch.setattr(calibrate, "FRAMES", ((0, 1), (3, 5)))
    return seeds


def test_calibrated_weights_are_written_and_used(simulator, cli, tmp_path):
    """Oracle: the card, the seeds of the worlds, and the covariance that `odometry` gives with the weights and without."""
    code, out, _ = cli("calibrate", "delo-base", "--out", str(tmp_path), "--num-worlds", "8")
    assert code == 0
    assert simulator == list(range(worlds.CALIBRATION_SEED, worlds.CALIBRATION_SEED + 8))
    assert "coverage at 68 %" in out
    card = weights.read_card(tmp_path / "delo-base.safetensors")
    assert card["calibration"]["pairs"] == 16
    assert card["calibration"]["command"] == "delo calibrate delo-base --num-worlds 8"
    assert card["name"] == "delo-base"
    assert card["training"] == weights.read_card("delo-base")["training"]
    scans = [street.scan(street.pose(0.5 * k), noise_m=0.02, seed=k).points for k in range(2)]
    found, released = (delo_jax.odometry(delo_jax.load(name), *scans) for name in (tmp_path / "delo-base.safetensors", "delo-base"))
    np.testing.assert_array_equal(found.T_target_source, released.T_target_source)
    assert np.linalg.eigvalsh(found.covariance).min() > 0
    assert not np.allclose(found.covariance, released.covariance, rtol=0.01)
    np.testing.assert_allclose(found.aleatoric + found.epistemic, np.diag(found.covariance), rtol=1e-9)


def test_what_cannot_be_calibrated_is_one_sentence(cli, tmp_path):
    """Oracle: exit code 2 and the documented sentences."""
    cfg = dataclasses.replace(PRESETS["tiny"].model, evidence=EvidenceConfig(head="none"))
    headless = weights.save(tmp_path / "headless", delo.init(cfg, jax.random.key(0)), {"name": "headless"})
    for words, sentence in (
        (("delo-base", "--num-worlds", "2"), "--num-worlds: expected 8 or more, got 2"),
        ((headless,), "expected a statistics head, got 'none'"),
    ):
        code, _, err = cli("calibrate", *words, "--out", tmp_path)
        assert (code, err.count("\n")) == (2, 1)
        assert sentence in err
