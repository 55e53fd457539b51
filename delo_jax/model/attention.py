"""Co-contextual embeddings: the transformer with which each cloud looks at the other (DCP's pointer, Wang & Solomon 2019)."""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from delo_jax.model.normalization import LayerNorm

_FORBIDDEN = -1e30  # score of a padded key; finite, so that a cloud of padding alone is not NaN


class CloudContext(NamedTuple):
    """All that one cloud brings to any pair, as source or as target; padded rows are without effect."""

    features: Float[Array, "n d"]  # phi, zero where masked
    state: Float[Array, "n d"]  # decoder state, after its self-attention
    query: Float[Array, "n d"]  # what the state asks of the other cloud
    key: Float[Array, "n d"]  # of the encoder's output, for the other cloud to ask
    value: Float[Array, "n d"]  # of the encoder's output, for the other cloud to take
    mask: Bool[Array, " n"]


class Projection(nn.Module):
    """Dense layer as wide as its input."""

    @nn.compact
    def __call__(self, x: Float[Array, "n d"]) -> Float[Array, "n d"]:
        """The projected rows."""
        width = x.shape[-1]
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (width, width))
        return x @ kernel + self.param("bias", nn.initializers.zeros, (width,))[None, :]


class MultiHeadAttention(nn.Module):
    """Scaled dot-product attention in slices of the width (Vaswani et al. 2017); its projections can be called apart."""

    num_heads: int

    def setup(self):
        """Name the projections."""
        self.query, self.key, self.value, self.out = Projection(), Projection(), Projection(), Projection()

    def __call__(self, x: Float[Array, "n d"], mask: Bool[Array, " n"]) -> Float[Array, "n d"]:
        """Self-attention of rows."""
        return self.attend(self.query(x), self.key(x), self.value(x), mask)

    def attend(
        self, query: Float[Array, "n d"], key: Float[Array, "m d"], value: Float[Array, "m d"], mask: Bool[Array, " m"]
    ) -> Float[Array, "n d"]:
        """Attention of projected rows to projected keys; with no valid key, the bias of the output projection."""
        q, k, v = (rows.reshape(rows.shape[0], self.num_heads, -1).transpose(1, 0, 2) for rows in (query, key, value))

        def head(qkv):  # one after the other, which keeps n x m numbers in the cache
            q, k, v = qkv
            scores = (q * q.shape[-1] ** -0.5) @ k.T + jnp.where(mask, 0.0, _FORBIDDEN)[None, :]
            # A softmax that divides after the product with the values: three passes over n x m numbers fewer.
            weights = jnp.exp(scores - jax.lax.stop_gradient(jnp.max(scores, axis=-1, keepdims=True)))
            return (weights @ v) / jnp.sum(weights, axis=-1, keepdims=True)

        mixed = jnp.where(jnp.any(mask), jax.lax.map(head, (q, k, v)), 0.0)
        return self.out(mixed.transpose(1, 0, 2).reshape(query.shape))


class FeedForward(nn.Module):
    """Two dense layers with a ReLU between them, per row."""

    hidden: int

    @nn.compact
    def __call__(self, x: Float[Array, "n d"]) -> Float[Array, "n d"]:
        """The transformed rows."""
        return nn.Dense(x.shape[-1], name="out")(nn.relu(nn.Dense(self.hidden, name="hidden")(x)))


class Encoder(nn.Module):
    """One pre-norm encoder block and a final normalisation."""

    num_heads: int
    hidden: int

    @nn.compact
    def __call__(self, x: Float[Array, "n d"], mask: Bool[Array, " n"]) -> Float[Array, "n d"]:
        """The memory that the other cloud reads."""
        x = x + MultiHeadAttention(self.num_heads, name="attention")(LayerNorm(name="attention_norm")(x), mask)
        x = x + FeedForward(self.hidden, name="feed_forward")(LayerNorm(name="feed_forward_norm")(x))
        return LayerNorm(name="norm")(x)


class Decoder(nn.Module):
    """One pre-norm decoder block and a final normalisation, cut in two where the other cloud comes in."""

    num_heads: int
    hidden: int

    def setup(self):
        """Name the layers."""
        self.self_norm, self.self_attention = LayerNorm(), MultiHeadAttention(self.num_heads)
        self.cross_norm, self.cross_attention = LayerNorm(), MultiHeadAttention(self.num_heads)
        self.feed_forward_norm, self.feed_forward = LayerNorm(), FeedForward(self.hidden)
        self.norm = LayerNorm()

    def prepare(self, features: Float[Array, "n d"], memory: Float[Array, "n d"], mask: Bool[Array, " n"]) -> CloudContext:
        """The part before the cut, and the cross-attention's projections on both sides of it."""
        state = features + self.self_attention(self.self_norm(features), mask)
        cross = self.cross_attention
        return CloudContext(features, state, cross.query(self.cross_norm(state)), cross.key(memory), cross.value(memory), mask)

    def __call__(self, own: CloudContext, other: CloudContext) -> Float[Array, "n d"]:
        """The part after the cut: pointer(own, other)."""
        x = own.state + self.cross_attention.attend(own.query, other.key, other.value, other.mask)
        return self.norm(x + self.feed_forward(self.feed_forward_norm(x)))


class CoContext(nn.Module):
    """Phi = phi + pointer(phi, phi of the other cloud), the same weights in both directions (paper, co-contextual map).

    pointer(y, x) is a transformer whose decoder reads y and whose encoder reads x; no positional code, no dropout. Most
    of it needs one cloud only: a stream keeps `prepare` of every scan and pays `attend` twice per pair.
    """

    num_heads: int
    hidden: int

    def setup(self):
        """Name the two halves."""
        self.encoder, self.decoder = Encoder(self.num_heads, self.hidden), Decoder(self.num_heads, self.hidden)

    def prepare(self, features: Float[Array, "n d"], mask: Bool[Array, " n"]) -> CloudContext:
        """What does not depend on the other cloud."""
        features = jnp.where(mask[:, None], features, 0.0)
        return self.decoder.prepare(features, self.encoder(features, mask), mask)

    def attend(self, own: CloudContext, other: CloudContext) -> Float[Array, "n d"]:
        """Embedding Phi of `own` in the context of `other`; zero where masked."""
        return jnp.where(own.mask[:, None], own.features + self.decoder(own, other), 0.0)

    def __call__(
        self, source: Float[Array, "n d"], target: Float[Array, "m d"], source_mask: Bool[Array, " n"], target_mask: Bool[Array, " m"]
    ) -> tuple[Float[Array, "n d"], Float[Array, "m d"]]:
        """Embeddings of both clouds, each in the context of the other."""
        own, other = self.prepare(source, source_mask), self.prepare(target, target_mask)
        return self.attend(own, other), self.attend(other, own)
