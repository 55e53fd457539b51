"""Directions that no surface holds."""

import numpy as np
import pytest
from scipy.linalg import eigh, null_space
from scipy.spatial.transform import Rotation

from delo_jax.uncertainty.observability import AXES, LEVER_M, observability
from tests.uncertainty.planes import CORRIDOR, FIELD, FRONT, ROOM, information

SCALE = np.repeat([LEVER_M, 1.0], 3)  # metres per rad, metres per metre
MINIMUM = 3e-3


@pytest.mark.parametrize(
    ("scene", "axes"),
    [
        (FIELD, ["yaw", "forward", "lateral"]),
        (CORRIDOR, ["forward"]),
        ([FRONT], ["roll", "lateral", "vertical"]),
        (ROOM, []),
        ([], list(AXES)),
    ],
)
def test_unheld_directions_are_named(scene, axes):
    """Oracle: geometry; a plane slides along itself and turns about its normal, a corridor slides along its axis."""
    seen = observability(information(scene) if scene else np.zeros((6, 6)))
    assert seen.unheld_axes(MINIMUM) == axes
    assert seen.unheld(MINIMUM).shape == (len(axes), 6)


@pytest.mark.parametrize("scene", [FIELD, CORRIDOR, [FRONT]])
def test_unheld_directions_span_the_motions_that_move_no_plane(scene):
    """Oracle: SciPy's null space of the information matrix; the projections on both spaces are equal, in metres."""
    exact, _ = np.linalg.qr(null_space(information(scene)) * SCALE[:, None])
    found = observability(information(scene)).unheld(MINIMUM) * SCALE
    np.testing.assert_allclose(found.T @ found, exact @ exact.T, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_shares_are_squared_distances_per_squared_metre(seed):
    """Oracle: SciPy's generalised eigenproblem, information against a metre at the arm; and the quadratic form of each direction."""
    rows = np.random.default_rng(seed).normal(size=(9, 6)) * np.repeat([10.0, 1.0], 3)
    matrix = rows.T @ rows / 9
    seen = observability(matrix.astype(np.float32))
    np.testing.assert_allclose(seen.shares, eigh(matrix, np.diag(SCALE**2), eigvals_only=True), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose([d @ matrix @ d for d in seen.directions], seen.shares, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose((seen.directions * SCALE) @ (seen.directions * SCALE).T, np.eye(6), atol=1e-12)
    assert np.all(np.diff(seen.shares) >= 0)


def test_a_corridor_may_be_slanted():
    """Oracle: the corridor turned by 45 deg; neither horizontal axis holds it more than the other."""
    R = Rotation.from_euler("z", 45, degrees=True).as_matrix()
    seen = observability(information(CORRIDOR, R))
    np.testing.assert_allclose(np.abs(seen.unheld(MINIMUM)), [[0, 0, 0, np.sqrt(0.5), np.sqrt(0.5), 0]], atol=1e-9)
    assert seen.unheld_axes(MINIMUM) == ["forward", "lateral"]
