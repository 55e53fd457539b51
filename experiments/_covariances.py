"""Covariances of pairs by method: what has to be fitted is fitted on some pairs, what is said is said of others."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from _members import Solved
from _uncertainty import LIMITS
from scipy.stats import multivariate_t, norm
from scipy.stats import t as student_t

from delo_jax.geometry import se3
from delo_jax.metrics.calibration import negative_log_likelihood, sparsification_error
from delo_jax.model.delo import Model
from delo_jax.ops import spread
from delo_jax.train.calibrate import Pairs, fit, halves
from delo_jax.uncertainty import covariance

NUM_HEADS = 5
UNITS = np.repeat([1e-3, 1e-2], 3)  # rad, m
FULL = "full"


class Said(NamedTuple):
    """What a method says of n pairs."""

    covariances: np.ndarray  # (n, 6, 6)
    freedom: float = np.inf  # of the Student-t distribution whose covariances they are; infinite: a Gaussian

    def rows(self, which: np.ndarray) -> "Said":
        """Some of them."""
        return self._replace(covariances=self.covariances[which])

    def plus(self, sigma: np.ndarray) -> "Said":
        """With the noise of the truth (n, 6) in quadrature."""
        return self._replace(covariances=self.covariances + sigma[:, :, None] ** 2 * np.eye(6)[None])

    def stretched(self, level: float) -> np.ndarray:
        """(n, 6) standard deviations, times what makes a Gaussian interval of that level one of this distribution."""
        upper, nu = 0.5 + 0.5 * level, self.freedom
        factor = 1.0 if np.isinf(nu) else student_t.ppf(upper, nu) / norm.ppf(upper) * np.sqrt((nu - 2.0) / nu)
        return factor * np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2))

    def nats(self, errors: np.ndarray) -> np.ndarray:
        """(n,) minus log densities."""
        if np.isinf(self.freedom):
            return negative_log_likelihood(errors, self.covariances)
        shapes = (self.freedom - 2.0) / self.freedom * self.covariances
        return -np.array([multivariate_t.logpdf(e, shape=shape, df=self.freedom) for e, shape in zip(errors, shapes, strict=True)])

    def sizes(self) -> np.ndarray:
        """(n,) root mean square over the axes of the standard deviations in units of what counts as off."""
        return np.sqrt(np.mean(np.diagonal(self.covariances, axis1=1, axis2=2) / LIMITS**2, axis=1))


Method = Callable[[Solved], Said]


def methods(model: Model, seen: Pairs, members: list[Model], by_members: Solved) -> dict[str, Method]:
    """All of them, fitted on these pairs, lost ones apart; the default comes as the weights have it.

    Args:
        model: weights that are asked about.
        seen: pairs to fit on.
        members: networks of an ensemble; none: it is left out.
        by_members: pairs to fit those on.
    """
    seen = seen.rows(np.flatnonzero(~seen.lost(model)))
    by_members = by_members.rows(np.flatnonzero(~by_members.pairs.lost(model)))
    found: dict[str, Method] = {"evidence": lambda solved: Said(raw(solved.pairs))}
    for name, formula, start in (("evidence, rescaled", rescaled, np.repeat([0.0, 1.0], 6)), ("information", of_information, np.zeros(8))):
        found[name] = _with_numbers(formula, fitted(formula, start, seen, raw(seen)))
    weights = fit(model, seen, likelihood=spread.student_negative_log_likelihood, more={"freedom": jnp.array(1.0)})
    nu = float(spread.freedom(weights))
    print(f"Student: {nu:.2f} degrees of freedom")
    found["Student"] = lambda solved: Said(nu / (nu - 2.0) * squares(halves(model, weights, solved.pairs)), nu)
    heads = ensemble(model, seen)
    found[f"ensemble of {NUM_HEADS} heads"] = lambda solved: Said(
        np.mean([squares(halves(model, head, solved.pairs)) for head in heads], axis=0)
    )
    if members:
        found[f"ensemble of {len(members)} networks"] = of_networks(members, by_members)
    return found | {FULL: lambda solved: Said(squares(halves(model, model.variables["covariance"], solved.pairs)))}


def of_networks(members: list[Model], seen: Solved) -> Method:
    """A mixture of the members' Gaussians (Lakshminarayanan et al., NeurIPS 2017), its second moment about the pose that is asked about.

    Each member's covariance is of a head fitted on its own pairs; six factors on the mixture's axes make the errors most likely.
    """
    heads = [fit(member, pairs) for member, pairs in zip(members, seen.members, strict=True)]

    def mixture(solved: Solved) -> np.ndarray:
        moments = []
        for member, head, pairs in zip(members, heads, solved.members, strict=True):
            away = se3.log(se3.inverse(solved.pairs.Ts_target_source) @ pairs.Ts_target_source)
            moments.append(squares(halves(member, head, pairs)) + away[:, :, None] * away[:, None, :])
        return np.mean(moments, axis=0)

    factors = np.exp(fitted(stretched, np.zeros(6), seen.pairs, mixture(seen)))
    return lambda solved: Said(factors[:, None] * mixture(solved) * factors[None, :])


def ensemble(model: Model, seen: Pairs) -> list[spread.Weights]:
    """Heads that are fitted on as many worlds, drawn with repetition."""
    _, number_of = np.unique(seen.worlds, return_inverse=True)
    num, heads = number_of.max() + 1, []
    for number in range(NUM_HEADS):
        drawn = np.bincount(np.random.default_rng(number).integers(num, size=num), minlength=num)
        heads.append(fit(model, seen, drawn[number_of], seed=number))
    return heads


def squares(H: np.ndarray) -> np.ndarray:
    """H H^T."""
    return H @ H.transpose(0, 2, 1)


def raw(pairs: Pairs) -> np.ndarray:
    """Covariances (n, 6, 6) of the evidence as it is."""
    numbers = zip(*(np.asarray(array, np.float64) for array in pairs.nig), strict=True)
    return np.stack([covariance.from_evidence(*nig).covariance for nig in numbers])


def rescaled(free, pairs: Pairs, C) -> jax.Array:
    """Of the evidence, each sigma to a power and times a factor."""
    sigmas = jnp.sqrt(jnp.diagonal(C, axis1=1, axis2=2)) / UNITS[None]
    return jax.vmap(jnp.diag)((jnp.exp(free[None, :6]) * UNITS[None] * sigmas ** free[None, 6:]) ** 2)


def stretched(free, pairs: Pairs, C) -> jax.Array:
    """A factor on each axis."""
    return jnp.exp(free)[None, :, None] * C * jnp.exp(free)[None, None, :]


def of_information(free, pairs: Pairs, C) -> jax.Array:
    """Inverse of the information, scaled, plus a variance per axis."""
    lever = jnp.asarray(np.repeat([1.0 / 15.0, 1.0], 3), jnp.float32)
    scaled = pairs.information * lever[None, :, None] * lever[None, None, :] + 1e-4 * jnp.eye(6)[None]
    size = lever * jnp.repeat(jnp.exp(free[:2]), 3) * 1e-2
    floors = jnp.diag((jnp.exp(free[2:]) * UNITS) ** 2)
    return jnp.linalg.inv(scaled) * size[None, :, None] * size[None, None, :] + floors[None]


def fitted(formula: Callable, start: np.ndarray, pairs: Pairs, C: np.ndarray) -> np.ndarray:
    """Numbers that make the errors most likely under a formula of pairs and covariances."""
    given, errors, rows = jnp.asarray(C, jnp.float32), jnp.asarray(pairs.errors / UNITS, jnp.float32), _float32(pairs)

    def loss(free, _):
        C = formula(free, rows, given) / (UNITS[:, None] * UNITS[None, :])[None]
        L = jnp.linalg.cholesky(C)
        white = jax.scipy.linalg.solve_triangular(L, errors[:, :, None], lower=True)[..., 0]
        log_det = jnp.sum(jnp.log(jnp.diagonal(L, axis1=1, axis2=2)), axis=1)
        return jnp.mean(0.5 * jnp.sum(white**2, axis=1) + log_det)

    solver: Any = optimistix.BFGS(rtol=1e-5, atol=1e-6)
    return np.asarray(optimistix.minimise(loss, solver, jnp.asarray(start, jnp.float32), max_steps=500, throw=False).value)


def _with_numbers(formula: Callable, free: np.ndarray) -> Method:
    numbers = jnp.asarray(free)
    return lambda solved: Said(
        np.asarray(formula(numbers, _float32(solved.pairs), jnp.asarray(raw(solved.pairs), jnp.float32)), np.float64)
    )


def _float32(pairs: Pairs) -> Pairs:
    return jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), pairs)


def sparsifications(errors: np.ndarray, C: np.ndarray) -> tuple[float, float]:
    """Of the length of the rotation's and of the translation's error, ordered by the trace of its covariance."""
    parts = slice(0, 3), slice(3, 6)
    sizes = (np.sqrt(np.trace(C[:, part, part], axis1=1, axis2=2)) for part in parts)
    values = [sparsification_error(np.linalg.norm(errors[:, part], axis=1), size) for part, size in zip(parts, sizes, strict=True)]
    return values[0], values[1]


def over_frames(pairs: Pairs, C: np.ndarray, num: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors (m, 6) and covariances (m, 6, 6) of `num` motions in a row, taken to be independent, from every frame on.

    Args:
        pairs: consecutive ones, source the later scan, of one drive after the other.
        C: their covariances.
        num: motions.
    """
    errors, covariances = [], []
    for drive in np.unique(pairs.worlds):
        rows = np.flatnonzero(pairs.worlds == drive)
        starts = rows[: max(len(rows) - num + 1, 0)]
        T, T_true = (np.tile(np.eye(4), (len(starts), 1, 1)) for _ in range(2))
        total = np.zeros((len(starts), 6, 6))
        for step in range(num if len(starts) else 0):
            T_step = pairs.Ts_target_source[starts + step]
            Ad = se3.adjoint(se3.inverse(T_step))
            total = Ad @ total @ Ad.transpose(0, 2, 1) + C[starts + step]
            T, T_true = T @ T_step, T_true @ T_step @ np.stack([se3.exp(error) for error in pairs.errors[starts + step]])
        errors += [se3.log(se3.inverse(one) @ true) for one, true in zip(T, T_true, strict=True)]
        covariances.append(total)
    return np.array(errors).reshape(-1, 6), np.concatenate(covariances)
