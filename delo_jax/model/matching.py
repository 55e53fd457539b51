"""Scores between two sets of descriptors, and the plan that is made of them."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from delo_jax.config import MIN_EPSILON, MatchingConfig
from delo_jax.ops.matching import dual_softmax_plan, matching_cost, softmax_plan, uniform_marginal
from delo_jax.ops.transport import (
    algorithm_1,
    dustbin_transport,
    partial_transport,
    sparse_partial_transport,
    unbalanced_transport,
)

MASS_RANGE = (0.05, 1.0)  # of a predicted mass


class Matcher(nn.Module):
    """From descriptors to a plan, by any of the formulations of `config.PLANS`.

    The paper's entropic weight (its lambda) is `epsilon`: positive by a softplus above a floor. The released code learns
    it raw and clamps it, which leaves it without a gradient once it has fallen to the clamp.
    """

    cfg: MatchingConfig

    def setup(self):
        """Weights that the formulation has."""
        cfg = self.cfg
        if cfg.scores == "cosine":
            self.log_temperature = self.param("log_temperature", nn.initializers.constant(jnp.log(10.0)), ())
        if cfg.learn_epsilon:
            above = cfg.epsilon - MIN_EPSILON
            start = above + jnp.log(-jnp.expm1(-above))  # softplus of it is `above`
            self.raw_epsilon = self.param("raw_epsilon", nn.initializers.constant(start), ())
        if cfg.plan == "softmax_confidence":
            self.confidence = nn.Dense(1)
        if cfg.plan == "dustbin_transport":
            self.dustbin = self.param("dustbin", nn.initializers.ones, ())
        if cfg.predict_mass:
            self.mass_of_fit = self.param("mass_of_fit", nn.initializers.constant(jnp.array([0.0, 2.0])), (2,))

    def scores(self, source: Float[Array, "n d"], target: Float[Array, "m d"]) -> Float[Array, "n m"]:
        """Cosines (of unit descriptors) times the learned factor, or inner products over sqrt(D)."""
        scale = jnp.exp(self.log_temperature) if self.cfg.scores == "cosine" else source.shape[1] ** -0.5
        return scale * (source @ target.T)

    def epsilon(self) -> Float[Array, ""]:
        """Entropic weight of the transport, learned or fixed."""
        if self.cfg.learn_epsilon:
            return MIN_EPSILON + jax.nn.softplus(self.raw_epsilon)
        return jnp.asarray(self.cfg.epsilon)

    def mass(self, cost: Float[Array, "n m"], a: Float[Array, " n"], b: Float[Array, " m"]) -> Float[Array, ""]:
        """Transported fraction: as configured, or learned from how well the best matches of the rows fit."""
        if not self.cfg.predict_mass:
            return jnp.asarray(self.cfg.mass)
        best = jnp.min(jnp.where(b[None, :] > 0, cost, 1e3), axis=1)
        fit = jnp.sum(a * jnp.exp(-best))  # mean probability of the best match
        low, high = MASS_RANGE
        return low + (high - low) * jax.nn.sigmoid(self.mass_of_fit[0] + self.mass_of_fit[1] * fit)

    def __call__(
        self, source: Float[Array, "n d"], target: Float[Array, "m d"], source_mask: Bool[Array, " n"], target_mask: Bool[Array, " m"]
    ) -> Float[Array, "n m"]:
        """Plan between the valid rows of two descriptor sets, rows source, columns target."""
        cfg, scores = self.cfg, self.scores(source, target)
        a, b = uniform_marginal(source_mask), uniform_marginal(target_mask)
        if cfg.plan == "softmax":
            return softmax_plan(scores / self.epsilon(), a, b)
        if cfg.plan == "softmax_confidence":
            return softmax_plan(scores / self.epsilon(), a * jax.nn.sigmoid(self.confidence(source)[:, 0]), b)
        if cfg.plan == "dual_softmax":
            return dual_softmax_plan(scores / self.epsilon(), a, b)
        if cfg.plan == "dustbin_transport":
            return dustbin_transport(scores / self.epsilon(), self.dustbin, a, b, num_iters=cfg.num_iters)
        cost = matching_cost(scores, target_mask)
        mass, epsilon = self.mass(cost, a, b), self.epsilon()
        if cfg.plan == "sparse_transport":
            return self._sparse(cost, epsilon, mass, a, b)
        if cfg.plan == "unbalanced_transport":
            return unbalanced_transport(cost, epsilon, a, b, marginal_weight=cfg.marginal_weight, num_iters=cfg.num_iters)
        if cfg.plan == "partial_transport":
            return partial_transport(cost, epsilon, a, b, mass=mass, num_iters=cfg.num_iters)
        return algorithm_1(cost, epsilon, a, b, mass=mass, num_iters=cfg.num_iters, scale_first=cfg.plan == "released_code")

    def _sparse(self, cost, epsilon, mass, a, b):
        num = min(self.cfg.num_candidates, cost.shape[1])
        _, index = jax.lax.top_k(jnp.where(b[None, :] > 0, -cost, -jnp.inf), num)
        near = jnp.take_along_axis(cost, index, axis=1)
        plan = sparse_partial_transport(near, index, epsilon, a, b, mass=mass, num_iters=self.cfg.num_iters)
        return jnp.zeros_like(cost).at[jnp.arange(cost.shape[0])[:, None], index].set(plan)
