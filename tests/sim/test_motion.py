"""Vehicle motion: bounds and consistency of its samples."""

import numpy as np
import pytest

from delo_jax.sim.motion import SAMPLE_S, make_motion, pose_at


@pytest.mark.parametrize("turning", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_stays_within_what_cars_do(turning, seed):
    """Oracle: the stated bounds, by finite differences of the positions."""
    motion = make_motion(seed, 20.0, turning=turning, max_speed=25.0)
    velocity = np.diff(motion.position, axis=0) / SAMPLE_S
    speed = np.linalg.norm(velocity, axis=1)
    assert speed.max() <= 25.2
    assert np.abs(np.diff(speed)).max() / SAMPLE_S < 4.5
    rate = np.gradient(motion.heading, SAMPLE_S)
    assert np.abs(rate).max() <= np.deg2rad(45.0) + 1e-6
    assert np.abs(rate[1:] * speed).max() < 6.0
    assert np.abs(np.rad2deg([motion.pitch, motion.roll])).max() < 3.0
    if not turning:
        assert np.abs(motion.position[:, 1]).max() <= 0.3
        assert np.abs(motion.heading).max() < 0.07


@pytest.mark.parametrize("seed", range(4))
def test_never_slides_sideways(seed):
    """Oracle: the direction of the displacement, by finite differences."""
    motion = make_motion(seed, 10.0, turning=True)
    step = np.diff(motion.position, axis=0)
    moved = np.linalg.norm(step, axis=1) > 1e-3
    middle = 0.5 * (motion.heading[1:] + motion.heading[:-1])
    sideways = (np.cos(middle) * step[:, 1] - np.sin(middle) * step[:, 0])[moved]
    assert np.all(np.abs(sideways) <= 0.006 * np.linalg.norm(step, axis=1)[moved])


def test_whole_range_of_driving_occurs():
    """Oracle: the stated range, over the first half second of many motions."""
    speeds, rates = [], []
    for seed in range(200):
        motion = make_motion(seed, 0.5, turning=seed % 2 == 0)
        speeds.append(np.linalg.norm(motion.position[-1] - motion.position[0]) / (SAMPLE_S * len(motion.heading)))
        rates.append(np.rad2deg(abs(motion.heading[-1] - motion.heading[0])) / (SAMPLE_S * len(motion.heading)))
    assert np.mean(np.array(speeds) < 0.1) > 0.02
    assert np.mean(np.array(speeds) > 20.0) > 0.1
    assert np.max(rates) > 30.0


def test_poses():
    """Oracle: SE(3), and the sensor's height along the body's up axis."""
    motion = make_motion(3, 2.0, turning=True)
    times = np.linspace(0.0, 2.0, 40)
    poses, raised = pose_at(motion, times), pose_at(motion, times, 1.7)
    R = poses[:, :3, :3]
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.tile(np.eye(3), (40, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(raised[:, :3, 3], poses[:, :3, 3] + 1.7 * R[:, :, 2], atol=1e-12)
    np.testing.assert_allclose(
        np.arctan2(R[:, 1, 0], R[:, 0, 0]), np.mod(np.interp(times, motion.times, motion.heading) + np.pi, 2 * np.pi) - np.pi, atol=1e-9
    )
