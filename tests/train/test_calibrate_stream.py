"""Covariances of a drive on a map, fitted to errors."""

import jax
import numpy as np
import pytest
from scipy.linalg import expm

from delo_jax.metrics.calibration import coverage, nees
from delo_jax.model import delo
from delo_jax.train import calibrate_stream as module
from delo_jax.train.presets import PRESETS
from delo_jax.uncertainty import stream
from tests.oracles.registration import hat

TRUE = stream.StreamNoise(0.2, 0.012, 0.02, 0.012, -0.004, 0.15, 0.012)


def bounced(num, rng):
    """Poses of a sensor that drives and bounces: velocities change from frame to frame by up to 0.2 rad/s and 0.8 m/s."""
    sizes = np.array([0.12, 0.08, 0.05, 0.4, 0.3, 0.5]) * rng.uniform(0.2, 1.5)
    velocities = np.array([0.0, 0.0, 0.1, 8.0, 0.0, 0.0]) + sizes * rng.normal(size=(num, 6))
    poses = [np.eye(4)]
    for velocity in velocities[1:]:
        poses.append(poses[-1] @ expm(hat(0.1 * velocity)))
    return np.stack(poses), velocities


def synthetic(seed, num=50):
    """A drive whose errors were drawn from the model; the map drifts, the first scan is as wrong as the second."""
    rng = np.random.default_rng(seed)
    timed = seed % 4 != 3
    Ts_true, velocities = bounced(num, rng)
    halves = np.array([1e-3, 5e-4, 5e-4, 0.02, 0.01, 0.01])[None, :, None] * rng.normal(size=(num, 6, 6))
    classical = rng.uniform(0.3, 2.0, (num, 1, 1)) * (halves @ halves.transpose(0, 2, 1))
    T_map, Ts, squares = np.eye(4), [np.eye(4)], np.zeros(6)
    for k in range(1, num):
        if k > 1:
            change = (velocities[k] - velocities[k - 1]) ** 2
            squares = change if k == 2 else 0.5 * squares + 0.5 * change
        way_m = 0.1 * np.linalg.norm(velocities[k, 3:])
        noise = stream.noise_on_map(TRUE, classical[k], squares * timed, way_m)
        draw = [np.linalg.cholesky(C + 1e-16 * np.eye(6)) @ rng.normal(size=6) for C in (noise.local, noise.step, noise.local)]
        T_map = T_map @ expm(hat(0.1 * velocities[k])) @ (expm(hat(draw[2])) if k == 1 else np.eye(4)) @ expm(hat(draw[1]))
        Ts.append(T_map @ expm(hat(draw[0])))
    return module.Drive(Ts_true, np.stack(Ts), classical, np.ones(num, bool), np.array(timed))


@pytest.fixture
def gaps(monkeypatch):
    """Shorter ones."""
    monkeypatch.setattr(module, "GAPS", (1, 10, 30))
    monkeypatch.setattr(module, "NUM_FOLDS", 2)
    monkeypatch.setattr(module, "MAX_STEPS", 80)


@pytest.mark.usefixtures("gaps")
def test_fit_finds_the_numbers_that_the_errors_were_drawn_from():
    """Oracle: the construction: 16 drives; then 24 drives that the fit has not seen, coverages within four standard errors of a share."""
    model = delo.init(PRESETS["tiny"].model, jax.random.key(0))
    calls = []
    rows = module.segments([synthetic(seed) for seed in range(16)])
    calibrated, unseen = module.calibrate(model, rows, lambda: calls.append(1))
    assert len(calls) == module.num_fits(rows) == 3
    found = stream.StreamNoise.of(calibrated.variables)
    for name, number, expected in zip(TRUE._fields, found, TRUE, strict=True):
        assert abs(np.log(number / expected)) < 0.35, name  # the drift is seen by few independent motions
    single = rows.gaps == 1
    assert 0.9 < nees(rows.errors[single], unseen[single]).mean() / 6 < 1.1
    fresh = module.segments([synthetic(seed) for seed in range(100, 124)])
    C = module.covariances(found, fresh)
    for gap, (least, most) in {1: (0.9, 1.1), 10: (0.8, 1.25), 30: (0.7, 1.4), module.WORLD: (0.7, 1.4)}.items():
        which = fresh.gaps == gap
        assert least < nees(fresh.errors[which], C[which]).mean() / 6 < most, gap
    which = fresh.gaps == 1
    shares = coverage(fresh.errors[which], np.sqrt(np.diagonal(C[which], axis1=1, axis2=2)), 0.68)
    np.testing.assert_allclose(shares, 0.68, atol=4.0 * np.sqrt(0.68 * 0.32 / which.sum()))


@pytest.mark.usefixtures("gaps")
def test_segments_say_what_the_stream_says():
    """Oracle: `stream.Standing`, pose by pose, for single motions and for poses in the world."""
    drive = synthetic(0, num=12)
    rows = module.segments([drive])
    C = module.covariances(TRUE, rows) * np.outer(module.UNITS, module.UNITS)
    standing, swing, motions, poses = stream.EXACT, stream.STEADY, [], []
    for k in range(1, 12):
        T = np.linalg.inv(drive.Ts_world_lidar[k - 1]) @ drive.Ts_world_lidar[k]
        swing = swing.after(module.se3.log(T) / 0.1)
        noise = stream.noise_on_map(TRUE, drive.classical[k], swing.squares, float(np.linalg.norm(T[:3, 3])))
        known, standing = standing.on_map(noise, T)
        motions.append(known.covariance)
        poses.append(standing.covariance)
    np.testing.assert_allclose(C[rows.gaps == 1], np.stack(motions[1:]), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(C[rows.gaps == module.WORLD], np.stack(poses), rtol=1e-6, atol=1e-12)


@pytest.mark.usefixtures("gaps")
def test_bad_frames_are_left_out():
    """Oracle: by hand: a bad seventh frame of twelve ends the world, and the motions to it, from it and across it."""
    drive = synthetic(1, num=12)
    drive.good[6] = False
    rows = module.segments([drive])
    count = {gap: int(np.sum(rows.gaps == gap)) for gap in (1, 10, module.WORLD)}
    assert count == {1: 4 + 4, 10: 0, module.WORLD: 5}
