"""Nearest neighbours by brute force, for use inside jit."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_UNREACHABLE = float("inf")


def _squared_distances(a, b):
    """Squared distances (n, m) between rows of `a` and rows of `b`.

    Coordinates are subtracted, not expanded (|x|^2 + |y|^2 - 2xy is wrong by 3e-3 m^2 at 70 m in float32), one plane
    at a time, so that the compiler fuses the sum and never stores n x m x 3 numbers.
    """
    dx = a[:, None, 0] - b[None, :, 0]
    dy = a[:, None, 1] - b[None, :, 1]
    dz = a[:, None, 2] - b[None, :, 2]
    return dx * dx + dy * dy + dz * dz


def nearest(
    queries: Float[Array, "n 3"], points: Float[Array, "m 3"], mask: Bool[Array, " m"]
) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """Index of the nearest valid point to each query, and the squared distance to it.

    A packed arg-min: the bits of a non-negative float32 sort like an integer, so the low bits of the distance are
    replaced by the index and one integer minimum finds both (on a CPU, a hundredth of the time of
    `lax.approx_min_k`). The price: ceil(log2 m) bits of the 23-bit mantissa, so squared distances within a factor
    1 + m / 2^22 (1e-3 at m = 4096) may count as ties, which the lowest index wins.

    Args:
        queries: [m], finite.
        points: [m], finite where valid.
        mask: which points may be chosen.

    Returns:
        Index (int32), and the exact squared distance [m^2], differentiable; 0 and infinity when no point is valid.
    """
    low_bits = (1 << (points.shape[0] - 1).bit_length()) - 1
    squared = _squared_distances(*jax.lax.stop_gradient((points, queries)))
    reachable = jnp.where(mask[:, None], squared, _UNREACHABLE)
    keys = jax.lax.bitcast_convert_type(reachable.astype(jnp.float32), jnp.int32)
    packed = (keys & ~low_bits) | jnp.arange(points.shape[0], dtype=jnp.int32)[:, None]
    index = jnp.min(packed, axis=0) & low_bits  # over the leading axis: a CPU takes the minimum of whole vectors
    difference = queries - points[index]
    exact = jnp.sum(difference * difference, axis=1)
    return index, jnp.where(mask[index], exact, _UNREACHABLE)


def knn(points: Float[Array, "n 3"], mask: Bool[Array, " n"], k: int) -> Int[Array, "n k"]:
    """Indices of the k nearest valid points to each point, nearest first, the point itself included.

    Exact, by a full sort key per pair: for a few hundred key points.

    Args:
        points: [m], finite.
        mask: which points may be neighbours.
        k: static, at most n.

    Returns:
        Indices (int32); places that no valid point fills hold the row's own index.
    """
    points = jax.lax.stop_gradient(points)
    reachable = jnp.where(mask[None, :], _squared_distances(points, points), _UNREACHABLE)
    negative, index = jax.lax.top_k(-reachable, k)
    return jnp.where(jnp.isfinite(negative), index, jnp.arange(points.shape[0], dtype=index.dtype)[:, None])
