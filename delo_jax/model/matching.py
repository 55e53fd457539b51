"""Learned temperature of the matching scores."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float


class Temperature(nn.Module):
    """Factor > 0 on cosine similarities; in the transport it also plays the part of 1 / epsilon."""

    @nn.compact
    def __call__(self) -> Float[Array, ""]:
        """The factor."""
        return jnp.exp(self.param("log_temperature", nn.initializers.constant(jnp.log(10.0)), ()))
