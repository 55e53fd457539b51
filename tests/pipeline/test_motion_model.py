"""Prediction at constant velocity, and the de-skew of a sweep."""

import numpy as np
import pytest
from scipy.linalg import expm

from delo_jax.pipeline.motion_model import ConstantVelocity
from tests.oracles.registration import hat

TWIST = np.array([0.05, -0.1, 0.6, 12.0, 0.5, -0.2])  # per second


def moving(twist=TWIST):
    model = ConstantVelocity()
    model.update(expm(hat(0.1 * twist)), 0.1)
    return model


def test_nothing_is_known_before_the_first_motion():
    """Oracle: by hand; the identity, and points as they came."""
    model = ConstantVelocity()
    points = np.ones((3, 3), np.float32)
    np.testing.assert_array_equal(model.predict(5.0), np.eye(4))
    assert model.deskew(points, np.linspace(-0.05, 0.05, 3)) is points


@pytest.mark.parametrize("elapsed_s", [0.0, 0.05, 0.1, 0.37, -0.1])
def test_prediction_follows_the_screw_motion(elapsed_s):
    """Oracle: scipy's expm of the twist, whatever the interval it was measured over."""
    np.testing.assert_allclose(moving().velocity, TWIST, rtol=1e-12)
    np.testing.assert_allclose(moving().predict(elapsed_s), expm(hat(elapsed_s * TWIST)), atol=1e-12)


@pytest.mark.parametrize("speed", [1.0, 15.0, 40.0])
def test_wall_scanned_while_moving_becomes_flat(speed):
    """Oracle: closed form. A wall 20 m ahead is measured at times over the sweep, each point in the sensor's frame of its instant.

    Left alone it bends by the way travelled in half a sweep; afterwards each point is off by half a step between two of the
    128 instants at most, here speed * 0.1 s / 127 / 2, beside float32.
    """
    twist = np.array([0.0, 0.0, 0.3, speed, 0.0, 0.0])
    rng = np.random.default_rng(0)
    wall = np.stack([np.full(120, 20.0), rng.uniform(-10, 10, 120), rng.uniform(-1, 4, 120)], axis=1)
    times = rng.uniform(-0.05, 0.05, 120)
    Ts_lidar_world = expm(np.array([hat(-t * twist) for t in times]))
    measured = np.einsum("nij,nj->ni", Ts_lidar_world[:, :3], np.hstack([wall, np.ones((120, 1))]))
    turned = 0.3 * 0.1 / 127 / 2 * 23.0  # the rotation's half step at the farthest point
    found = moving(twist).deskew(measured.astype(np.float32), times)
    assert np.abs(measured[:, 0] - 20.0).max() > 0.04 * speed
    assert np.linalg.norm(found - wall, axis=1).max() < speed * 0.1 / 127 / 2 + turned + 1e-4
    assert np.abs(found[:, 0] - 20.0).max() < speed * 0.1 / 127 / 2 + turned + 1e-4


def test_point_without_a_time_stays_where_it_is():
    """Oracle: a point at the stamp itself does not move; a time that is not a number must not spoil the others."""
    points = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    times = np.array([-0.05, np.nan, 0.0, np.inf, 0.05])
    found = moving().deskew(points, times)
    known = np.where(np.isfinite(times), times, 0.0)
    expected = [(expm(hat(t * TWIST)) @ np.append(p, 1.0))[:3] for t, p in zip(known, points, strict=True)]
    np.testing.assert_allclose(found, expected, atol=6e-3)  # half a step of 12 m/s, and of the rotation


@pytest.mark.parametrize("num", [0, 1, 4])
def test_sweep_of_one_instant(num):
    """Oracle: closed form, all points measured 20 ms before the stamp."""
    points = np.random.default_rng(0).normal(size=(num, 3)).astype(np.float32)
    found = moving().deskew(points, np.full(num, -0.02))
    T = expm(hat(-0.02 * TWIST))
    np.testing.assert_allclose(found, points @ T[:3, :3].T + T[:3, 3], atol=1e-5)
