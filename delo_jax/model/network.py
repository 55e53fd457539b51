"""All trained layers of every preset, as one flax module: the config says which of them there are."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from delo_jax.config import NUM_FEATURES, DeloConfig
from delo_jax.model import fine
from delo_jax.model.attention import CoContext
from delo_jax.model.dgcnn import DGCNN, EdgeEncoder
from delo_jax.model.evidential import EvidenceHead, PoseEvidenceHead
from delo_jax.model.matching import Matcher
from delo_jax.model.statistics import NUM_STATISTICS


class Network(nn.Module):
    """Layers by name; each method is one of them, for one scan or one pair."""

    cfg: DeloConfig
    train: bool = False
    """Batch normalisation by the statistics of the batch, under `jax.vmap(..., axis_name="batch")`."""

    def setup(self):
        """Name the layers."""
        cfg, enc = self.cfg, self.cfg.encoder
        if enc.kind == "dgcnn":
            scales = enc.edges, enc.edge_scale_m, enc.position_scale_m
            self.encoder: Any = DGCNN(self.train, enc.width, enc.embedding_dim, *scales)
        else:
            self.encoder = EdgeEncoder(enc)
        if cfg.attention.num_heads:
            self.co_context = CoContext(cfg.attention.num_heads, cfg.attention.hidden)
        self.matcher = Matcher(cfg.matching)
        if cfg.fine.num_iters:
            self.point_embedding = fine.PointEmbedding(cfg.fine)
            self.edge_network = fine.EdgeNetwork(cfg.fine)
        if cfg.evidence.head == "statistics":
            self.evidence_head: Any = EvidenceHead(cfg.evidence)
        elif cfg.evidence.head == "embedding":
            self.evidence_head = PoseEvidenceHead(self.train)

    def embed(self, features):
        """Point embeddings of the fine stage."""
        return self.point_embedding(features)

    def describe(self, points, features, index, mask):
        """Descriptors of key points."""
        if self.cfg.encoder.kind == "dgcnn":
            return self.encoder(points, index, mask)
        return self.encoder(points, features, index, mask)

    def contextualise(self, descriptors, mask):
        """What one scan brings to the transformer."""
        return self.co_context.prepare(descriptors, mask)

    def attend(self, own, other):
        """Descriptors of one scan in the context of the other."""
        return self.co_context.attend(own, other)

    def scores(self, source, target):
        """Scores between two sets of descriptors."""
        return self.matcher.scores(source, target)

    def plan(self, source, target, source_mask, target_mask):
        """Plan between two sets of descriptors."""
        return self.matcher(source, target, source_mask, target_mask)

    def confidence(self, source, target, geometry):
        """Logits of the fine stage."""
        return self.edge_network(source, target, geometry)

    def evidence(self, *inputs):
        """Raw evidence."""
        return self.evidence_head(*inputs)

    def everything(self, points, features, geometry, *evidence_inputs):
        """One call of every layer, for `init`."""
        cfg, mask = self.cfg, jnp.ones(points.shape[0], bool)
        index = jnp.zeros((points.shape[0], cfg.encoder.num_neighbors), jnp.int32)
        descriptors = self.describe(points, jnp.concatenate([points, features], -1), index, mask)
        if cfg.attention.num_heads:
            context = self.contextualise(descriptors, mask)
            descriptors = self.attend(context, context)
        self.plan(descriptors, descriptors, mask, mask)
        if cfg.fine.num_iters:
            embedding = self.embed(features)
            self.confidence(embedding, embedding, geometry)
        if cfg.evidence.head == "statistics":
            self.evidence(*evidence_inputs)
        elif cfg.evidence.head == "embedding":
            self.evidence(descriptors, descriptors, mask, mask, jnp.zeros(6))


def example_inputs(cfg: DeloConfig) -> tuple[jax.Array, ...]:
    """Arguments of `Network.everything`: four points, and what the heads of the preset read."""
    points, features = jnp.zeros((4, 3)), jnp.zeros((4, NUM_FEATURES))
    geometry, _, _ = fine.match_geometry(points, points, points, points, jnp.ones(4, bool))
    statistics = (jnp.zeros(NUM_STATISTICS),) if cfg.evidence.head == "statistics" else ()
    return points, features, geometry, *statistics
