"""From descriptor scores to matches: marginals, the matching cost, softmax plans, and the projection of a plan to points.

A plan is a matrix of non-negative weights, rows source points, columns target points: `plan[i, j]` is how much of source
point i is matched to target point j. Marginals `a` (rows) and `b` (columns) say how much each point may give or take;
zero marks padding, so no function here or in `transport` has a mask beside its marginals.
"""

import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float

from delo_jax.geometry.se3 import full_float32

_FORBIDDEN = -1e30  # score of a padded pair; finite, so that no difference of two of them is NaN
_NO_MASS = 1e-30  # a lighter row counts as unmatched: the derivative of its mean, metres / mass, would leave float32


def uniform_marginal(mask: Bool[Array, " n"]) -> Float[Array, " n"]:
    """Equal shares of one: 1 / (number valid), 0 where masked; all zero when nothing is valid."""
    return mask.astype(float) / jnp.maximum(jnp.sum(mask), 1).astype(float)


def matching_cost(scores: Float[Array, "n m"], column_mask: Bool[Array, " m"]) -> Float[Array, "n m"]:
    """Cost C_ij = -log softmax_j(scores_ij) over the valid columns, the paper's matching cost (Sec. 3.1).

    Asymmetric: every source point spreads over the targets, so exchanging the clouds is not a transpose. The paper
    prints no scale; its code divides the scores by sqrt(d), which is the caller's business.

    Args:
        scores: similarity of descriptors, rows source, columns target; finite in valid columns.
        column_mask: valid target points.

    Returns:
        Cost >= 0; 0 in columns that are not valid.
    """
    valid = column_mask[None, :]
    scores = jnp.where(valid, scores, _FORBIDDEN)
    return jnp.where(valid, logsumexp(scores, axis=1, keepdims=True) - scores, 0.0)


def _mask_pairs(scores, a, b):
    """Which pairs have mass on both sides, and the scores with the others forbidden."""
    valid = (a > 0)[:, None] & (b > 0)[None, :]
    return valid, jnp.where(valid, scores, _FORBIDDEN)


def softmax_plan(scores: Float[Array, "n m"], a: Float[Array, " n"], b: Float[Array, " m"]) -> Float[Array, "n m"]:
    """Plan P_ij = a_i softmax_j(scores_ij): DCP's soft pointer (Wang and Solomon 2019).

    Every row gives all it has; what a column receives is not limited.

    Args:
        scores: similarity, rows source, columns target.
        a: mass of each source point; a learned confidence c of the rows enters as a * c.
        b: only says which target points are valid: those above zero.

    Returns:
        Plan with row sums a, zero in padded rows and columns; all zero when no column is valid.
    """
    valid, scores = _mask_pairs(scores, a, b)
    return jnp.where(valid, a[:, None] * jax.nn.softmax(scores, axis=1), 0.0)


def dual_softmax_plan(scores: Float[Array, "n m"], a: Float[Array, " n"], b: Float[Array, " m"]) -> Float[Array, "n m"]:
    """Plan P_ij = a_i softmax_j(scores_ij) softmax_i(scores_ij): the soft mutual nearest neighbour (LoFTR, Sun et al. 2021).

    Args:
        scores: similarity, rows source, columns target.
        a: mass of each source point; its zeros also leave a row out of the softmax over rows.
        b: only says which target points are valid: those above zero.

    Returns:
        Plan with row sums at most a, zero in padded rows and columns.
    """
    valid, scores = _mask_pairs(scores, a, b)
    return jnp.where(valid, a[:, None] * jax.nn.softmax(scores, axis=1) * jax.nn.softmax(scores, axis=0), 0.0)


@full_float32
def barycentric_projection(plan: Float[Array, "n m"], target: Float[Array, "m 3"]) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
    """Where the plan sends each source point, sum_j P_ij x_j / sum_j P_ij, and how much of it (the row sums).

    The paper's equation prints y_i in place of x_j, which returns the source point itself. Its code divides by the row
    sum + 1e-6 and so pulls every match towards the sensor, by 1 % at m = 0.1 and N = 1024; this division is exact. A row
    is first divided by its own (constant) sum, which changes neither the mean nor its derivative, but keeps the
    derivative's 1 / mass^2 inside float32.

    Args:
        plan: non-negative, rows source, columns target.
        target: target points [m], finite also where the plan is zero.

    Returns:
        Matched points in the target frame [m], and their weights; both zero in a row of no mass (below 1e-30).
    """
    weights = jnp.sum(plan, axis=1)
    some = weights > _NO_MASS
    shares = plan / jax.lax.stop_gradient(jnp.where(some, weights, 1.0))[:, None]
    total = jnp.where(some, jnp.sum(shares, axis=1), 1.0)
    matched = jnp.where(some[:, None], (shares @ target) / total[:, None], 0.0)
    return matched, jnp.where(some, weights, 0.0)
