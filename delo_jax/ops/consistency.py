"""Weights of matches that agree with one another under some rigid motion."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from delo_jax.geometry.se3 import full_float32


def _lengths(points):
    """Pairwise distances (k, k), with a zero gradient where two points coincide."""
    squared = sum((points[:, None, axis] - points[None, :, axis]) ** 2 for axis in range(3))
    apart = squared > 0
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, squared, 1.0)), 0.0)


@full_float32
def consistency_weights(
    source: Float[Array, "k 3"],
    target: Float[Array, "k 3"],
    weights: Float[Array, " k"],
    *,
    scale: float = 0.8,
    min_length: float = 1.0,
    num_iters: int = 12,
) -> Float[Array, " k"]:
    """Weight of each match in the largest set of matches that preserve each other's distances.

    A rigid motion keeps lengths, so that right matches are compatible in pairs:
    A_ij = [1 - ((|y_i - y_j| - |x_i - x_j|) / scale)^2]_+ sqrt(w_i w_j). The squared leading eigenvector of A, by
    power iteration, weighs its main cluster (spectral matching: Leordeanu and Hebert 2005).

    Args:
        source: source points x [m].
        target: their matches y [m].
        weights: prior weights >= 0, any scale; zero for padding.
        scale: change of length at which two matches stop being compatible [m].
        min_length: pairs closer than this, in either cloud, say nothing and count zero [m]; so does the diagonal.
        num_iters: power iterations, static.

    Returns:
        Weights >= 0 with sum 1; all zero when no two matches are compatible.
    """
    length_source, length_target = _lengths(source), _lengths(target)
    long_enough = jnp.minimum(length_source, length_target) >= min_length
    informative = long_enough & ~jnp.eye(source.shape[0], dtype=bool)
    largest = jnp.max(weights)
    relative = weights / jnp.where(largest > 0, largest, 1.0)
    positive = relative > 0
    root = jnp.where(positive, jnp.sqrt(jnp.where(positive, relative, 1.0)), 0.0)
    agreement = jnp.maximum(1.0 - ((length_target - length_source) / scale) ** 2, 0.0)
    A = jnp.where(informative, agreement, 0.0) * root[:, None] * root[None, :]

    def normalise(vector):
        total = jnp.sum(vector)
        return vector / jnp.where(total > 0, total, 1.0)

    leading = jax.lax.fori_loop(0, num_iters, lambda _, vector: normalise(A @ vector), normalise(root))
    return normalise(leading**2)
