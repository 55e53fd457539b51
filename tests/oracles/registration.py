"""Registration in float64 NumPy and SciPy, written as the formulas stand."""

import numpy as np
from scipy.linalg import expm
from scipy.optimize import least_squares


def hat(twist):
    """4x4 matrix of a twist [omega, v]."""
    (a, b, c), v = twist[:3], twist[3:]
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = [[0, -c, b], [c, 0, -a], [-b, a, 0]]
    matrix[:3, 3] = v
    return matrix


def point_to_plane_residuals(twist, points, targets, normals, weights, tangential):
    """Weighted residuals (4n,) after moving the points by expm(twist^) from the left."""
    T = expm(hat(twist))
    errors = points @ T[:3, :3].T + T[:3, 3] - targets
    return np.r_[np.sqrt(weights) * np.sum(normals * errors, axis=1), (np.sqrt(tangential)[:, None] * errors).ravel()]


def numeric_jacobian(function, x, step=1e-6):
    """Central differences, one column per entry of x."""
    return np.stack([(function(x + step * e) - function(x - step * e)) / (2 * step) for e in np.eye(len(x))], axis=1)


def point_to_plane_minimum(*problem):
    """The minimising 4x4 pose, by a trust-region solver with its own derivatives."""
    solution = least_squares(point_to_plane_residuals, np.zeros(6), args=problem, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return expm(hat(solution.x))
