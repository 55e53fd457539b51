"""Covariance of a pose from its evidence."""

from typing import NamedTuple

import numpy as np

from delo_jax.config import LEVER_M, StatusConfig
from delo_jax.geometry import se3
from delo_jax.uncertainty.observability import Observability


class Uncertainty(NamedTuple):
    """Variances per degree of freedom and their covariance, order [omega, v], rad^2 and m^2, right perturbation."""

    aleatoric: np.ndarray  # (6,) noise of the data
    epistemic: np.ndarray  # (6,) doubt of the model
    covariance: np.ndarray  # (6, 6)


def from_evidence(gamma: np.ndarray, nu: np.ndarray, alpha: np.ndarray, beta: np.ndarray) -> Uncertainty:
    """Moments of the normal-inverse-gamma prediction, not calibrated.

    The pose is not moved by the expected error gamma, so the covariance is the second moment about the pose: the diagonal of
    both variances plus gamma gamma^T.

    Args:
        gamma: (6,) expected error [rad, m].
        nu: (6,) virtual observations of the mean.
        alpha: (6,) shape of the variance, above 1.
        beta: (6,) scale of the variance [rad^2, m^2].
    """
    aleatoric = beta / (alpha - 1.0)
    epistemic = aleatoric / nu
    return Uncertainty(aleatoric, epistemic, np.diag(aleatoric + epistemic) + np.outer(gamma, gamma))


def from_half(half: np.ndarray, doubt: float) -> Uncertainty:
    """A calibrated covariance.

    Args:
        half: (6, 6) H with H H^T the covariance [rad, m].
        doubt: share of it that is doubt of the model.
    """
    covariance = half @ half.T
    total = np.diag(covariance)
    return Uncertainty((1.0 - doubt) * total, doubt * total, covariance)


def from_pose6_evidence(T: np.ndarray, gamma: np.ndarray, nu: np.ndarray, alpha: np.ndarray, beta: np.ndarray) -> Uncertainty:
    """Moments of a normal-inverse-gamma prediction of the true pose's `pose6`, not calibrated, as those of a right perturbation of T.

    To first order, by the Jacobian J of `pose6` at T. As in `from_evidence` the pose is not moved: the covariance is the second moment
    about T, so what the prediction disagrees with T by, e = gamma - pose6(T), adds J e e^T J^T.

    Args:
        T: (4, 4) the pose.
        gamma: (6,) expected [roll, pitch, yaw, x, y, z] of the truth [rad, m]; angles of any turn.
        nu: (6,) virtual observations of the mean.
        alpha: (6,) shape of the variance, above 1.
        beta: (6,) scale of the variance [rad^2, m^2].
    """
    pose = se3.pose6(np.asarray(T, np.float64))
    J = se3.pose6_jacobian(pose)
    aleatoric = beta / (alpha - 1.0)
    epistemic = aleatoric / nu
    error = np.asarray(gamma, np.float64) - pose
    error[:3] = np.pi - (np.pi - error[:3]) % (2 * np.pi)  # the short way round
    moved = J @ error
    half = J * np.sqrt(aleatoric + epistemic)
    covariance = half @ half.T + np.outer(moved, moved)  # symmetric to the last bit
    return Uncertainty(J**2 @ aleatoric, J**2 @ epistemic, covariance)


def from_information(information: np.ndarray, *, sigma_m: float, num_planes: float) -> Uncertainty:
    """Inverse of a registration's Gauss-Newton matrix, not calibrated; all of it counts as noise of the data.

    Args:
        information: (6, 6) of the planes, for a right perturbation of the pose, per unit of weight.
        sigma_m: standard deviation of a plane distance.
        num_planes: how many independent planes the weights amount to.
    """
    precision = num_planes / sigma_m**2 * 0.5 * (information + information.T)
    scale = np.repeat([1.0 / LEVER_M, 1.0], 3)
    values, vectors = np.linalg.eigh(scale[:, None] * precision * scale[None, :])
    half = scale[:, None] * vectors / np.sqrt(np.maximum(values, 1e-2))  # at least 10 m where nothing holds
    covariance = half @ half.T
    return Uncertainty(np.diag(covariance).copy(), np.zeros(6), covariance)


def unknown(cfg: StatusConfig) -> Uncertainty:
    """What is known of a pose that nobody measured: the configured standard deviations, all of them epistemic."""
    sigma = np.repeat([np.radians(cfg.unknown_rotation_deg), cfg.unknown_translation_m], 3)
    return Uncertainty(np.zeros(6), sigma**2, np.diag(sigma**2))


def widen(known: Uncertainty, seen: Observability, cfg: StatusConfig) -> Uncertainty:
    """The same uncertainty plus that of an unmeasured motion along every direction that the surfaces do not hold.

    Args:
        known: uncertainty of a pose.
        seen: its principal directions, of the same perturbation.
        cfg: what counts as unheld, and the standard deviation of a translation that nobody measured.
    """
    unheld = seen.unheld(cfg.min_observability)
    extra = cfg.unknown_translation_m**2 * (unheld.T @ unheld)
    return Uncertainty(known.aleatoric, known.epistemic + np.diag(extra), known.covariance + extra)
