"""Clips and drives: determinism, truth, constant work."""

import dataclasses

import jax
import numpy as np
import pytest

from delo_jax.errors import ConfigError
from delo_jax.sim import KINDS, SENSORS, make_motion, make_scene, simulate_clip, simulate_drive, simulate_scan
from delo_jax.sim.drive import DRIVE_SEED, LAST_DRIVE_SEED
from delo_jax.sim.primitives import Label
from delo_jax.sim.warp import flat_warp
from delo_jax.train import worlds
from delo_jax.train.presets import PRESETS

SENSOR = dataclasses.replace(SENSORS["hdl64e"], num_columns=512)


@pytest.mark.parametrize("kind", KINDS)
def test_clip(kind):
    """Oracle: equality of two runs; SE(3); speeds that cars reach."""
    clip, again = (simulate_clip(kind, 7, num_frames=3, sensor=SENSOR) for _ in range(2))
    for scan, same in zip(clip, again, strict=True):
        assert all(a.tobytes() == b.tobytes() for a, b in zip(scan, same, strict=True))
        R = scan.T_world_lidar[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert len(scan.points) > 3000
    steps = np.diff([scan.T_world_lidar[:3, 3] for scan in clip], axis=0)
    assert np.linalg.norm(steps, axis=1).max() < 3.2
    other = simulate_clip(kind, 8, num_frames=1, sensor=SENSOR)
    assert other[0].points.tobytes() != clip[0].points.tobytes()


def test_seeds_give_different_worlds():
    """Oracle: two worlds of one kind share neither layout nor course."""
    labels = [np.bincount(simulate_clip("mixed", s, num_frames=1, sensor=SENSOR)[0].labels, minlength=11) for s in range(6)]
    share = np.array(labels) / np.sum(labels, axis=1, keepdims=True)
    assert np.std(share[:, Label.BUILDING] + share[:, Label.WALL] + share[:, Label.VEGETATION]) > 0.02


def test_drive_stays_on_the_road_at_constant_cost():
    """Oracle: free path ahead, bounded number of things in the world, ids that stay with their object."""
    scans = list(simulate_drive("mixed", 3, 150, SENSOR))
    poses = np.array([scan.T_world_lidar for scan in scans])
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.max() < 3.2
    assert steps.sum() > 40.0
    for scan in scans[::20]:
        solid = scan.points[(scan.labels != Label.GROUND) & (scan.labels != Label.KERB)]
        ahead = (np.abs(solid[:, 1]) < 1.2) & (solid[:, 0] > 0) & (solid[:, 0] < 5.0) & (solid[:, 2] < 0.5)
        assert ahead.sum() < 5
        assert len(scan.points) > 8000


def test_long_drive_is_a_function_of_its_arguments():
    """Oracle: equality of two runs."""
    first, second = (list(simulate_drive("road", 2, 4, SENSOR, rolling_shutter=True)) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert all(x.tobytes() == y.tobytes() for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("validation", [False, True])
def test_training_never_sees_a_drive(validation, monkeypatch, tmp_path):
    """Oracle: every seed that the worlds of every preset are drawn from, in six runs, written down instead of simulated."""
    seeds = set()
    monkeypatch.setattr(worlds, "make_world", lambda index, *, seed, **_: seeds.add(seed + index))
    monkeypatch.setattr(worlds, "write_world", lambda path, world: None)
    monkeypatch.setattr(worlds, "read_world", lambda path: worlds.World(None, None))
    for cfg in PRESETS.values():
        for seed in range(6):
            list(worlds.worlds(dataclasses.replace(cfg, seed=seed), tmp_path, validation=validation))
    assert len(seeds) >= 6 * 40
    assert not seeds & set(range(DRIVE_SEED, LAST_DRIVE_SEED + 1))


@pytest.mark.parametrize("name", ["vlp16", *(pytest.param(name, marks=pytest.mark.slow) for name in ("hdl32e", "os1-128"))])
def test_other_sensors(name):
    """Oracle: the beam table; in a flat world each point of a standing sensor lies on its ring's cone."""
    sensor = dataclasses.replace(SENSORS[name], num_columns=256)
    scene = make_scene("mixed", 0)._replace(warp=flat_warp())
    motion = make_motion(0, 0.3, turning=True, max_speed=0.0, start_x=60.0)
    scan = simulate_scan(scene, motion, 0.0, sensor, jax.random.PRNGKey(0), rolling_shutter=True, noise=False)
    elevation = np.rad2deg(np.arcsin(scan.points[:, 2] / np.linalg.norm(scan.points, axis=1)))
    error = np.abs(elevation[:, None] - np.array(sensor.elevations_deg)[None])
    assert error.min(axis=1).max() < 0.01
    assert len(np.unique(error.argmin(axis=1))) > 0.6 * len(sensor.elevations_deg)


def test_unknown_sensor():
    """Oracle: the message lists what is known."""
    with pytest.raises(ConfigError, match="sensor: expected one of hdl64e, .*, got 'lidar9'"):
        simulate_clip("mixed", 0, sensor="lidar9")
