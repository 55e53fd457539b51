"""The one jitted train step over the one params pytree."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from delo_jax.config import TrainConfig
from delo_jax.geometry import se3
from delo_jax.model import delo
from delo_jax.preprocess import Scan
from delo_jax.train import losses


class PairBatch(NamedTuple):
    """Pairs of scans with truth; every array has a leading batch axis."""

    source: Scan
    target: Scan
    T_target_source: Float[Array, "b 4 4"]  # truth
    T_init: Float[Array, "b 4 4"]  # start of the fine stage
    from_coarse: Bool[Array, " b"]  # start from the coarse stage's own output instead


class TrainState(NamedTuple):
    """Everything a step changes."""

    params: Any  # variables of the model
    opt_state: optax.OptState
    step: Int[Array, ""]


def make_optimizer(cfg: TrainConfig, num_steps: int) -> optax.GradientTransformation:
    """Adam with linear warm-up, cosine decay and clipped gradients."""
    warmup = min(cfg.warmup_steps, max(num_steps // 10, 1))
    schedule = optax.warmup_cosine_decay_schedule(0.0, cfg.learning_rate, warmup, num_steps, 0.01 * cfg.learning_rate)
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))


def pair_loss(model: delo.Model, pair: PairBatch, cfg: TrainConfig) -> tuple[Array, dict[str, Array]]:
    """Loss of one pair and its parts; a part whose weight is 0 is not computed."""
    terms: dict[str, Array] = {}
    source, target = delo.encode(model, pair.source), delo.encode(model, pair.target)
    if cfg.coarse_weight > 0:
        masks = source.keypoint_mask, target.keypoint_mask
        matches = losses.true_matches(
            source.keypoints, target.keypoints, source.keypoint_normals, target.keypoint_normals, *masks, pair.T_target_source
        )
        terms["coarse"] = losses.matching_loss(delo.matching_scores(model, source, target), matches, *masks)
    if cfg.fine_weight > 0:
        coarse = jax.lax.stop_gradient(delo.coarse(model, source, target).T_target_source)
        start = jnp.where(pair.from_coarse, coarse, pair.T_init)
        points = jax.tree.map(lambda array: array[: cfg.num_points], source.cloud)
        poses = delo.refine_pose(model, points, target.cloud, start, num_iters=cfg.num_iters)
        terms["fine"] = losses.pose_loss(poses, pair.T_target_source)
    if cfg.evidence_weight > 0:
        solved = jax.lax.stop_gradient(delo.solve(model, source, target, pair.T_init))
        nig, success_logit = delo.predict_evidence(model, solved.statistics)
        observed = se3.log(se3.inverse(solved.T_target_source) @ pair.T_target_source)
        units = delo.evidence_units(model.cfg)
        terms["evidence"] = losses.evidence_loss(nig, observed, units, cfg.regulariser_weight)
        terms["evidence"] += losses.success_loss(success_logit, observed, model.cfg.status)
    weights = {"coarse": cfg.coarse_weight, "fine": cfg.fine_weight, "evidence": cfg.evidence_weight}
    return sum((weights[name] * term for name, term in terms.items()), jnp.zeros(())), terms


def make_train_step(cfg: TrainConfig, tx: optax.GradientTransformation):
    """`train_step(state, batch) -> (state, metrics)`, jitted, state donated; statics are closed over."""

    def loss_fn(params, batch: PairBatch):
        model = delo.Model(params, cfg.model)
        loss, terms = jax.vmap(lambda pair: pair_loss(model, pair, cfg))(batch)
        return jnp.mean(loss), jax.tree.map(jnp.mean, terms)

    @functools.partial(jax.jit, donate_argnums=0)
    def train_step(state: TrainState, batch: PairBatch):
        (loss, terms), grads = jax.value_and_grad(loss_fn, has_aux=True)(state.params, batch)
        updates, opt_state = tx.update(grads, state.opt_state, state.params)
        metrics = {"loss": loss, "grad_norm": optax.tree.norm(grads), **terms}
        return TrainState(optax.apply_updates(state.params, updates), opt_state, state.step + 1), metrics

    return train_step
