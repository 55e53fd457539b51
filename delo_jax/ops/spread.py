"""A full covariance of a pose error from what a solver says of its own answer: a small network on numbers, as pure functions.

The covariance is predicted in the frame of the motion, x along it and z up, as a Cholesky factor (Williams 1996): whichever way the
sensor is turned, the answer turns with it. Beside it stands how unlike the pairs of the fit a pair is (Mahalanobis distance, as Lee et al.
2018 have it for features): the farther away, the more of the covariance is doubt of the model.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Float, Key

from delo_jax.geometry.se3 import full_float32
from delo_jax.ops.evidence import NIG, moments

NUM_OWN_INPUTS, NUM_OUTPUTS = 7, 21  # beside the statistics: six standard deviations and the odds; a triangle
LARGEST_INPUT = 4.0  # standard deviations; beyond lies what the fit has not seen
_ROWS, _COLUMNS = np.tril_indices(6)
DIAGONAL = np.flatnonzero(_ROWS == _COLUMNS)  # outputs that are logarithms of the factor's diagonal
_LARGEST_LOGIT = 8.0

Weights = dict[str, jax.Array]


def init(num_inputs: int, width: int, key: Key[Array, ""]) -> Weights:
    """Weights that predict one unit on every axis, whatever goes in; mean, deviation and whitener of the inputs are to be filled in."""
    return {
        "mean": jnp.zeros(num_inputs),
        "deviation": jnp.ones(num_inputs),
        "whitener": jnp.eye(num_inputs),
        "hidden": jax.random.normal(key, (num_inputs, width)) / num_inputs**0.5,
        "hidden_bias": jnp.zeros(width),
        "out": jnp.zeros((width, NUM_OUTPUTS)),
        "direct": jnp.zeros((num_inputs, NUM_OUTPUTS)),
        "out_bias": jnp.zeros(NUM_OUTPUTS),
    }


def inputs(statistics: Float[Array, " s"], nig: NIG, confidence: Float[Array, ""], units: Float[Array, "6"]) -> Float[Array, " i"]:
    """What the covariance is predicted from: the solver's statistics, the evidence's standard deviations and its odds of success."""
    variances = sum(moments(nig)) / units**2
    odds = jnp.log(confidence) - jnp.log1p(-confidence)
    return jnp.concatenate([statistics, 0.5 * jnp.log(variances), jnp.clip(odds, -_LARGEST_LOGIT, _LARGEST_LOGIT)[None]])


def factor(weights: Weights, said: Float[Array, " i"]) -> Float[Array, "6 6"]:
    """Lower Cholesky factor of the covariance, in units and in the frame of the motion."""
    x = jnp.clip((said - weights["mean"]) / weights["deviation"], -LARGEST_INPUT, LARGEST_INPUT)
    hidden = jnp.tanh(x @ weights["hidden"] + weights["hidden_bias"])
    raw = hidden @ weights["out"] + x @ weights["direct"] + weights["out_bias"]
    lower = jnp.zeros((6, 6), raw.dtype).at[_ROWS, _COLUMNS].set(raw)
    diagonal = jnp.exp(jnp.diagonal(lower))[:, None]
    return diagonal * jnp.where(jnp.eye(6, dtype=bool), 1.0, lower)


def whitener(said: Float[Array, "n i"]) -> Float[Array, "i i"]:
    """W that makes inputs uncorrelated and of variance one, but for directions in which they hardly vary."""
    variances = jnp.var(said, axis=0) + 1e-6
    covariance = jnp.cov(said, rowvar=False) + 1e-3 * jnp.diag(variances)
    return jnp.linalg.inv(jnp.linalg.cholesky(covariance))


@full_float32
def doubt(weights: Weights, said: Float[Array, " i"]) -> Float[Array, ""]:
    """Share of the covariance that is doubt of the model, in [0, 1): s / (1 + s), with s the mean squared whitened input, 1 in the fit."""
    squared = jnp.mean((weights["whitener"] @ (said - weights["mean"])) ** 2)
    return squared / (1.0 + squared)


def motion_frame(T_target_source: Float[Array, "4 4"]) -> Float[Array, "6 6"]:
    """Turns twists of the frame of the motion, x along its horizontal part, into the source frame; where nothing moves they are one."""
    R, t = T_target_source[:3, :3], T_target_source[:3, 3]
    x, y, _ = R.T @ t
    length = jnp.sqrt(x * x + y * y)
    moves = length > 1e-3
    c, s = jnp.where(moves, x / jnp.where(moves, length, 1.0), 1.0), jnp.where(moves, y / jnp.where(moves, length, 1.0), 0.0)
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    Rz = jnp.stack([jnp.stack([c, -s, zero]), jnp.stack([s, c, zero]), jnp.stack([zero, zero, one])])
    return jnp.block([[Rz, jnp.zeros_like(Rz)], [jnp.zeros_like(Rz), Rz]])


@full_float32
def half(weights: Weights, said: Float[Array, " i"], T_target_source: Float[Array, "4 4"], units: Float[Array, "6"]) -> Float[Array, "6 6"]:
    """H with H H^T the covariance of a right perturbation of T_target_source, order [omega, v], rad and m.

    Args:
        weights: fitted.
        said: from `inputs`.
        T_target_source: the pose.
        units: of the factor, (6,) [rad, m].
    """
    return motion_frame(T_target_source) @ (units[:, None] * factor(weights, said))


@full_float32
def negative_log_likelihood(
    weights: Weights,
    said: Float[Array, " i"],
    T_target_source: Float[Array, "4 4"],
    error: Float[Array, "6"],
    units: Float[Array, "6"],
) -> Float[Array, ""]:
    """Minus the log density of an error of the pose [nats, up to a constant that the units set]."""
    squared, log_det = _measured(weights, said, T_target_source, error, units)
    return 0.5 * squared + log_det


@full_float32
def student_negative_log_likelihood(
    weights: Weights,
    said: Float[Array, " i"],
    T_target_source: Float[Array, "4 4"],
    error: Float[Array, "6"],
    units: Float[Array, "6"],
) -> Float[Array, ""]:
    """The same under a multivariate Student-t distribution with scale H H^T and the `freedom` of the weights."""
    squared, log_det = _measured(weights, said, T_target_source, error, units)
    nu = freedom(weights)
    constant = gammaln(0.5 * nu) - gammaln(0.5 * (nu + 6.0)) + 3.0 * jnp.log(0.5 * nu)
    return 0.5 * (nu + 6.0) * jnp.log1p(squared / nu) + log_det + constant


def freedom(weights: Weights) -> Float[Array, ""]:
    """Degrees of freedom, above 2, so that there is a covariance; from the number "freedom" that a Student-t fit has beside the others."""
    return 2.0 + jnp.exp(weights["freedom"])


def _measured(weights, said, T_target_source, error, units):
    """Squared length of the whitened error and half the log determinant; substitution by hand, since batches of small solves are slow."""
    L = factor(weights, said)
    turned = (motion_frame(T_target_source).T @ error) / units
    white: list = []
    for row in range(6):
        white.append((turned[row] - sum((L[row, column] * value for column, value in enumerate(white)), start=0.0)) / L[row, row])
    return sum(value**2 for value in white), jnp.sum(jnp.log(jnp.diagonal(L)))
