"""Nearest neighbours by brute force, for use inside jit."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_UNREACHABLE = float("inf")
_BLOCK = 256  # points whose distances are in the cache at once


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
    replaced by the index and one integer minimum finds both, block by block of the points. The price: ceil(log2 m) bits of
    the 23-bit mantissa, so squared distances within a factor 1 + m / 2^22 (1e-3 at m = 4096) may count as ties, which
    the lowest index wins. `benchmarks/neighbours.py` has the times of other ways.

    Args:
        queries: [m], finite.
        points: [m], finite where valid.
        mask: which points may be chosen.

    Returns:
        Index (int32), and the exact squared distance [m^2], differentiable; 0 and infinity when no point is valid.
    """
    num, size = points.shape[0], min(_BLOCK, points.shape[0])
    low_bits = (1 << (num - 1).bit_length()) - 1
    padding = -num % size
    blocks = jnp.pad(points, ((0, padding), (0, 0))), jnp.pad(mask, (0, padding)), jnp.arange(num + padding, dtype=jnp.int32)
    fixed = jax.lax.stop_gradient(queries)

    def nearer(best, block):
        points, mask, index = block
        reachable = jnp.where(mask[:, None], _squared_distances(points, fixed), _UNREACHABLE)
        keys = jax.lax.bitcast_convert_type(reachable.astype(jnp.float32), jnp.int32)
        packed = (keys & ~low_bits) | index[:, None]
        return jnp.minimum(best, jnp.min(packed, axis=0)), None  # over the leading axis: a CPU takes the minimum of whole vectors

    farthest = jnp.full(queries.shape[0], jnp.iinfo(jnp.int32).max)
    split = [jax.lax.stop_gradient(array).reshape(-1, size, *array.shape[1:]) for array in blocks]
    index = jax.lax.scan(nearer, farthest, split)[0] & low_bits
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
