"""Planes through given neighbours: principal components in closed form, on the host."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32


class PlaneFit(NamedTuple):
    """Local planes, one per point."""

    centroid: Float32[np.ndarray, "n 3"]
    """Mean of the valid neighbours [m]; zero where there are none."""
    normal: Float32[np.ndarray, "n 3"]
    """Unit direction of least spread, of arbitrary sign; (0, 0, 1) where every direction is as good."""
    eigenvalues: Float32[np.ndarray, "n 3"]
    """Variances along the principal axes [m^2], ascending, >= 0."""


def _eigenvalues(xx, xy, xz, yy, yz, zz):
    """Ascending eigenvalues of symmetric 3x3 matrices, by the trigonometric solution (Smith 1961)."""
    mean = (xx + yy + zz) / 3.0
    dx, dy, dz = xx - mean, yy - mean, zz - mean
    spread = np.sqrt((dx * dx + dy * dy + dz * dz + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    half_det = 0.5 * (dx * (dy * dz - yz * yz) - xy * (xy * dz - yz * xz) + xz * (xy * yz - dy * xz))
    cube = spread**3
    ratio = np.divide(half_det, cube, out=np.zeros_like(cube), where=cube > 0)
    angle = np.arccos(np.clip(ratio, -1.0, 1.0)) / 3.0
    high = mean + 2.0 * spread * np.cos(angle)
    low = mean + 2.0 * spread * np.cos(angle + 2.0 * np.pi / 3.0)
    return np.maximum(np.stack([low, 3.0 * mean - high - low, high]), 0.0)


def _cross(a, b):
    """Cross product of planar vectors (3, ...)."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _longest(first, *others):
    """Of several planar vectors (3, n) the longest per column, and its squared length (n,)."""
    longest, longest2 = first.copy(), np.sum(first * first, axis=0)
    for vectors in others:
        length2 = np.sum(vectors * vectors, axis=0)
        longer = length2 > longest2
        np.copyto(longest, vectors, where=longer)
        np.copyto(longest2, length2, where=longer)
    return longest, longest2


def _least_direction(least, xx, xy, xz, yy, yz, zz):
    """Unit eigenvectors (3, n) of eigenvalue `least`: the row space of M - least I is what they are normal to."""
    a, b, c = np.stack([xx - least, xy, xz]), np.stack([xy, yy - least, yz]), np.stack([xz, yz, zz - least])
    row, row2 = _longest(a, b, c)
    normal, normal2 = _longest(_cross(a, b), _cross(b, c), _cross(c, a))
    # Points on a line leave one usable row: any direction normal to it will do.
    line = normal2 <= 1e-20 * row2 * row2
    axis = np.eye(3)[np.argmin(np.abs(row[:, line]), axis=0)].T
    normal[:, line] = _cross(row[:, line], axis)
    length = np.sqrt(np.sum(normal * normal, axis=0))
    undefined = length == 0
    normal[:, undefined], length[undefined] = np.array([[0.0], [0.0], [1.0]]), 1.0
    return normal / length


def plane_fit(neighbors: Float32[np.ndarray, "n k 3"], valid: Bool[np.ndarray, "n k"]) -> PlaneFit:
    """Plane through each set of neighbours, by their covariance.

    Sums run over planar float32 coordinates, relative to the centroid; the 3x3 algebra is float64, where the closed
    form is safe. Several times faster than `np.linalg.eigh` on the stack.

    Args:
        neighbors: neighbours of each point, finite [m]; rows that are not valid may hold anything finite.
        valid: which of them count.

    Returns:
        The planes, defined for every input: fewer than three neighbours leave eigenvalues of zero.
    """
    weight = np.ascontiguousarray(valid.T, dtype=np.float32)
    count = np.maximum(np.sum(weight, axis=0), np.float32(1.0))
    planes = np.ascontiguousarray(neighbors.transpose(2, 1, 0))
    centroid = np.einsum("dkn,kn->dn", planes, weight) / count
    x, y, z = (planes - centroid[:, None, :]) * weight
    moments = [np.einsum("kn,kn->n", a, b).astype(np.float64) / count for a, b in ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))]
    eigenvalues = _eigenvalues(*moments)
    normal = _least_direction(eigenvalues[0], *moments)
    return PlaneFit(*(np.ascontiguousarray(field.T, dtype=np.float32) for field in (centroid, normal, eigenvalues)))
