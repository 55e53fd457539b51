"""Entropic optimal transport between source points (rows) and target points (columns), in the log domain.

Rounds of the dense partial transport are products of one matrix with vectors, and passes of log-sum-exp only where its weights would not
fit into a float32: a fifth of the time, the same numbers.

Marginals `a` and `b` are the masses of the points; zero marks padding, which gets and gives nothing. Iteration counts
are static: the loops must have a fixed length to be differentiable. Few iterations are not convergence; `marginal_excess`
says what is left.
"""

import functools

import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float, Int

_FORBIDDEN = -1e30  # log-weight of a padded pair; finite, so that no difference of two of them is NaN
_FLOOR = -80.0  # log-weight below the best of its row that a float32 still holds
_REACH = 40.0  # of the potentials; what the floor has cut off is then less than exp(-40) of its row
_TINY = 1e-30

Scalar = float | Float[Array, ""]


def _log(x):
    """Logarithm of x where x > 0, else 0, with a finite derivative."""
    return jnp.log(jnp.where(x > 0, x, 1.0))


def _log_weights(cost, epsilon, valid):
    """-cost / epsilon of valid pairs; what stands in the others, NaN included, has no influence and no derivative."""
    return jnp.where(valid, -jnp.where(valid, cost, 0.0) / epsilon, _FORBIDDEN)


def _by_column(g):
    return g[None, :]


def _column_logsumexp(x):
    return logsumexp(x, axis=0)


def _segment_logsumexp(x, segments, num_segments):
    """The log-sum-exp of the entries of `x` in each segment; `_FORBIDDEN` in an empty one."""
    x, segments = x.ravel(), segments.ravel()
    top = jax.lax.stop_gradient(jnp.maximum(jax.ops.segment_max(x, segments, num_segments), _FORBIDDEN))
    return top + _log(jax.ops.segment_sum(jnp.exp(x - top[segments]), segments, num_segments))


def _cap_by_turns(scores, a, b, mass, num_iters, *, spread, over_rows, gives_back=True, scale_first=True):
    """The log plan, scores + f + g + h, after rounds of three steps: cap the rows, cap the columns, set the total.

    With `gives_back`, a cap is computed afresh each round, which is Dykstra's correction; without, it only ever shrinks.
    `spread` brings column potentials (m) to the shape of `scores`; `over_rows` is the log-sum-exp that gives one number
    a column.
    """
    log_a, log_b, log_mass = _log(a)[:, None], _log(b), _log(jnp.asarray(mass, scores.dtype))

    def project(_, potentials):
        f, g, h = potentials
        row_cap = log_a - h - logsumexp(scores + spread(g), axis=1, keepdims=True)
        f = jnp.minimum(row_cap, 0.0 if gives_back else f)
        g = jnp.minimum(log_b - h - over_rows(scores + f), 0.0 if gives_back else g)
        return f, g, log_mass - logsumexp(scores + f + spread(g))

    h = log_mass - logsumexp(scores) if scale_first else jnp.zeros_like(log_mass)
    f, g, h = jax.lax.fori_loop(0, num_iters, project, (jnp.zeros_like(log_a), jnp.zeros_like(log_b), h))
    return scores + f + spread(g) + h


def _cap_by_products(scores, valid, a, b, mass, num_iters, *, gives_back=True, scale_first=True):
    """The log plan of `_cap_by_turns`, and whether it is to be trusted: the same rounds as products of one matrix with vectors.

    With r the largest score of each row and K = exp(S - r), LSE_j(S + g) = r + log K e^g, and likewise for columns: a round
    takes two products in place of three passes of exponentials. A weight below the floor counts as the floor, which
    is without effect unless a potential has to make up for it.
    """
    rows_valid, columns_valid = a > 0, b > 0
    top = jnp.where(jnp.any(valid, axis=1), jax.lax.stop_gradient(jnp.max(scores, axis=1)), 0.0)
    K = jnp.where(valid, jnp.exp(jnp.maximum(scores - top[:, None], _FLOOR)), 0.0)
    log_a, log_b, log_mass = _log(a) - top, _log(b), _log(jnp.asarray(mass, scores.dtype))

    def log(x):
        return jnp.log(jnp.maximum(x, _TINY))

    def factors(f):  # exp(f + top) of the rows as shares of the largest, and the logarithm of that
        highest = jax.lax.stop_gradient(jnp.max(jnp.where(rows_valid, f + top, _FORBIDDEN)))
        highest = jnp.where(jnp.any(rows_valid), highest, 0.0)
        return jnp.where(rows_valid, jnp.exp(jnp.where(rows_valid, f + top - highest, 0.0)), 0.0), highest

    def in_all(f, rows):  # LSE of everything
        shares, highest = factors(f)
        return highest + log(shares @ rows)

    def project(_, state):
        f, g, h, rows, reach = state
        f = jnp.where(rows_valid, jnp.minimum(log_a - h - log(rows), 0.0 if gives_back else f), 0.0)
        shares, highest = factors(f)
        g = jnp.where(columns_valid, jnp.minimum(log_b - h - highest - log(shares @ K), 0.0 if gives_back else g), 0.0)
        rows = K @ jnp.exp(g)
        return f, g, log_mass - in_all(f, rows), rows, jnp.minimum(reach, jnp.minimum(jnp.min(f), jnp.min(g)))

    f, g = jnp.zeros_like(log_a), jnp.zeros_like(log_b)
    rows = jnp.sum(K, axis=1)
    h = log_mass - in_all(f, rows) if scale_first else jnp.zeros_like(log_mass)
    f, g, h, _, reach = jax.lax.fori_loop(0, num_iters, project, (f, g, h, rows, jnp.zeros_like(log_mass)))
    return scores + f[:, None] + g[None, :] + h, reach > -_REACH


def _dense(cost, epsilon, a, b, mass, num_iters, **how):
    valid = (a > 0)[:, None] & (b > 0)[None, :]
    scores = _log_weights(cost, epsilon, valid)
    fast, trusted = _cap_by_products(scores, valid, a, b, mass, num_iters, **how)
    slow = functools.partial(_cap_by_turns, scores, a, b, mass, num_iters, spread=_by_column, over_rows=_column_logsumexp, **how)
    log_plan = jax.lax.cond(trusted, lambda: fast, slow)
    return jnp.where(valid & (mass > 0), jnp.exp(log_plan), 0.0)


def partial_transport(
    cost: Float[Array, "n m"], epsilon: Scalar, a: Float[Array, " n"], b: Float[Array, " m"], *, mass: Scalar, num_iters: int
) -> Float[Array, "n m"]:
    """Entropic plan that moves `mass` in all, no row giving more than `a`, no column taking more than `b`.

    Approaches min <P, C> + epsilon sum P log P with P 1 <= a, P^T 1 <= b, 1^T P 1 = mass (the paper's problem, Sec. 3.1) by
    Dykstra's projections (Benamou et al. 2015, Prop. 5), the same iterates as POT's `entropic_partial_wasserstein`. In the
    log domain the three corrections, matrices there, are vectors: with S = -C / epsilon,
    f = min(log a - h - LSE_j(S + g), 0), g = min(log b - h - LSE_i(S + f), 0), h = log mass - LSE(S + f + g).
    The total is always exact; caps may be exceeded before convergence, columns and rows alike.

    Args:
        cost: matching cost, finite where both marginals are positive.
        epsilon: entropic weight > 0; learned, so traced.
        a: largest mass of each source point; 0 is padding.
        b: largest mass of each target point; 0 is padding.
        mass: absolute amount, at most min(sum a, sum b); may be traced. Nothing moves at 0.
        num_iters: static number of rounds; 0 gives the kernel scaled to `mass`.

    Returns:
        Plan >= 0 with total `mass`, zero in padded rows and columns; all zero when nothing is valid.
    """
    return _dense(cost, epsilon, a, b, mass, num_iters)


def algorithm_1(
    cost: Float[Array, "n m"],
    epsilon: Scalar,
    a: Float[Array, " n"],
    b: Float[Array, " m"],
    *,
    mass: Scalar,
    num_iters: int,
    scale_first: bool = False,
) -> Float[Array, "n m"]:
    """The paper's Algorithm 1, or with `scale_first` the loop of its released code: capping in place, never undone.

    From K = exp(-C / epsilon), `num_iters` times: K <- diag(min(a / K 1, 1)) K, K <- K diag(min(b / K^T 1, 1)),
    K <- K mass / (1^T K 1). Mended only where the print is undefined (its K-tilde is defined through itself: K stands in
    the denominator here, as in the code). Without Dykstra's corrections the limit is not the optimum, and as printed,
    without the code's scaling to `mass` before the loop, the first step caps every row and makes their weights flat:
    prefer `partial_transport`. In the log domain capping in place is f <- min(log a - h - LSE_j(S + g), f), likewise g;
    the code's clamps of its divisors at 1e-8 are not needed.

    Args:
        cost: matching cost, finite where both marginals are positive.
        epsilon: entropic weight > 0.
        a: largest mass of each source point; 0 is padding.
        b: largest mass of each target point; 0 is padding.
        mass: absolute amount, at most min(sum a, sum b); may be traced.
        num_iters: static number of rounds (the paper's xi); 0 gives the kernel itself.
        scale_first: start from the kernel scaled to `mass`.

    Returns:
        Plan >= 0 with total `mass` after a round or more, zero in padded rows and columns.
    """
    return _dense(cost, epsilon, a, b, mass, num_iters, gives_back=False, scale_first=scale_first)


def sparse_partial_transport(
    cost: Float[Array, "n k"],
    index: Int[Array, "n k"],
    epsilon: Scalar,
    a: Float[Array, " n"],
    b: Float[Array, " m"],
    *,
    mass: Scalar,
    num_iters: int,
) -> Float[Array, "n k"]:
    """`partial_transport` where source point i may only be matched to the k target points `index[i]`.

    The same iterates as with all other pairs forbidden, in O(n k) instead of O(n m): the columns' log-sum-exp runs over
    segments. A target that is nobody's candidate receives nothing.

    Args:
        cost: matching cost of each candidate, finite where both marginals are positive.
        index: columns in [0, m), distinct within a row (a repeated one would count twice).
        epsilon: entropic weight > 0; learned, so traced.
        a: largest mass of each source point; 0 is padding.
        b: largest mass of each target point; 0 is padding.
        mass: absolute amount; may be traced. At most what the candidates can carry, which may be less than
            min(sum a, sum b).
        num_iters: static number of rounds.

    Returns:
        Plan >= 0 of the candidates, with total `mass`; `plan[i, l]` belongs to the pair (i, index[i, l]).
    """
    valid = (a > 0)[:, None] & (b > 0)[index]
    scores = _log_weights(cost, epsilon, valid)
    log_plan = _cap_by_turns(
        scores, a, b, mass, num_iters, spread=lambda g: g[index], over_rows=lambda x: _segment_logsumexp(x, index, b.shape[0])
    )
    return jnp.where(valid & (mass > 0), jnp.exp(log_plan), 0.0)


def _scale_by_turns(scores, a, b, damping, num_iters):
    """The log plan, scores + f + g, after rounds of Sinkhorn's two steps: scale the columns to b, then the rows to a.

    `damping` in (0, 1] is the exponent of each scaling; at 1 the rows are exact. Potentials of padding stay 0.
    """
    log_a, log_b = _log(a)[:, None], _log(b)[None, :]
    rows, columns = (a > 0)[:, None], (b > 0)[None, :]

    def scale(_, potentials):
        f, _ = potentials
        g = jnp.where(columns, damping * (log_b - logsumexp(scores + f, axis=0, keepdims=True)), 0.0)
        return jnp.where(rows, damping * (log_a - logsumexp(scores + g, axis=1, keepdims=True)), 0.0), g

    f, g = jax.lax.fori_loop(0, num_iters, scale, (jnp.zeros_like(log_a), jnp.zeros_like(log_b)))
    return scores + f + g


def dustbin_transport(
    scores: Float[Array, "n m"], dustbin_score: Scalar, a: Float[Array, " n"], b: Float[Array, " m"], *, num_iters: int
) -> Float[Array, "n m"]:
    """SuperGlue's optimal matching layer (Sarlin et al. 2020, Sec. 3.2): balanced transport with a bin for the unmatched.

    Sinkhorn on exp(scores) with one more row and one more column, all of whose scores are `dustbin_score`. The bin column
    can take all rows (mass sum a), the bin row can fill all columns (mass sum b). SuperGlue gives every point of both
    clouds one unit; for clouds of different size that takes marginals of one unit here too (mask / n for both), where
    uniform marginals let a column of the smaller cloud take several rows. The rounds end on the rows (SuperGlue's
    on the columns), so that no row gives more than it has after any number of them.

    Args:
        scores: similarity, rows source, columns target; the temperature is one.
        dustbin_score: what a match must beat; learned.
        a: mass of each source point; 0 is padding.
        b: mass of each target point; 0 is padding.
        num_iters: static number of rounds, at least one.

    Returns:
        Plan without the bins: row sums at most a, column sums at most b when converged, zero in padding.
    """
    n, m = scores.shape
    a, b = jnp.append(a, jnp.sum(b)), jnp.append(b, jnp.sum(a))
    valid = (a > 0)[:, None] & (b > 0)[None, :]
    scores = jnp.full((n + 1, m + 1), dustbin_score, scores.dtype).at[:n, :m].set(scores)
    log_plan = _scale_by_turns(jnp.where(valid, scores, _FORBIDDEN), a, b, 1.0, num_iters)
    return jnp.where(valid, jnp.exp(log_plan), 0.0)[:n, :m]


def unbalanced_transport(
    cost: Float[Array, "n m"],
    epsilon: Scalar,
    a: Float[Array, " n"],
    b: Float[Array, " m"],
    *,
    marginal_weight: Scalar,
    num_iters: int,
) -> Float[Array, "n m"]:
    """Entropic plan whose marginals may differ from `a` and `b` at a price (Chizat et al. 2018).

    Approaches min <P, C> + epsilon KL(P | a b^T) + rho KL(P 1 | a) + rho KL(P^T 1 | b), with KL(x | y) = sum x log(x / y) - x + y
    and rho the marginal weight, by Sinkhorn with every scaling raised to rho / (rho + epsilon). With the reference a b^T
    the plan does not depend on how finely a cloud is sampled. The released code's head of this name scales the
    columns by the rows' factors and is wrong for every factor that is not constant.

    Args:
        cost: matching cost, finite where both marginals are positive.
        epsilon: entropic weight > 0.
        a: wanted mass of each source point; 0 is padding.
        b: wanted mass of each target point; 0 is padding.
        marginal_weight: rho > 0, in the unit of the cost; large is balanced.
        num_iters: static number of rounds; 0 gives exp(-C / epsilon) a b^T.

    Returns:
        Plan >= 0, zero in padded rows and columns; its total is part of the answer.
    """
    valid = (a > 0)[:, None] & (b > 0)[None, :]
    scores = _log_weights(cost, epsilon, valid) + _log(a)[:, None] + _log(b)[None, :]
    log_plan = _scale_by_turns(scores, a, b, marginal_weight / (marginal_weight + epsilon), num_iters)
    return jnp.where(valid, jnp.exp(log_plan), 0.0)


def marginal_excess(plan: Float[Array, "n m"], a: Float[Array, " n"], b: Float[Array, " m"]) -> Float[Array, ""]:
    """Largest relative excess of a row sum over `a` or a column sum over `b`; 0 when all caps are kept.

    Infinite when padding (a cap of zero) carries mass.
    """

    def excess(total, cap):
        relative = (total - cap) / jnp.where(cap > 0, cap, 1.0)
        return jnp.where(cap > 0, relative, jnp.where(total > 0, jnp.inf, 0.0))

    both = jnp.append(excess(jnp.sum(plan, axis=1), a), excess(jnp.sum(plan, axis=0), b))
    return jnp.max(both, initial=0.0)
