"""Prediction at constant velocity."""

import numpy as np
import pytest
from scipy.linalg import expm

from delo_jax.pipeline.motion_model import ConstantVelocity, is_near
from tests.oracles.registration import hat

TWIST = np.array([0.05, -0.1, 0.6, 12.0, 0.5, -0.2])  # per second


def moving(twist=TWIST):
    model = ConstantVelocity()
    model.update(expm(hat(0.1 * twist)), 0.1)
    return model


def test_nothing_is_known_before_the_first_motion():
    """Oracle: by hand; the identity."""
    np.testing.assert_array_equal(ConstantVelocity().predict(5.0), np.eye(4))


@pytest.mark.parametrize("elapsed_s", [0.0, 0.05, 0.1, 0.37, -0.1])
def test_prediction_follows_the_screw_motion(elapsed_s):
    """Oracle: scipy's expm of the twist, whatever the interval it was measured over."""
    np.testing.assert_allclose(moving().velocity, TWIST, rtol=1e-12)
    np.testing.assert_allclose(moving().predict(elapsed_s), expm(hat(elapsed_s * TWIST)), atol=1e-12)


@pytest.mark.parametrize(
    ("xi", "near"),
    [([0, 0, 0.05, 0, 0, 0], True), ([0, 0, 0.06, 0, 0, 0], False), ([0, 0, 0, 0.3, 0.3, 0.2], True), ([0, 0, 0, 0.4, 0.4, 0], False)],
)
def test_a_vehicle_does_not_jump(xi, near):
    """Oracle: by hand; half a metre and three degrees from any pose."""
    T = expm(hat(TWIST))
    assert is_near(T, T @ expm(hat(xi))) is near


def test_velocity_before_a_surprise_is_kept_for_one_motion():
    """Oracle: scipy's expm; a scan that comes twice says that the sensor stands, and the next prediction is both."""
    model = moving()
    assert model.can_tell(0.1)
    model.update(np.eye(4), 0.1)
    assert not model.can_tell(0.1)
    for found, expected in zip(model.predictions(0.2), (np.eye(4), expm(hat(0.2 * TWIST))), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    model.update(expm(hat(0.1 * 0.01 * TWIST)), 0.1)
    assert len(model.predictions(0.1)) == 1
    assert model.can_tell(0.1)


def test_prediction_is_not_trusted_over_a_gap():
    """Oracle: by hand: over more than three missing scans."""
    model = moving()
    assert model.can_tell(0.3)
    assert not model.can_tell(0.4)
    assert not ConstantVelocity().can_tell(0.1)
