"""The training run: worlds, two phases of steps, validation, checkpoints that resume."""

import dataclasses
import logging
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from delo_jax.config import TrainConfig
from delo_jax.errors import ConfigError
from delo_jax.model import delo
from delo_jax.train.pairs import make_batch
from delo_jax.train.step import PairBatch, TrainState, make_optimizer, make_train_step
from delo_jax.train.validate import GapErrors, validate
from delo_jax.train.worlds import World, worlds

log = logging.getLogger(__name__)


@runtime_checkable
class Reporter(Protocol):
    """Where progress goes; the command line draws bars."""

    def start(self, what: str, total: int, done: int = 0) -> None:
        """A new piece of work of `total` units begins."""

    def advance(self, note: str = "") -> None:
        """One unit is done."""

    def validated(self, step: int, errors: list[GapErrors]) -> None:
        """Errors on unseen worlds after `step` steps."""


def phases(cfg: TrainConfig) -> list[tuple[TrainConfig, int]]:
    """(weights of the losses, number of steps): first matching and pose, then the evidence of the finished solver.

    A phase whose weights are all 0 has no steps.
    """
    pose = dataclasses.replace(cfg, evidence_weight=0.0)
    evidence = dataclasses.replace(cfg, coarse_weight=0.0, fine_weight=0.0)
    num_pose_steps = cfg.num_steps if cfg.coarse_weight + cfg.fine_weight > 0 else 0
    return [(pose, num_pose_steps), (evidence, cfg.num_evidence_steps if cfg.evidence_weight > 0 else 0)]


def train(cfg: TrainConfig, out: Path, reporter: Reporter) -> tuple[delo.Model, list[GapErrors]]:
    """Train a model; a run that was interrupted goes on from its last checkpoint.

    Args:
        cfg: the run.
        out: folder for worlds and checkpoints.
        reporter: progress.

    Returns:
        The model and its errors on the validation worlds.
    """
    mesh = jax.make_mesh((jax.local_device_count(),), ("batch",), axis_types=(jax.sharding.AxisType.Auto,))
    if cfg.batch_size % mesh.size:
        raise ConfigError(f"batch_size: expected a multiple of the {mesh.size} local devices, got {cfg.batch_size}")
    with Checkpoints(out / "checkpoints", cfg) as checkpoints:
        reporter.start("simulating training worlds", cfg.num_scenes)
        training = list(worlds(cfg, out / "worlds", validation=False, on_world=reporter.advance))
        reporter.start("simulating validation worlds", cfg.num_validation_scenes)
        held_out = list(worlds(cfg, out / "worlds", validation=True, on_world=reporter.advance))
        params = delo.init(cfg.model, jax.random.key(cfg.seed)).variables
        first = 0
        for phase_cfg, num_steps in phases(cfg):
            if num_steps:
                params = _run_phase(phase_cfg, num_steps, first, params, training, held_out, mesh, checkpoints, reporter)
            first += num_steps
    model = delo.Model(jax.device_get(params), cfg.model)
    return model, validate(model, held_out)


def _run_phase(cfg, num_steps, first, params, training, held_out, mesh, checkpoints, reporter) -> Any:
    """Steps `first` to `first + num_steps` with a fresh optimiser; returns the params."""
    tx = make_optimizer(cfg, num_steps)
    train_step = make_train_step(cfg, tx)
    state = TrainState(params, tx.init(params), jnp.asarray(first, jnp.int32))
    state = checkpoints.restore(state, first, first + num_steps)
    done = int(state.step)
    state = jax.device_put(state, NamedSharding(mesh, PartitionSpec()))
    reporter.start("learning evidence" if cfg.evidence_weight else "learning poses", num_steps, done - first)
    try:
        for batch in _batches(cfg, training, mesh, done, first + num_steps):
            state, metrics = train_step(state, batch)
            done += 1
            loss = float(metrics["loss"])
            if not np.isfinite(loss):
                raise ConfigError(f"step {done}: expected a finite loss, got {loss}; lower learning_rate")
            reporter.advance(f"loss {loss:.3f}")
            if done % cfg.validate_every == 0 or done == first + num_steps:
                checkpoints.save(done, state)
                reporter.validated(done, validate(delo.Model(state.params, cfg.model), held_out))
    except KeyboardInterrupt:
        if not any(leaf.is_deleted() for leaf in jax.tree.leaves(state)):  # else it came within a step, which had taken the old state
            checkpoints.save(int(state.step), state)
        raise
    return state.params


def _batches(cfg: TrainConfig, training: list[World], mesh: Mesh, start: int, stop: int) -> Iterator[PairBatch]:
    """Batches of steps `start` to `stop`, made one ahead in a thread; batch number i is the same in every run."""
    sharding = NamedSharding(mesh, PartitionSpec("batch"))

    def make(step: int) -> PairBatch:
        batch = make_batch(training, cfg.batch_size, np.random.default_rng((cfg.seed, step)), evidence=cfg.evidence_weight > 0)
        return jax.device_put(batch, sharding)

    with ThreadPoolExecutor(1) as pool:
        ahead = pool.submit(make, start)
        for step in range(start, stop):
            batch = ahead.result()
            ahead = pool.submit(make, min(step + 1, stop))
            yield batch


class Checkpoints:
    """The last two states of a run (orbax), kept apart by the config they belong to."""

    def __init__(self, folder: Path, cfg: TrainConfig):
        import orbax.checkpoint as ocp  # seconds to import, and needed here only

        from delo_jax.config import to_toml

        folder.mkdir(parents=True, exist_ok=True)
        note, text = folder / "config.toml", to_toml(cfg)
        if note.exists() and note.read_text() != text:
            raise ConfigError(f"{folder}: expected checkpoints of this config, got those of another; choose another --out or delete it")
        note.write_text(text)
        self._ocp = ocp
        self._manager = ocp.CheckpointManager(folder.resolve(), options=ocp.CheckpointManagerOptions(max_to_keep=2))

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, *_exc) -> None:
        self._manager.wait_until_finished()
        self._manager.close()

    def save(self, step: int, state: TrainState) -> None:
        """Store the state after `step` steps."""
        if step not in self._manager.all_steps():
            self._manager.save(step, args=self._ocp.args.StandardSave(jax.device_get(state)))

    def restore(self, state: TrainState, first: int, last: int) -> TrainState:
        """The newest stored state with first < step <= last; only its params when a later phase has begun; else `state`."""
        latest = self._manager.latest_step()
        if latest is None or latest <= first:
            return state
        stored = self._manager.restore(latest, args=self._ocp.args.StandardRestore(jax.device_get(state)))
        stored = TrainState(*stored) if not isinstance(stored, TrainState) else stored
        if latest > last:  # this phase is over
            return TrainState(stored.params, state.opt_state, jnp.asarray(last, jnp.int32))
        return jax.tree.map(jnp.asarray, stored)
