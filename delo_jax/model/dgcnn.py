"""Edge-convolution encoder of key points (DGCNN, Wang et al. 2019) on a static neighbour graph."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from delo_jax.config import EncoderConfig
from delo_jax.model.normalization import BatchNorm
from delo_jax.ops.pooling import largest


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
        return nn.relu(largest(nn.Dense(self.width, name="out")(hidden), 1))


class EdgeEncoder(nn.Module):
    """Descriptors of key points from their neighbourhood: three edge convolutions and a head."""

    cfg: EncoderConfig

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


class DGCNN(nn.Module):
    """Features of the published encoder: a chain of per-edge layers on one static neighbour graph (DCP's DGCNN).

    Every edge (neighbour j, centre i) goes through four layers on its own; the maxima over the neighbours after each of
    them, side by side, are mixed into the feature of the point.
    """

    train: bool
    """Batch statistics in the normalisation; the caller's `vmap` axis is then called "batch"."""
    width: int = 64
    """Channels of the first two layers; the third has twice, the fourth four times as many."""
    embedding_dim: int = 512
    """D: length of a feature."""
    edges: str = "absolute"
    """Either "absolute": an edge is (x_j, x_i), as published; "relative": (x_j - x_i, x_i)."""
    edge_scale_m: float = 1.0
    """Relative positions are divided by this length."""
    position_scale_m: float = 1.0
    """Absolute positions are divided by this length; as published, 1."""

    @nn.compact
    def __call__(self, points: Float[Array, "k 3"], index: Int[Array, "k n"], mask: Bool[Array, " k"]) -> Float[Array, "k d"]:
        """Features, zero where masked; `index` holds the neighbours, the point itself included, only valid ones for a valid point."""
        edges = self._edges(jnp.where(mask[:, None], points, 0.0), index)
        edge_mask = jnp.broadcast_to(mask[:, None], index.shape)
        levels = []
        for level, factor in enumerate((1, 1, 2, 4)):
            precision = "highest" if level == 0 else None  # metres go in: no TF32
            edges = nn.Dense(factor * self.width, use_bias=False, precision=precision, name=f"conv_{level}")(edges)
            edges = nn.relu(BatchNorm(self.train, name=f"norm_{level}")(edges, edge_mask))
            levels.append(largest(edges, 1))
        features = nn.Dense(self.embedding_dim, use_bias=False, name="conv_out")(jnp.concatenate(levels, axis=-1))
        features = nn.relu(BatchNorm(self.train, name="norm_out")(features, mask))
        return jnp.where(mask[:, None], features, 0.0)

    def _edges(self, points, index):
        """Input of the first layer, (k, n, 6)."""
        neighbor, center = points[index], jnp.broadcast_to(points[:, None, :], (*index.shape, 3))
        match self.edges:
            case "absolute":
                first = neighbor / self.position_scale_m
            case "relative":
                first = (neighbor - center) / self.edge_scale_m
            case _:
                raise ValueError(f"edges: expected 'absolute' or 'relative', got {self.edges!r}")
        return jnp.concatenate([first, center / self.position_scale_m], axis=-1)
