"""Edge-convolution encoder of key points (DGCNN, Wang et al. 2019) on a static neighbour graph."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from delo_jax.config import CoarseConfig


class EdgeConv(nn.Module):
    """h_i' = max_j MLP(h_j - h_i, h_i, x_j - x_i) over the neighbours j of i.

    The first layer is linear in its three inputs, so it is applied per point and per edge instead of per concatenated edge.
    """

    width: int

    @nn.compact
    def __call__(self, h: Float[Array, "k c"], edges: Float[Array, "k n e"], index: Int[Array, "k n"]) -> Float[Array, "k w"]:
        """New features of every point; `edges` are relative positions, `index` the neighbours."""
        neighbor = nn.Dense(self.width, use_bias=False, name="neighbor")(h)
        center = nn.Dense(self.width, name="center")(h)
        edge = nn.Dense(self.width, use_bias=False, name="edge")(edges)
        hidden = nn.relu(neighbor[index] + center[:, None, :] + edge)
        return nn.relu(jnp.max(nn.Dense(self.width, name="out")(hidden), axis=1))


class EdgeEncoder(nn.Module):
    """Descriptors of key points from their neighbourhood: three edge convolutions and a head."""

    cfg: CoarseConfig

    @nn.compact
    def __call__(
        self,
        points: Float[Array, "k 3"],
        features: Float[Array, "k c"],
        index: Int[Array, "k n"],
        mask: Bool[Array, " k"],
    ) -> Float[Array, "k d"]:
        """Unit descriptors, zero where masked; `features` go in as they are, positions as edges divided by `edge_scale_m`."""
        edges = (points[index] - points[:, None, :]) / self.cfg.edge_scale_m
        levels = [features]
        for level in range(3):
            h = EdgeConv(self.cfg.width, name=f"edge_conv_{level}")(levels[-1], edges, index)
            levels.append(nn.LayerNorm(name=f"norm_{level}")(h))
        h = nn.relu(nn.Dense(2 * self.cfg.width, name="hidden")(jnp.concatenate(levels[1:], axis=-1)))
        descriptors = nn.Dense(self.cfg.embedding_dim, name="descriptor")(h)
        length = jnp.sqrt(jnp.sum(descriptors**2, axis=-1, keepdims=True) + 1e-12)
        return jnp.where(mask[:, None], descriptors / length, 0.0)
