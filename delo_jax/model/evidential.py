"""Evidence head: normal-inverse-gamma parameters of the pose error and the odds of failure, from the solver's statistics."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from delo_jax.config import EvidenceConfig


class EvidenceHead(nn.Module):
    """Raw evidence (gamma, nu, alpha, beta of six degrees of freedom, order [omega, v]) and the logit of success.

    The two are kept apart because errors have two populations: centimetres, and metres once the pair is lost. One
    unimodal density cannot say both.
    """

    cfg: EvidenceConfig

    @nn.compact
    def __call__(self, statistics: Float[Array, " s"]) -> tuple[Float[Array, "24"], Float[Array, ""]]:
        """Raw parameters, to be constrained by `ops.evidence.constrain`, and the logit of the pair not being lost."""
        hidden = nn.relu(nn.Dense(self.cfg.width)(statistics))
        hidden = nn.relu(nn.Dense(self.cfg.width)(hidden))
        raw = nn.Dense(25, kernel_init=nn.initializers.normal(0.01), bias_init=_bias)(hidden)
        return raw[:24], raw[24]


def _bias(_key, shape, dtype=jnp.float32):
    """Start at a standard deviation of about 5 units, so that the first losses are tame."""
    row = jnp.arange(shape[0])
    return jnp.where((row >= 18) & (row < 24), 4.0, 0.0).astype(dtype)
