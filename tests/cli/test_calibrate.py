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
from delo_jax.train import calibrate, calibrate_stream, worlds
from delo_jax.train.presets import PRESETS
from delo_jax.uncertainty.stream import StreamNoise
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
    code, out, _ = cli("calibrate", "delo-base", "--out", str(tmp_path), "--num-worlds", "8", "--num-drives", "0")
    assert code == 0
    assert simulator == list(range(worlds.CALIBRATION_SEED, worlds.CALIBRATION_SEED + 8))
    assert "coverage at 68 %" in out
    card = weights.read_card(tmp_path / "delo-base.safetensors")
    assert card["calibration"]["pairs"] == 16
    assert card["calibration"]["command"] == "delo calibrate delo-base --num-worlds 8 --num-drives 0"
    assert card["name"] == "delo-base"
    assert card["training"] == weights.read_card("delo-base")["training"]
    scans = [street.scan(street.pose(0.5 * k), noise_m=0.02, seed=k).points for k in range(2)]
    found, released = (delo_jax.odometry(delo_jax.load(name), *scans) for name in (tmp_path / "delo-base.safetensors", "delo-base"))
    np.testing.assert_array_equal(found.T_target_source, released.T_target_source)
    assert np.linalg.eigvalsh(found.covariance).min() > 0
    assert not np.allclose(found.covariance, released.covariance, rtol=0.01)
    np.testing.assert_allclose(found.aleatoric + found.epistemic, np.diag(found.covariance), rtol=1e-9)


def test_drives_are_calibrated_beside_the_pairs(monkeypatch, cli, tmp_path):
    """Oracle: the card, the seeds of the drives, and the other weights, which stay byte for byte; a second call simulates nothing."""
    seeds = []

    def simulate_drive(kind, seed, num_scans, *, rolling_shutter):
        seeds.append((seed, rolling_shutter))
        for k in range(num_scans):
            yield sweep(street.pose(0.2 * (seed % 5) + 0.8 * k), seed + k)

    monkeypatch.setattr(calibrate_stream, "simulate_drive", simulate_drive)
    monkeypatch.setattr(calibrate_stream, "NUM_SCANS", 7)
    monkeypatch.setattr(calibrate_stream, "GAPS", (1, 3))
    monkeypatch.setattr(calibrate_stream, "MAX_STEPS", 5)
    monkeypatch.setattr(calibrate_stream, "NUM_FOLDS", 2)
    words = "calibrate", "delo-base", "--out", tmp_path, "--num-worlds", "0", "--num-drives", "4"
    code, out, _ = cli(*words)
    assert code == 0
    first = calibrate_stream.DRIVE_SEED
    assert seeds == [(first, True), (first + 1, True), (first + 2, True), (first + 3, False)]
    assert "over 3 frames" in out
    path = tmp_path / "delo-base.safetensors"
    about = weights.read_card(path)["stream calibration"]
    assert about["command"] == "delo calibrate delo-base --num-worlds 0 --num-drives 4"
    assert about["drives"].startswith(f"drives {first} to {first + 3}")
    assert weights.read_card(path)["calibration"] == weights.read_card("delo-base")["calibration"]
    found, released = weights.load(path), weights.load("delo-base")
    numbers = StreamNoise.of(found.variables)
    assert numbers is not None
    assert np.isfinite(numbers).all()
    for name in ("params", "covariance"):
        ours, theirs = (jax.tree.leaves(model.variables[name]) for model in (found, released))
        assert [np.asarray(a).tobytes() for a in ours] == [np.asarray(a).tobytes() for a in theirs]
    before = path.read_bytes()
    assert cli(*words)[0] == 0
    assert len(seeds) == 4
    assert path.read_bytes() == before


def test_what_cannot_be_calibrated_is_one_sentence(cli, tmp_path):
    """Oracle: exit code 2 and the documented sentences."""
    cfg = dataclasses.replace(PRESETS["tiny"].model, evidence=EvidenceConfig(head="none"))
    headless = weights.save(tmp_path / "headless", delo.init(cfg, jax.random.key(0)), {"name": "headless"})
    for words, sentence in (
        (("delo-base", "--num-worlds", "2"), "--num-worlds: expected 8 or more, or 0 to leave that part as it is, got 2"),
        (("delo-base", "--num-drives", "1"), "--num-drives: expected 2 or more, or 0 to leave that part as it is, got 1"),
        ((headless,), "expected a statistics head, got 'none'"),
    ):
        code, _, err = cli("calibrate", *words, "--out", tmp_path)
        assert (code, err.count("\n")) == (2, 1)
        assert sentence in err
