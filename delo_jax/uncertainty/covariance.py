"""Covariance of a pose from its evidence."""

from typing import NamedTuple

import numpy as np

from delo_jax.config import StatusConfig


class Uncertainty(NamedTuple):
    """Variances per degree of freedom and their covariance, order [omega, v], rad^2 and m^2, right perturbation."""

    aleatoric: np.ndarray  # (6,) noise of the data
    epistemic: np.ndarray  # (6,) doubt of the model
    covariance: np.ndarray  # (6, 6)


def from_evidence(nu: np.ndarray, alpha: np.ndarray, beta: np.ndarray) -> Uncertainty:
    """Moments of the normal-inverse-gamma prediction; the covariance is the diagonal of their sum, not calibrated.

    Args:
        nu: (6,) virtual observations of the mean.
        alpha: (6,) shape of the variance, above 1.
        beta: (6,) scale of the variance [rad^2, m^2].
    """
    aleatoric = beta / (alpha - 1.0)
    epistemic = aleatoric / nu
    return Uncertainty(aleatoric, epistemic, np.diag(aleatoric + epistemic))


def unknown(cfg: StatusConfig) -> Uncertainty:
    """What is known of a pose that nobody measured: the configured standard deviations, all of them epistemic."""
    sigma = np.repeat([np.radians(cfg.unknown_rotation_deg), cfg.unknown_translation_m], 3)
    return Uncertainty(np.zeros(6), sigma**2, np.diag(sigma**2))


def widen_along(known: Uncertainty, direction: np.ndarray, cfg: StatusConfig) -> Uncertainty:
    """The same uncertainty plus that of an unmeasured translation along one direction.

    Args:
        known: uncertainty of a pose.
        direction: (3,) unit vector in the frame of the perturbation, the source frame for T_target_source.
        cfg: standard deviation of a translation that nobody measured.
    """
    extra = np.zeros((6, 6))
    extra[3:, 3:] = cfg.unknown_translation_m**2 * np.outer(direction, direction)
    return Uncertainty(known.aleatoric, known.epistemic + np.diag(extra), known.covariance + extra)
