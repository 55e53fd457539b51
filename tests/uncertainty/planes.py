"""Scenes of a few flat surfaces, and their information matrices in closed form."""

import numpy as np


def wall(normal, centre, first_half, second_half):
    """(normal, points): 3 x 3 points whose second moments are those of a rectangle with these half axes."""
    nodes, weights = [-np.sqrt(0.6), 0.0, np.sqrt(0.6)], [5 / 18, 8 / 18, 5 / 18]  # Gauss-Legendre
    points = [np.add(centre, a * np.array(first_half) + b * np.array(second_half)) for a in nodes for b in nodes]
    return np.array(normal, float), np.array(points), np.outer(weights, weights).ravel()


FLOOR = wall([0, 0, 1], [0, 0, -1.7], [12, 0, 0], [0, 12, 0])
LEFT = wall([0, -1, 0], [0, 5, 1], [20, 0, 0], [0, 0, 3])
RIGHT = wall([0, 1, 0], [0, -5, 1], [20, 0, 0], [0, 0, 3])
FRONT = wall([-1, 0, 0], [20, 0, 1], [0, 5, 0], [0, 0, 3])
BACK = wall([1, 0, 0], [-20, 0, 1], [0, 5, 0], [0, 0, 3])
FIELD, CORRIDOR, ROOM = [FLOOR], [FLOOR, LEFT, RIGHT], [FLOOR, LEFT, RIGHT, FRONT, BACK]


def information(scene, R=None):
    """Mean over the walls of row row^T with row = [p x n, n]: a twist [omega, v] moves p by omega x p + v, along n."""
    R = np.eye(3) if R is None else R
    total = np.zeros((6, 6))
    for normal, points, weights in scene:
        rows = [np.r_[np.cross(R @ point, R @ normal), R @ normal] for point in points]
        total += sum(w * np.outer(row, row) for w, row in zip(weights, rows, strict=True))
    return total / len(scene)
