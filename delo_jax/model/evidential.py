"""Evidence head: normal-inverse-gamma parameters of the pose error and the odds of failure, from the solver's statistics."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from delo_jax.config import EvidenceConfig
from delo_jax.model.normalization import BatchNorm
from delo_jax.ops.pooling import largest


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


class PoseEvidenceHead(nn.Module):
    """Raw evidence from both clouds' embeddings and the estimated pose: the published PU-EPE network.

    The authors' code pools the embeddings after the transformer, the paper's text says before: the caller chooses. Batch
    normalisation runs over the items of the batch: in training, an item alone is normalised to the biases.
    """

    train: bool
    """Batch statistics in the normalisation; the caller's `vmap` axis is then called "batch"."""

    @nn.compact
    def __call__(
        self,
        source: Float[Array, "n d"],
        target: Float[Array, "m d"],
        source_mask: Bool[Array, " n"],
        target_mask: Bool[Array, " m"],
        pose6: Float[Array, "6"],
    ) -> Float[Array, "24"]:
        """Raw parameters, four groups of six (gamma, nu, alpha, beta); `pose6` is [roll, pitch, yaw, x, y, z], rad and m."""
        pooled = jnp.concatenate([_max_pool(source, source_mask), _max_pool(target, target_mask)])
        pair = nn.Dense(64, name="pair_out")(self._layers(pooled, (256, 128, 64), "pair"))
        fused = nn.Dense(48, name="fusion_out")(self._layers(jnp.concatenate([pair, pose6]), (128, 64), "fusion"))
        return nn.Dense(24, name="evidence")(fused)

    def _layers(self, x, widths, name):
        for level, width in enumerate(widths):
            x = nn.Dense(width, name=f"{name}_{level}")(x)
            x = nn.relu(BatchNorm(self.train, name=f"{name}_norm_{level}")(x, jnp.ones((), bool)))
        return x


def _max_pool(features, mask):
    """Maximum of every channel over the valid rows; zeros when there is none."""
    maximum = largest(jnp.where(mask[:, None], features, -jnp.inf), 0)
    return jnp.where(jnp.any(mask), maximum, 0.0)
