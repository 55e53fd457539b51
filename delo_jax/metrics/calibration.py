"""Whether predicted uncertainty fits the errors that were made: likelihood, coverage, consistency, sparsification, detection, intervals."""

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.stats import norm, rankdata

from delo_jax.errors import DeloError


def nees(errors: Float[np.ndarray, "n k"], covariances: Float[np.ndarray, "m j l"]) -> Float64[np.ndarray, " n"]:
    """Normalised estimation error squared, e^T C^-1 e: k in the mean when the covariances are right (Bar-Shalom et al. 2001).

    Args:
        errors: errors, or twists of pose errors [rad, m].
        covariances: predicted, positive definite, in the same units.

    Raises:
        DeloError: unequal lengths, NaN or infinity, a covariance that is not positive definite.
    """
    return _squares(*_factored(errors, covariances))


def negative_log_likelihood(errors: Float[np.ndarray, "n k"], covariances: Float[np.ndarray, "m j l"]) -> Float64[np.ndarray, " n"]:
    """Minus the log density of each error under a Gaussian of that covariance [nats].

    Args:
        errors: as in `nees`.
        covariances: as in `nees`.

    Raises:
        DeloError: as `nees`.
    """
    errors, factors = _factored(errors, covariances)
    log_det = 2.0 * np.sum(np.log(np.diagonal(factors, axis1=1, axis2=2)), axis=1)
    return 0.5 * (_squares(errors, factors) + log_det + errors.shape[1] * np.log(2.0 * np.pi))


def coverage(errors: Float[np.ndarray, "n k"], sigmas: Float[np.ndarray, "m j"], level: float) -> Float64[np.ndarray, " k"]:
    """Share of the errors, component by component, within the central interval that a Gaussian fills at that level.

    Args:
        errors: errors, of any sign.
        sigmas: predicted standard deviations, > 0.
        level: in (0, 1): 0.68 asks for the share within about one sigma.

    Raises:
        DeloError: unequal shapes, NaN or infinity, a standard deviation that is not above zero.
    """
    errors, sigmas = _checked(errors, "errors"), _checked(sigmas, "sigmas")
    if errors.shape != sigmas.shape:
        raise DeloError(f"sigmas: expected the shape of errors, {errors.shape}, got {sigmas.shape}")
    if not (sigmas > 0).all():
        raise DeloError(f"sigmas: expected values above 0, got {sigmas.min():g}")
    return np.mean(np.abs(errors) <= norm.ppf(0.5 + 0.5 * level) * sigmas, axis=0)


def sparsification_error(errors: Float[np.ndarray, " n"], sigmas: Float[np.ndarray, " m"]) -> float:
    """Area between two curves, as a share of the root mean square of all errors: 0 for an oracle (Ilg et al. 2018, AUSE).

    Both curves are the root mean square of what is left when a growing share is taken away, of the largest predicted sigmas in
    the one, of the largest errors in the other. A constant sigma takes away at random: in the mean its first curve is level.

    Args:
        errors: lengths of errors, or errors of one component.
        sigmas: what they are ordered by; equal ones share their places.

    Raises:
        DeloError: unequal lengths, none at all, NaN or infinity.
    """
    squared, sigmas = _checked(errors, "errors") ** 2, _checked(sigmas, "sigmas")
    if squared.shape != sigmas.shape or len(squared) == 0:
        raise DeloError(f"sigmas: expected as many as errors ({len(squared)}), at least one, got {len(sigmas)}")
    _, place = np.unique(sigmas, return_inverse=True)
    shared = (np.bincount(place, squared) / np.bincount(place))[place]  # equal ones count as their mean, in whatever order
    kept = np.arange(1, len(squared) + 1)
    left, best = (np.sqrt(np.cumsum(values) / kept) for values in (shared[np.argsort(sigmas)], np.sort(squared)))
    return float(np.mean(left - best) / max(best[-1], np.finfo(float).tiny))


def auroc(scores: Float[np.ndarray, " n"], positive: Bool[np.ndarray, " n"]) -> float:
    """Probability that a positive has a higher score than a negative, ties counting half (Fawcett 2006); NaN without both kinds."""
    ranks, num = rankdata(_checked(scores, "scores")), int(positive.sum())
    if num in (0, len(ranks)):
        return float("nan")
    return float((ranks[positive].sum() - num * (num + 1) / 2) / (num * (len(ranks) - num)))


def block_interval(
    values: Float[np.ndarray, "n k"], blocks: Int[np.ndarray, " m"], *, level: float = 0.95, num_draws: int = 2000, seed: int = 0
) -> tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:
    """Ends of the interval that the mean of each column lies in, by a bootstrap over whole blocks of rows (Kuensch 1989).

    Rows that follow each other in time are not independent; blocks that are longer than what ties them together nearly are.

    Args:
        values: what is averaged, row by row.
        blocks: number of the block of each row.
        level: of the interval, in (0, 1).
        num_draws: resamples.
        seed: of the resamples.

    Raises:
        DeloError: unequal lengths, no row, NaN or infinity.
    """
    values = _checked(values, "values")
    if len(values) != len(blocks) or len(values) == 0:
        raise DeloError(f"blocks: expected a number for each of the {len(values)} rows, at least one, got {len(blocks)}")
    names, place = np.unique(blocks, return_inverse=True)
    sums, counts = np.zeros((len(names), values.shape[1])), np.bincount(place)
    np.add.at(sums, place, values)
    drawn = np.random.default_rng(seed).multinomial(len(names), np.full(len(names), 1.0 / len(names)), size=num_draws)
    means = (drawn @ sums) / (drawn @ counts)[:, None]
    low, high = np.quantile(means, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0)
    return low, high


def _squares(errors: np.ndarray, factors: np.ndarray) -> np.ndarray:
    white = np.linalg.solve(factors, errors[:, :, None])[:, :, 0]
    return np.sum(white**2, axis=1)


def _factored(errors: np.ndarray, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both checked, the covariances as lower Cholesky factors."""
    errors, covariances = _checked(errors, "errors"), _checked(covariances, "covariances")
    expected = (*errors.shape, errors.shape[-1])
    if covariances.shape != expected:
        raise DeloError(f"covariances: expected shape {expected}, got {covariances.shape}")
    try:
        return errors, np.linalg.cholesky(covariances)
    except np.linalg.LinAlgError:
        least = np.linalg.eigvalsh(covariances)[:, 0]
        raise DeloError(
            f"covariances: expected positive definite matrices, got one with eigenvalue {least.min():g} at {least.argmin()}"
        ) from None


def _checked(array: np.ndarray, name: str) -> np.ndarray:
    array = np.asarray(array, np.float64)
    if not np.isfinite(array).all():
        raise DeloError(f"{name}: expected finite numbers, got NaN or infinity in {np.sum(~np.isfinite(array))} of {array.size}")
    return array
