"""Prediction at constant velocity."""

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
    """Oracle: by hand; the identity."""
    np.testing.assert_array_equal(ConstantVelocity().predict(5.0), np.eye(4))


@pytest.mark.parametrize("elapsed_s", [0.0, 0.05, 0.1, 0.37, -0.1])
def test_prediction_follows_the_screw_motion(elapsed_s):
    """Oracle: scipy's expm of the twist, whatever the interval it was measured over."""
    np.testing.assert_allclose(moving().velocity, TWIST, rtol=1e-12)
    np.testing.assert_allclose(moving().predict(elapsed_s), expm(hat(elapsed_s * TWIST)), atol=1e-12)
