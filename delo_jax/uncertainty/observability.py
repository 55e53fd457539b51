"""Which directions the surfaces of a scan do not hold: corridors, open fields, tunnels."""

from typing import NamedTuple

import numpy as np

from delo_jax.config import LEVER_M

AXES = ("roll", "pitch", "yaw", "forward", "lateral", "vertical")


class Observability(NamedTuple):
    """Principal directions of a pose, worst first."""

    shares: np.ndarray  # (6,) ascending: mean squared plane distance per squared metre of motion along the direction
    directions: np.ndarray  # (6, 6) rows: twists [omega, v] that move the scene by about a metre

    def unheld(self, minimum: float) -> np.ndarray:
        """(k, 6) directions whose share is below the minimum."""
        return self.directions[self.shares < minimum]

    def unheld_axes(self, minimum: float) -> list[str]:
        """Names of the axes, in the source frame, that these directions are mostly about."""
        parts = np.sum((self.unheld(minimum) * np.repeat([LEVER_M, 1.0], 3)) ** 2, axis=0)  # whatever basis the eigenvectors are
        return [name for name, part in zip(AXES, parts, strict=True) if part > 0.5 * parts.max()]


def observability(information: np.ndarray) -> Observability:
    """Eigenvectors of the information matrix, with rotations measured in metres at an arm of 15 m.

    Args:
        information: (6, 6) of the planes, for a right perturbation [omega, v], per unit of weight.
    """
    scale = np.repeat([1.0 / LEVER_M, 1.0], 3)
    information = np.asarray(information, np.float64)
    values, vectors = np.linalg.eigh(scale[:, None] * (0.5 * (information + information.T)) * scale[None, :])
    return Observability(values, vectors.T * scale)
