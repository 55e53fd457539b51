"""Health status of a pair."""

import numpy as np
import pytest

from delo_jax.config import StatusConfig
from delo_jax.uncertainty.observability import Observability, observability
from delo_jax.uncertainty.status import STATUSES, judge
from tests.uncertainty.planes import CORRIDOR, FIELD, ROOM, information

CFG = StatusConfig(min_points=100, ok_confidence=0.5, rejected_confidence=0.05, min_observability=1e-3)
GOOD = {
    "num_points": (100, 100),
    "finite": True,
    "confidence": 0.5,
    "seen": Observability(np.array([1e-3, 0.1, 0.2, 0.3, 0.4, 0.5]), np.eye(6)[::-1]),
}
NO_HEAD = "this network has no evidence head: nothing says how far its pose can be trusted"
SLIPPERY = Observability(np.array([5e-4, 0.1, 0.2, 0.3, 0.4, 0.5]), np.eye(6)[[4, 0, 1, 2, 3, 5]])


@pytest.mark.parametrize(
    ("changed", "status", "reason", "confidence"),
    [
        ({}, "ok", "", 0.5),
        ({"confidence": 1.0}, "ok", "", 1.0),
        ({"confidence": 0.4999}, "low_confidence", "confidence 0.50 is below 0.5", 0.4999),
        ({"confidence": 0.05}, "low_confidence", "confidence 0.05 is below 0.5", 0.05),
        ({"confidence": 0.01}, "rejected", "confidence 0.01 is below 0.05", 0.01),
        ({"confidence": None}, "low_confidence", NO_HEAD, 0.0),
        ({"confidence": None, "seen": SLIPPERY}, "degenerate", "hardly any surface holds lateral (0.00050 is below 0.001)", 0.0),
        ({"confidence": None, "finite": False}, "rejected", "the solver found no pose: its matches determine none", 0.0),
        ({"finite": False}, "rejected", "the solver found no pose: its matches determine none", 0.0),
        ({"num_points": (99, 100)}, "rejected", "source has 99 usable points, fewer than 100", 0.0),
        ({"num_points": (3000, 0)}, "rejected", "target has 0 usable points, fewer than 100", 0.0),
        ({"num_points": (90, 50)}, "rejected", "target has 50 usable points, fewer than 100", 0.0),
        ({"num_points": (50, 90)}, "rejected", "source has 50 usable points, fewer than 100", 0.0),
        ({"seen": SLIPPERY}, "degenerate", "hardly any surface holds lateral (0.00050 is below 0.001)", 0.5),
    ],
)
def test_each_status_has_its_reason(changed, status, reason, confidence):
    """Oracle: the documented thresholds; every limit itself still passes."""
    health = judge(**(GOOD | changed), cfg=CFG)
    assert (health.status, health.reason, health.confidence) == (status, reason, confidence)
    assert health.status in STATUSES


@pytest.mark.parametrize(
    ("scene", "status", "axes"), [(FIELD, "degenerate", "yaw, forward, lateral"), (CORRIDOR, "degenerate", "forward"), (ROOM, "ok", "")]
)
def test_reason_names_every_unheld_axis(scene, status, axes):
    """Oracle: geometry, in the frame of the sensor: x forward, y left, z up."""
    health = judge(**(GOOD | {"seen": observability(information(scene))}), cfg=CFG)
    assert health.status == status
    assert health.reason == (f"hardly any surface holds {axes} (0.00000 is below 0.001)" if axes else "")


@pytest.mark.parametrize(
    ("changed", "status"),
    [
        ({"num_points": (0, 0), "finite": False, "confidence": 0.0, "seen": SLIPPERY}, "rejected"),
        ({"finite": False, "seen": observability(np.zeros((6, 6))), "confidence": 1.0}, "rejected"),
        ({"confidence": 0.01, "seen": SLIPPERY}, "rejected"),
        ({"confidence": 0.3, "seen": SLIPPERY}, "degenerate"),
    ],
)
def test_the_worst_status_wins(changed, status):
    """Oracle: the order rejected, degenerate, low_confidence, ok."""
    assert judge(**(GOOD | changed), cfg=CFG).status == status
