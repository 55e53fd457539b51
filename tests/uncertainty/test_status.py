"""Health status of a pair."""

import numpy as np
import pytest

from delo_jax.config import StatusConfig
from delo_jax.uncertainty.status import STATUSES, judge

CFG = StatusConfig(min_points=100, ok_confidence=0.5, rejected_confidence=0.05, min_observability=1e-3)
GOOD = {
    "num_points": (100, 100),
    "finite": True,
    "confidence": 0.5,
    "observability": np.array([1e-3, 0.4, 0.599]),
    "weakest_axis": np.array([0.0, 1.0, 0.0]),
}
SLIPPERY = np.array([5e-4, 0.4, 0.6])


@pytest.mark.parametrize(
    ("changed", "status", "reason", "confidence"),
    [
        ({}, "ok", "", 0.5),
        ({"confidence": 1.0}, "ok", "", 1.0),
        ({"confidence": 0.4999}, "low_confidence", "confidence 0.50 is below 0.5", 0.4999),
        ({"confidence": 0.05}, "low_confidence", "confidence 0.05 is below 0.5", 0.05),
        ({"confidence": 0.01}, "rejected", "confidence 0.01 is below 0.05", 0.01),
        ({"finite": False}, "rejected", "the solver returned no finite pose", 0.0),
        ({"num_points": (99, 100)}, "rejected", "source has 99 usable points, fewer than 100", 0.0),
        ({"num_points": (3000, 0)}, "rejected", "target has 0 usable points, fewer than 100", 0.0),
        ({"num_points": (90, 50)}, "rejected", "target has 50 usable points, fewer than 100", 0.0),
        ({"num_points": (50, 90)}, "rejected", "source has 50 usable points, fewer than 100", 0.0),
        ({"observability": SLIPPERY}, "degenerate", "hardly any surface holds the lateral direction (0.0005)", 0.5),
    ],
)
def test_each_status_has_its_reason(changed, status, reason, confidence):
    """Oracle: the documented thresholds; every limit itself still passes."""
    health = judge(**(GOOD | changed), cfg=CFG)
    assert (health.status, health.reason, health.confidence) == (status, reason, confidence)
    assert health.status in STATUSES


@pytest.mark.parametrize(
    ("axis", "name"),
    [([1, 0, 0], "forward"), ([-0.9, 0.3, 0.3], "forward"), ([0.1, -0.9, 0.2], "lateral"), ([0, 0.2, -0.9], "vertical")],
)
def test_weakest_direction_is_named(axis, name):
    """Oracle: the frame of the sensor, x forward, y left, z up; a direction has no sign."""
    health = judge(**(GOOD | {"observability": SLIPPERY, "weakest_axis": np.array(axis)}), cfg=CFG)
    assert f"holds the {name} direction" in health.reason


@pytest.mark.parametrize(
    ("changed", "status"),
    [
        ({"num_points": (0, 0), "finite": False, "confidence": 0.0, "observability": SLIPPERY}, "rejected"),
        ({"finite": False, "observability": np.full(3, np.nan), "confidence": 1.0}, "rejected"),
        ({"confidence": 0.01, "observability": SLIPPERY}, "rejected"),
        ({"confidence": 0.3, "observability": SLIPPERY}, "degenerate"),
    ],
)
def test_the_worst_status_wins(changed, status):
    """Oracle: the order rejected, degenerate, low_confidence, ok."""
    assert judge(**(GOOD | changed), cfg=CFG).status == status
