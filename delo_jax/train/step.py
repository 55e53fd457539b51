"""The one jitted train step over the one params pytree."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from delo_jax.config import TrainConfig
from delo_jax.geometry import se3
from delo_jax.geometry.se3 import full_float32
from delo_jax.model import delo
from delo_jax.ops import evidence
from delo_jax.ops.matching import barycentric_projection
from delo_jax.preprocess import Scan
from delo_jax.train import losses

DROP_EPOCHS = (15, 30, 45)  # of the schedule `steps`
LARGEST_ERROR = 10.0  # units; a lost pair is off by 500


class PairBatch(NamedTuple):
    """Pairs of scans with truth; every array has a leading batch axis."""

    source: Scan
    target: Scan
    T_target_source: Float[Array, "b 4 4"]  # truth
    T_init: Float[Array, "b 4 4"]  # start of the fine stage
    from_coarse: Bool[Array, " b"]  # start from the coarse stage's own output instead
    # target of the fine stage: the target scan, or a local map around the source; without rows where there is no fine stage
    surfaces: delo.Surfaces
    T_surfaces_source: Float[Array, "b 4 4"]  # truth
    T_surfaces_init: Float[Array, "b 4 4"]  # start of the fine stage there


class TrainState(NamedTuple):
    """Everything a step changes."""

    variables: Any  # of the model: "params", and "batch_stats" where the preset has batch normalisation
    opt_state: optax.OptState  # of the params
    step: Int[Array, ""]
    num_nonfinite: Int[Array, ""]  # steps that were left out because loss or gradient was not finite


def make_schedule(cfg: TrainConfig, num_steps: int) -> optax.Schedule:
    """Learning rate by step; see `TrainConfig.schedule`."""
    if cfg.schedule == "constant":
        return optax.constant_schedule(cfg.learning_rate)
    if cfg.schedule == "steps":
        drops = {round(epoch * num_steps / cfg.num_epochs): 0.1 for epoch in DROP_EPOCHS if epoch < cfg.num_epochs}
        return optax.piecewise_constant_schedule(cfg.learning_rate, drops)
    warmup = min(cfg.warmup_steps, max(num_steps // 10, 1))
    return optax.warmup_cosine_decay_schedule(0.0, cfg.learning_rate, warmup, num_steps, 0.01 * cfg.learning_rate)


def make_optimizer(cfg: TrainConfig, num_steps: int) -> optax.GradientTransformation:
    """Adam on a schedule, with clipped gradients where the config says so."""
    adam = optax.adam(make_schedule(cfg, num_steps))
    return optax.chain(optax.clip_by_global_norm(cfg.clip_norm), adam) if cfg.clip_norm else adam


def start(variables: Any, tx: optax.GradientTransformation, step: int = 0, num_nonfinite: int = 0) -> TrainState:
    """State before the first step of a phase; both counts are those of the whole run."""
    return TrainState(variables, tx.init(variables["params"]), jnp.asarray(step, jnp.int32), jnp.asarray(num_nonfinite, jnp.int32))


def pair_loss(model: delo.Applicable, pair: PairBatch, cfg: TrainConfig, frozen: delo.Model) -> tuple[Array, dict[str, Array]]:
    """Loss of one pair and its parts; a part whose weight is 0 is not computed.

    Args:
        model: in training.
        pair: without batch axis.
        cfg: weights of the parts.
        frozen: the same weights without gradient, in inference mode: what evidence that is learned apart observes.
    """
    weights: dict[str, float] = {}
    terms: dict[str, Array] = {}
    T_true = pair.T_target_source
    joint = cfg.matching_weight + cfg.fine_weight + cfg.odometry_weight > 0
    solver = model if joint else frozen
    source, target = delo.encode(solver, pair.source), delo.encode(solver, pair.target)
    matching = delo.match(solver, source, target)
    first = delo.coarse(solver, source, target, matching.plan)
    if cfg.matching_weight > 0:
        weights["matching"], terms["matching"] = cfg.matching_weight, _matching_term(solver, source, target, matching, T_true, cfg)
    if cfg.odometry_weight > 0:
        points, mask = source.keypoints, source.keypoint_mask
        l1 = cfg.pose_loss == "l1"
        T = first.T_target_source
        pose = losses.point_loss(T, T_true, points, mask) if l1 else losses.matrix_loss(T, T_true)
        terms["pose"] = jnp.where(first.determined, pose, 0.0)  # else the slope of a rotation that nothing fixes is huge
        matched, sent = barycentric_projection(matching.plan, target.keypoints)
        terms["aux"] = losses.auxiliary_loss(matched, sent, T_true, points)
        weights |= {"pose": cfg.odometry_weight, "aux": cfg.odometry_weight * cfg.aux_weight}
    if cfg.fine_weight > 0:
        begin = jnp.where(pair.from_coarse, jax.lax.stop_gradient(first.T_target_source), pair.T_surfaces_init)
        points = jax.tree.map(lambda array: array[: cfg.num_points], source.cloud)
        poses = delo.refine_pose(solver, points, delo.cloud_of(solver, pair.surfaces), begin, num_iters=cfg.num_iters)
        weights["fine"], terms["fine"] = cfg.fine_weight, losses.pose_loss(poses, pair.T_surfaces_source)
    if cfg.evidence_weight > 0:
        weights["evidence"] = cfg.evidence_weight
        if cfg.model.evidence.head == "embedding":
            regularisers = jnp.repeat(jnp.array([cfg.rotation_regulariser, cfg.translation_regulariser]), 3)
            nig = delo.evidence_of_embedding(model, source, target, matching, first.T_target_source)
            terms["evidence"] = jnp.where(first.determined, losses.evidence_loss(nig, se3.pose6(T_true), regularisers), 0.0)
        else:
            terms["evidence"] = _error_evidence_term(model, source, target, pair, cfg)
    return sum((weights[name] * term for name, term in terms.items()), jnp.zeros(())), terms


def _matching_term(model, source, target, matching, T_true, cfg):
    """Scores or plan against the true matches."""
    masks, normals = (source.keypoint_mask, target.keypoint_mask), (source.keypoint_normals, target.keypoint_normals)
    matches = losses.true_matches(source.keypoints, target.keypoints, *normals, *masks, T_true)
    if cfg.matching_loss == "plan":
        return losses.plan_loss(matching.plan, matches)
    return losses.matching_loss(model.apply("scores", matching.source, matching.target), matches, *masks)


@full_float32
def _error_evidence_term(model, source, target, pair, cfg):
    """Evidence of the solver's error in units of the head, and the odds of failure; the solver is not moved by it."""
    regularisers = jnp.repeat(jnp.array([cfg.rotation_regulariser, cfg.translation_regulariser]), 3)
    solved = jax.lax.stop_gradient(delo.solve(model, source, target, pair.T_init))
    nig, success_logit = delo.evidence_of_statistics(model, solved.statistics)
    observed = se3.log(se3.inverse(solved.T_target_source) @ pair.T_target_source)
    units = delo.evidence_units(cfg.model)
    scaled = evidence.NIG(nig.gamma / units, nig.nu, nig.alpha, nig.beta / units**2)
    loss = losses.evidence_loss(scaled, observed / units, regularisers, LARGEST_ERROR)
    return loss + losses.success_loss(success_logit, observed, cfg.model.status)


def make_train_step(cfg: TrainConfig, tx: optax.GradientTransformation):
    """`train_step(state, batch) -> (state, metrics)`, jitted, state donated; statics are closed over.

    A step whose loss or gradient is not finite changes nothing but its count, `state.num_nonfinite`.
    """

    def loss_fn(params, others, batch: PairBatch):
        model = delo.Model({**others, "params": params}, cfg.model)
        frozen = jax.lax.stop_gradient(model)

        def one(pair):
            return delo.apply_in_training(model, lambda bound, pair: pair_loss(bound, pair, cfg, frozen), pair)

        (loss, terms), stats = jax.vmap(one, axis_name="batch", out_axes=(0, None))(batch)
        return jnp.mean(loss), (jax.tree.map(jnp.mean, terms), stats)

    @functools.partial(jax.jit, donate_argnums=0)
    def train_step(state: TrainState, batch: PairBatch):
        params, others = state.variables["params"], {name: part for name, part in state.variables.items() if name != "params"}
        (loss, (terms, stats)), grads = jax.value_and_grad(loss_fn, has_aux=True)(params, others, batch)
        grad_norm = optax.tree.norm(grads)
        updates, opt_state = tx.update(grads, state.opt_state, params)
        moved = {**others, **stats, "params": optax.apply_updates(params, updates)}, opt_state
        finite = jnp.isfinite(loss) & jnp.isfinite(grad_norm)
        variables, opt_state = jax.tree.map(lambda new, old: jnp.where(finite, new, old), moved, (state.variables, state.opt_state))
        metrics = {"loss": loss, "grad_norm": grad_norm, **terms}
        return TrainState(variables, opt_state, state.step + 1, state.num_nonfinite + ~finite), metrics

    return train_step
