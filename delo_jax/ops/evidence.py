"""Evidential regression: the Normal-Inverse-Gamma distribution of six pose errors (Amini et al. 2020)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln
from jaxtyping import Array, Float

_FLOOR = 1e-3  # keeps nu and alpha - 1, which are divisors, away from zero
_LOG_BETA_RANGE = (-25.0, 10.0)
_BETA_FLOOR = 1e-6  # keeps softplus, which underflows to 0, and with it log(beta) and the variances


class NIG(NamedTuple):
    """Normal-Inverse-Gamma parameters, one set per component."""

    gamma: Float[Array, "*b 6"]
    """Mean of the observation."""
    nu: Float[Array, "*b 6"]
    """Virtual observations of the mean, > 0."""
    alpha: Float[Array, "*b 6"]
    """Shape of the variance, > 1."""
    beta: Float[Array, "*b 6"]
    """Scale of the variance, > 0, in the squared unit of the observation (rad^2 or m^2)."""


class Moments(NamedTuple):
    """Predicted variances, in the squared unit of the observation."""

    aleatoric: Float[Array, "*b 6"]
    """E[sigma^2]: noise that more training would not remove."""
    epistemic: Float[Array, "*b 6"]
    """Var[mu]: doubt about the mean; relative, not absolute (Bengs et al. 2023)."""


def constrain(raw: Float[Array, "*b 24"], *, log_beta: bool = True) -> NIG:
    """Valid parameters from 24 unconstrained numbers: four groups of six, gamma, nu, alpha, beta.

    nu and alpha go through softplus, as in the paper. beta goes through exp: pose errors span five decades (1e-5 rad
    to metres), so their squares ten, and softplus, linear for large and flat for small inputs, would need raw values
    and gradients over the same ten decades. The clip is where exp would leave float32's comfort; it stops the gradient.

    Args:
        raw: the network's last layer.
        log_beta: static; False gives the paper's beta, softplus, with a floor of 1e-6 that the paper and its code lack.
    """
    gamma, nu, alpha, beta = jnp.split(raw, 4, axis=-1)
    return NIG(
        gamma=gamma,
        nu=_FLOOR + jax.nn.softplus(nu),
        alpha=1.0 + _FLOOR + jax.nn.softplus(alpha),
        beta=jnp.exp(jnp.clip(beta, *_LOG_BETA_RANGE)) if log_beta else _BETA_FLOOR + jax.nn.softplus(beta),
    )


def moments(nig: NIG) -> Moments:
    """Aleatoric variance beta / (alpha - 1), epistemic variance beta / (nu (alpha - 1))."""
    aleatoric = nig.beta / (nig.alpha - 1.0)
    return Moments(aleatoric, aleatoric / nig.nu)


def negative_log_likelihood(nig: NIG, observation: Float[Array, "*b 6"]) -> Float[Array, "*b 6"]:
    """Minus the log evidence of each component of the observation.

    Minus the log density of a Student-t with 2 alpha degrees of freedom, location gamma and squared scale
    beta (1 + nu) / (nu alpha) (Amini et al., Eq. 8), with the two large logarithms joined in one log1p.
    """
    omega = 2.0 * nig.beta * (1.0 + nig.nu)
    squared = nig.nu * (observation - nig.gamma) ** 2
    return (
        0.5 * jnp.log(jnp.pi * omega / nig.nu)
        + (nig.alpha + 0.5) * jnp.log1p(squared / omega)
        + gammaln(nig.alpha)
        - gammaln(nig.alpha + 0.5)
    )


def regulariser(nig: NIG, observation: Float[Array, "*b 6"]) -> Float[Array, "*b 6"]:
    """Evidence where the mean is wrong: |observation - gamma| (2 nu + alpha).

    Amini et al.; the paper prints 2 alpha + nu.
    """
    return jnp.abs(observation - nig.gamma) * (2.0 * nig.nu + nig.alpha)
