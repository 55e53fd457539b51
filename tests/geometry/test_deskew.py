"""The de-skew of a sweep at constant velocity."""

import numpy as np
import pytest
from scipy.linalg import expm

from delo_jax.geometry.deskew import deskew
from tests.oracles.registration import hat

TWIST = np.array([0.05, -0.1, 0.6, 12.0, 0.5, -0.2])  # per second


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
    found = deskew(measured.astype(np.float32), times, twist)
    assert np.abs(measured[:, 0] - 20.0).max() > 0.04 * speed
    assert np.linalg.norm(found - wall, axis=1).max() < speed * 0.1 / 127 / 2 + turned + 1e-4
    assert np.abs(found[:, 0] - 20.0).max() < speed * 0.1 / 127 / 2 + turned + 1e-4


def test_point_without_a_time_stays_where_it_is():
    """Oracle: a point at the stamp itself does not move; a time that is not a number must not spoil the others."""
    points = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    times = np.array([-0.05, np.nan, 0.0, np.inf, 0.05])
    found = deskew(points, times, TWIST)
    known = np.where(np.isfinite(times), times, 0.0)
    expected = [(expm(hat(t * TWIST)) @ np.append(p, 1.0))[:3] for t, p in zip(known, points, strict=True)]
    np.testing.assert_allclose(found, expected, atol=6e-3)  # half a step of 12 m/s, and of the rotation


@pytest.mark.parametrize("num", [0, 1, 4])
def test_sweep_of_one_instant(num):
    """Oracle: closed form, all points measured 20 ms before the stamp."""
    points = np.random.default_rng(0).normal(size=(num, 3)).astype(np.float32)
    found = deskew(points, np.full(num, -0.02), TWIST)
    T = expm(hat(-0.02 * TWIST))
    np.testing.assert_allclose(found, points @ T[:3, :3].T + T[:3, 3], atol=1e-5)
