"""Covariance of a drive on a map."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from delo_jax.model.delo import STREAM_NUMBERS
from delo_jax.uncertainty import stream
from tests.oracles.registration import hat

NUMBERS = stream.StreamNoise(0.1, 0.01, 0.02, 0.03, -0.004, 0.06, 0.002)
NUM = 20_000
UNITS = np.repeat([1e-3, 1e-2], 3)  # rad, m


def scatter(covariance, rng):
    """Poses near the identity, (n, 4, 4): exp(xi) of twists this small, but for the product of angle and length."""
    xi = rng.normal(size=(NUM, 6)) @ np.linalg.cholesky(covariance).T
    T = np.tile(np.eye(4), (NUM, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_rotvec(xi[:, :3]).as_matrix(), xi[:, 3:]
    return T


def sampled(T, Ts):
    """Covariance of poses about one of them."""
    apart = np.linalg.inv(T) @ Ts
    return np.cov(np.hstack([Rotation.from_matrix(apart[:, :3, :3]).as_rotvec(), apart[:, :3, 3]]).T)


def agree(found, expected):
    """Correlations within four standard errors of 20,000 samples."""
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=0.04)


def random_covariance(rng, size):
    half = size * UNITS[:, None] * rng.normal(size=(6, 6)) / 2.5
    return half @ half.T


def test_motions_and_poses_scatter_as_they_say():
    """Oracle: Monte Carlo. A map that drifts, poses on it with errors of their own, a first scan as wrong as the second, a jump between.

    The fourth motion is measured by a pair alone, the fifth on the same map again.
    """
    rng = np.random.default_rng(0)
    steps = [expm(hat([0.02 * k, -0.03, 0.2, 3.0 + k, 0.2, -0.1])) for k in range(5)]
    standing, T_world = stream.EXACT, np.eye(4)
    T_map, T_before = np.tile(np.eye(4), (NUM, 1, 1)), np.tile(np.eye(4), (NUM, 1, 1))
    for k, T in enumerate(steps):
        noise = stream.OnMap(random_covariance(rng, 1.0), random_covariance(rng, 0.4))
        T_world = T_world @ T
        T_map = T_map @ T @ (scatter(noise.local, rng) if k == 0 else np.eye(4))
        if k == 3:
            motion, standing = noise.local, standing.alone(noise.local, T)
            T_sensor = T_before @ T @ scatter(noise.local, rng)
        else:
            T_map = T_map @ scatter(noise.step, rng)
            known, standing = standing.on_map(noise, T)
            T_sensor, motion = T_map @ scatter(noise.local, rng), known.covariance
            np.testing.assert_allclose(known.aleatoric + known.epistemic, np.diag(motion), rtol=1e-12)
            np.testing.assert_allclose(known.epistemic, np.diag(noise.step), rtol=1e-12)
        agree(sampled(T, np.linalg.inv(T_before) @ T_sensor), motion)
        agree(sampled(T_world, T_sensor), standing.covariance)
        T_before = T_sensor


def test_new_map_begins_with_what_is_not_known():
    """Oracle: by hand. The world covariance stays, and the next motion is of two errors on the new map, none of the old one."""
    old = stream.Standing(4.0 * np.eye(6), 2.0 * np.eye(6), False).settled()
    np.testing.assert_array_equal(old.covariance, 6.0 * np.eye(6))
    known, after = old.on_map(stream.OnMap(0.5 * np.eye(6), 0.25 * np.eye(6)), np.eye(4))
    np.testing.assert_allclose(known.covariance, 1.25 * np.eye(6))
    np.testing.assert_allclose(after.covariance, 7.25 * np.eye(6))  # 6, two errors on the map and the drift


def test_noise_of_one_pose():
    """Oracle: by hand, on axes that do not mix, then pitch and z that the same change moves together."""
    classical, still = np.diag(np.arange(1.0, 7.0)), np.zeros(6)
    local, step = stream.noise_on_map(NUMBERS, classical, still, 4.0)
    np.testing.assert_allclose(local, 0.01 * classical)
    np.testing.assert_allclose(step, 4.0 * (0.0036 * classical + np.diag([0, 0, 0, 4e-6, 0, 0])))
    squares = np.array([1.0, 4.0, 9.0, 16.0, 25.0, 36.0])
    local = stream.noise_on_map(NUMBERS, 0.0 * classical, squares, 4.0).local
    expected = np.diag([1e-4, 4e-4 + 36 * 0.004**2, 9e-4, 16 * 4e-4, 25 * 4e-4, 36 * 9e-4])
    expected[1, 5] = expected[5, 1] = -0.004 * 0.03 * 36
    np.testing.assert_allclose(local, expected)


def test_swing_follows_the_velocity():
    """Oracle: by hand: no change by the first motion, the whole of the first change, then half of each newest one."""
    swing, found = stream.STEADY, []
    for velocity in (5.0, 7.0, 7.0, 4.0):
        swing = swing.after(np.full(6, velocity))
        found.append(swing.squares[0])
    np.testing.assert_allclose(found, [0.0, 4.0, 2.0, 5.5])


def test_numbers_are_stored_as_float32_scalars():
    """Oracle: what was stored; a model without them is not calibrated."""
    assert stream.StreamNoise._fields == STREAM_NUMBERS
    assert stream.StreamNoise.of({"params": {}}) is None
    stored = {"stream": NUMBERS.stored()}
    assert {(array.shape, array.dtype.name) for array in stored["stream"].values()} == {((), "float32")}
    assert stream.StreamNoise.of(stored) == pytest.approx(NUMBERS, rel=1e-6)
