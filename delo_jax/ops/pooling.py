"""The largest of several numbers, with a derivative that survives rounding."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def largest(x: Float[Array, "..."], axis: int) -> Float[Array, "..."]:
    """Maximum along an axis; its derivative is that of the first entry that is largest.

    The derivative of `jnp.max` finds the largest entries again, by comparing with the maximum. Where a compiler computes one side of that
    comparison anew, with another rounding, nothing is equal, and the derivative is 0 / 0. Here the place is an index.

    Args:
        x: any shape.
        axis: counted from the front.
    """
    return jnp.max(x, axis=axis)


@largest.defjvp
def _largest_jvp(axis, primals, tangents):
    (x,), (dx,) = primals, tangents
    place = jnp.argmax(x, axis=axis, keepdims=True)
    here = jax.lax.broadcasted_iota(place.dtype, x.shape, axis) == place
    return largest(x, axis), jnp.sum(jnp.where(here, dx, jnp.zeros_like(dx)), axis=axis)
