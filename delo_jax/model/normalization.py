"""Normalisation layers of the published network, for one item with a mask: batch and layer normalisation."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class BatchNorm(nn.Module):
    """Batch normalisation (Ioffe & Szegedy 2015) over every valid entry of every item of the batch.

    Written for one item: in training the sums and counts are added over the `vmap` axis, so that an item weighs by its
    number of valid entries, and the new running statistics come out the same for all items (`out_axes=None`). As in
    torch, the batch is normalised by its biased variance and the running variance follows the unbiased one.
    """

    train: bool
    """Use, and fold into the running statistics, those of the batch; otherwise the running ones alone."""
    axis_name: str | None = "batch"
    """The caller's `vmap` axis, in training only; None for an item on its own."""
    momentum: float = 0.9
    """Weight of the old running statistics; torch counts the new one's, 0.1."""
    epsilon: float = 1e-5
    """Added to the variance."""

    @nn.compact
    def __call__(self, x: Float[Array, "*n c"], mask: Bool[Array, "*n"]) -> Float[Array, "*n c"]:
        """Normalised channels; meaningless where masked, and finite there in training, or where x is."""
        channels = x.shape[-1:]
        scale = self.param("scale", nn.initializers.ones, channels)
        bias = self.param("bias", nn.initializers.zeros, channels)
        running_mean = self.variable("batch_stats", "mean", jnp.zeros, channels)
        running_var = self.variable("batch_stats", "var", jnp.ones, channels)
        mean, var = running_mean.value, running_var.value
        if self.train:
            x = jnp.where(mask[..., None], x, 0.0)  # else left out: a compiler then joins the rest with the product before it
            mean, var, count = self._moments(x, mask)
            if not self.is_initializing():
                unbiased = var * count / jnp.maximum(count - 1.0, 1.0)
                running_mean.value = self._follow(running_mean.value, mean, count >= 1.0)
                running_var.value = self._follow(running_var.value, unbiased, count >= 2.0)  # one entry says nothing of the spread
        return (x - _row(mean, x)) * _row(jax.lax.rsqrt(var + self.epsilon) * scale, x) + _row(bias, x)

    def _moments(self, x, mask):
        """Mean, biased variance and number of the valid entries of the batch; zeros where there is none."""
        axes = tuple(range(x.ndim - 1))
        count = self._total(jnp.sum(mask.astype(x.dtype)))
        divisor = jnp.maximum(count, 1.0)
        mean = self._total(jnp.sum(x, axis=axes)) / divisor
        centered = jnp.where(mask[..., None], x - _row(mean, x), 0.0)  # a second pass: E[x^2] - E[x]^2 cancels at tens of metres
        return mean, self._total(jnp.sum(centered**2, axis=axes)) / divisor, count

    def _total(self, value):
        """Sum over the batch; `init` sees one item and no axis."""
        return value if self.axis_name is None or self.is_initializing() else jax.lax.psum(value, self.axis_name)

    def _follow(self, old, new, usable):
        return jnp.where(usable, self.momentum * old + (1.0 - self.momentum) * jax.lax.stop_gradient(new), old)


class LayerNorm(nn.Module):
    """(x - mean) / (std + epsilon) * scale + bias over the last axis, with the unbiased standard deviation.

    The published transformer's variant ("The Annotated Transformer", Rush 2018): epsilon stands beside the standard
    deviation, not beside the variance as in flax and torch.
    """

    epsilon: float = 1e-6
    """Added to the standard deviation."""

    @nn.compact
    def __call__(self, x: Float[Array, "*n c"]) -> Float[Array, "*n c"]:
        """Normalised rows; a constant row becomes `bias`."""
        scale = self.param("scale", nn.initializers.ones, x.shape[-1:])
        bias = self.param("bias", nn.initializers.zeros, x.shape[-1:])
        centered = x - jnp.mean(x, axis=-1, keepdims=True)
        var = jnp.sum(centered**2, axis=-1, keepdims=True) / (x.shape[-1] - 1)
        varies = var > 0.0
        std = jnp.where(varies, jnp.sqrt(jnp.where(varies, var, 1.0)), 0.0)
        return centered / (std + self.epsilon) * _row(scale, x) + _row(bias, x)


def _row(channels, x):
    """Numbers per channel, with the rank of `x`."""
    return channels.reshape((1,) * (x.ndim - 1) + channels.shape)
