"""Soft matching of two feature sets: costs, partial optimal transport."""

import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float

_FORBIDDEN = -1e30  # log-weight of a padded pair; finite, so that no difference of two of them is NaN


def _mask_columns(scores, column_mask):
    return scores if column_mask is None else jnp.where(column_mask[None, :], scores, _FORBIDDEN)


def matching_cost(
    features_source: Float[Array, "n d"],
    features_target: Float[Array, "m d"],
    scale: float | Float[Array, ""] | None = None,
    column_mask: Bool[Array, " m"] | None = None,
) -> Float[Array, "n m"]:
    """Cost C_ij = -log softmax_j(scale <source_i, target_j>), the paper's matching cost.

    Asymmetric: exchanging source and target is not a transpose.

    Args:
        features_source: one row per source point.
        features_target: one row per target point.
        scale: inverse temperature > 0; 1 / sqrt(d) when None.
        column_mask: valid target points; all when None.

    Returns:
        Cost >= 0, rows source, columns target; 0 in columns that are not valid.
    """
    if scale is None:
        scale = features_source.shape[1] ** -0.5
    scores = _mask_columns(scale * (features_source @ features_target.T), column_mask)
    cost = logsumexp(scores, axis=1, keepdims=True) - scores
    return cost if column_mask is None else jnp.where(column_mask[None, :], cost, 0.0)


def partial_transport(
    cost: Float[Array, "n m"],
    epsilon: float | Float[Array, ""],
    *,
    mass: float,
    num_iters: int,
    row_mask: Bool[Array, " n"] | None = None,
    column_mask: Bool[Array, " m"] | None = None,
) -> Float[Array, "n m"]:
    """Entropic plan moving `mass` of the total between uniform marginals.

    Approaches min <P, C> - epsilon H(P) with row sums <= 1/n, column sums <= 1/m and total `mass` by Dykstra's
    projections (Benamou et al. 2015; the paper's Algorithm 1, which omits the corrections). The log-domain dual keeps
    vectors only and carries the corrections exactly. A few iterations are not convergence: marginals may be exceeded.

    Args:
        cost: matching cost, rows source, columns target, finite.
        epsilon: entropic weight > 0; learned, so traced.
        mass: transported fraction, in (0, 1].
        num_iters: static; the loop must have a fixed length to be differentiable.
        row_mask: valid source points; all when None. n counts these only.
        column_mask: valid target points; all when None. m counts these only.

    Returns:
        Plan >= 0 with total `mass`, zero in padded rows and columns; all zero when nothing is valid.
    """
    rows = jnp.ones(cost.shape[0], bool) if row_mask is None else row_mask
    columns = jnp.ones(cost.shape[1], bool) if column_mask is None else column_mask
    valid = rows[:, None] & columns[None, :]
    log_a = -jnp.log(jnp.maximum(jnp.sum(rows), 1).astype(cost.dtype))
    log_b = -jnp.log(jnp.maximum(jnp.sum(columns), 1).astype(cost.dtype))
    log_mass = jnp.log(jnp.asarray(mass, cost.dtype))
    scores = jnp.where(valid, -cost / epsilon, _FORBIDDEN)

    def project(_, potentials):
        f, g, h = potentials
        f = jnp.minimum(log_a - h - logsumexp(scores + g, axis=1, keepdims=True), 0.0)  # rows <= 1/n
        g = jnp.minimum(log_b - h - logsumexp(scores + f, axis=0, keepdims=True), 0.0)  # columns <= 1/m
        return f, g, log_mass - logsumexp(scores + f + g)  # total mass

    start = jnp.zeros_like(scores[:, :1]), jnp.zeros_like(scores[:1, :]), log_mass - logsumexp(scores)
    f, g, h = jax.lax.fori_loop(0, num_iters, project, start)
    return jnp.where(valid, jnp.exp(scores + f + g + h), 0.0)
