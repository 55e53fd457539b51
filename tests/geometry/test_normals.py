"""Planes through neighbours."""

import numpy as np
import pytest

from delo_jax.geometry.normals import plane_fit


def patches(seed, thickness, n=64, k=16):
    """Random flat patches 30 m away, some neighbours not valid."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    spread = np.array([0.5, 0.4, thickness])
    neighbors = (rng.normal(size=(n, k, 3)) * spread) @ axes.swapaxes(1, 2) + 30 * rng.normal(size=(n, 1, 3))
    valid = rng.uniform(size=(n, k)) < 0.8
    valid[:, :5] = True
    return neighbors.astype(np.float32), valid


@pytest.mark.parametrize("thickness", [0.0, 0.01, 0.1, 0.4])
def test_planes_are_the_principal_components(thickness):
    """Oracle: np.linalg.eigh in float64 on np.cov of the valid neighbours; 3e-6 m of rounding in the input."""
    neighbors, valid = patches(0, thickness)
    fit = plane_fit(neighbors, valid)
    assert [field.dtype for field in fit] == [np.float32] * 3
    for i, (points, keep) in enumerate(zip(neighbors.astype(np.float64), valid, strict=True)):
        eigenvalues, vectors = np.linalg.eigh(np.cov(points[keep].T, bias=True))
        np.testing.assert_allclose(fit.centroid[i], points[keep].mean(axis=0), atol=1e-5)
        np.testing.assert_allclose(fit.eigenvalues[i], eigenvalues, rtol=1e-4, atol=1e-6)
        # A direction is known up to noise over gap.
        slack = 1e-4 + 2e-6 / (eigenvalues[1] - eigenvalues[0])
        assert 1 - abs(fit.normal[i] @ vectors[:, 0]) < slack


def test_rows_that_are_not_valid_do_not_count():
    """Oracle: symmetry; other numbers in rows that are not valid change nothing."""
    neighbors, valid = patches(1, 0.02)
    disturbed = np.where(valid[:, :, None], neighbors, np.float32(1e6))
    for a, b in zip(plane_fit(neighbors, valid), plane_fit(disturbed, valid), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("points", "normal"),
    [
        (np.zeros((4, 3)), [0, 0, 1]),
        (np.outer([0, 1, 2, 4], [0, 0, 1]), None),
        (np.outer([0, 1, 2, 4], [1, 2, 3]), None),
        (np.vstack([np.eye(3), -np.eye(3)]), None),
        (np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), [0, 0, 1]),
        (np.array([[0, 0, 0], [0, 1, 0], [0, 0, 1]]) * 1e-3, [1, 0, 0]),
    ],
    ids=["one place", "line along z", "oblique line", "octahedron", "triangle", "small triangle"],
)
def test_degenerate_neighbours(points, normal):
    """Oracle: the geometry of each set; a unit normal always, and normal to the line where there is one."""
    fit = plane_fit(points.astype(np.float32)[None], np.ones((1, len(points)), bool))
    assert np.linalg.norm(fit.normal[0]) == pytest.approx(1, abs=1e-6)
    assert np.all(fit.eigenvalues >= 0)
    if normal is not None:
        np.testing.assert_allclose(np.abs(fit.normal[0]), normal, atol=1e-6)
    elif np.linalg.matrix_rank(points) == 1:
        assert fit.normal[0] @ points[-1] == pytest.approx(0, abs=1e-6)


def test_no_neighbours():
    """Oracle: the documented answer."""
    fit = plane_fit(np.ones((2, 3, 3), np.float32), np.zeros((2, 3), bool))
    np.testing.assert_array_equal(fit.normal, [[0, 0, 1]] * 2)
    np.testing.assert_array_equal(fit.centroid, np.zeros((2, 3)))
    np.testing.assert_array_equal(fit.eigenvalues, np.zeros((2, 3)))
    assert plane_fit(np.ones((0, 3, 3), np.float32), np.zeros((0, 3), bool)).normal.shape == (0, 3)
