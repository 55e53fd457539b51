"""Evidence head: normal-inverse-gamma parameters of the pose error, from the statistics of the solver."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from delo_jax.config import EvidenceConfig


class EvidenceHead(nn.Module):
    """24 raw numbers (gamma, nu, alpha, beta of six degrees of freedom, order [omega, v]) from the solver's statistics."""

    cfg: EvidenceConfig

    @nn.compact
    def __call__(self, statistics: Float[Array, " s"]) -> Float[Array, "24"]:
        """Raw parameters, to be constrained by `ops.evidence.constrain`."""
        hidden = nn.relu(nn.Dense(self.cfg.width)(statistics))
        hidden = nn.relu(nn.Dense(self.cfg.width)(hidden))
        return nn.Dense(24, kernel_init=nn.initializers.normal(0.01), bias_init=_bias)(hidden)


def _bias(_key, shape, dtype=jnp.float32):
    """Start at a standard deviation of about 5 units, so that the first losses are tame."""
    beta = jnp.arange(shape[0]) >= 18
    return jnp.where(beta, 4.0, 0.0).astype(dtype)
