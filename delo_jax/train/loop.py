"""The training run: worlds, two phases of steps, validation, checkpoints that resume."""

import dataclasses
import logging
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from delo_jax.config import TrainConfig
from delo_jax.errors import ConfigError
from delo_jax.model import delo
from delo_jax.train.pairs import make_batch
from delo_jax.train.recorded import count_recorded, recorded_worlds
from delo_jax.train.step import PairBatch, TrainState, make_optimizer, make_train_step, start
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


def phases(cfg: TrainConfig, num_pose_steps: int) -> list[tuple[TrainConfig, int]]:
    """(weights of the losses, number of steps): matching and pose, then the evidence of the finished solver.

    With `num_evidence_steps` 0 there is one phase, and evidence is learned together with the pose. A phase whose
    weights are all 0 has no steps.
    """
    solver_weight = cfg.matching_weight + cfg.fine_weight + cfg.odometry_weight
    if cfg.num_evidence_steps == 0:
        return [(cfg, num_pose_steps if solver_weight + cfg.evidence_weight > 0 else 0)]
    pose = dataclasses.replace(cfg, evidence_weight=0.0)
    evidence = dataclasses.replace(cfg, matching_weight=0.0, fine_weight=0.0, odometry_weight=0.0)
    return [(pose, num_pose_steps if solver_weight > 0 else 0), (evidence, cfg.num_evidence_steps if cfg.evidence_weight > 0 else 0)]


def count_steps(cfg: TrainConfig, training: list[World]) -> int:
    """Steps of matching and pose: `num_steps`, or those of `num_epochs` passes over all frames that have a successor."""
    if not cfg.num_epochs:
        return cfg.num_steps
    num_pairs = sum(len(world.Ts_world_lidar) - 1 for world in training)
    return cfg.num_epochs * max(num_pairs // cfg.batch_size, 1)


def train(cfg: TrainConfig, out: Path, reporter: Reporter, data: Path | None = None) -> tuple[delo.Model, list[GapErrors], int]:
    """Train a model; a run that was interrupted goes on from its last checkpoint.

    Args:
        cfg: the run.
        out: folder for worlds and checkpoints.
        reporter: progress.
        data: a KITTI odometry tree with the sequences of `cfg.recorded`; None where that is empty.

    Returns:
        The model, its errors on the validation worlds, and the number of steps left out because they were not finite.
    """
    mesh = _mesh(cfg)
    _check_data(cfg, data)
    with Checkpoints(out / "checkpoints", cfg) as checkpoints:
        training, held_out = load_worlds(cfg, out / "worlds", reporter, data)
        model, num_nonfinite = _fit(cfg, training, held_out, delo.init(cfg.model, jax.random.key(cfg.seed)), mesh, checkpoints, reporter)
    return model, validate(model, held_out), num_nonfinite


def fit(cfg: TrainConfig, training: list[World], held_out: list[World], start_from: delo.Model, out: Path, reporter: Reporter):
    """The same on worlds at hand, from given weights, without the validation at the end; returns model and steps left out."""
    with Checkpoints(out / "checkpoints", cfg) as checkpoints:
        return _fit(cfg, training, held_out, start_from, _mesh(cfg), checkpoints, reporter)


def _mesh(cfg: TrainConfig) -> Mesh:
    """All local devices, over which the batch is spread."""
    mesh = jax.make_mesh((jax.local_device_count(),), ("batch",), axis_types=(jax.sharding.AxisType.Auto,))
    if cfg.batch_size % mesh.size:
        raise ConfigError(f"batch_size: expected a multiple of the {mesh.size} local devices, got {cfg.batch_size}")
    return mesh


def _fit(cfg, training, held_out, start_from, mesh, checkpoints, reporter) -> tuple[delo.Model, int]:
    """All phases; returns the model and the number of steps left out."""
    variables, first, num_nonfinite = jax.tree.map(jnp.copy, start_from.variables), 0, 0  # a step takes its state's memory
    for phase_cfg, num_steps in phases(cfg, count_steps(cfg, training)):
        if num_steps:
            counts = first, num_nonfinite
            state = _run_phase(phase_cfg, num_steps, counts, variables, training, held_out, mesh, checkpoints, reporter)
            variables, num_nonfinite = state.variables, int(state.num_nonfinite)
        first += num_steps
    if num_nonfinite:
        log.warning("%d of %d steps were left out: loss or gradient was not finite", num_nonfinite, first)
    return delo.Model(jax.device_get(variables), cfg.model), num_nonfinite


def _check_data(cfg: TrainConfig, data: Path | None) -> None:
    """Raise where the sequences and their tree do not fit, before anything is written."""
    if bool(cfg.recorded.split()) != (data is not None):
        raise ConfigError("recorded: expected sequence names exactly when there is a tree of recorded data; give both or neither")
    if data is not None:
        count_recorded(data, cfg.recorded.split(), validation=False)


def load_worlds(cfg: TrainConfig, folder: Path, reporter: Reporter, data: Path | None) -> tuple[list[World], list[World]]:
    """Training and validation worlds, simulated or recorded."""
    names, both = cfg.recorded.split(), []
    for validation, what in ((False, "training"), (True, "validation")):
        if data is not None:
            reporter.start(f"reading {what} scans", count_recorded(data, names, validation=validation))
            found = recorded_worlds(data, names, cfg.model.preprocess, folder, validation=validation, on_world=reporter.advance)
        else:
            reporter.start(f"simulating {what} worlds", cfg.num_validation_scenes if validation else cfg.num_scenes)
            found = worlds(cfg, folder, validation=validation, on_world=reporter.advance)
        both.append(list(found))
    return both[0], both[1]


def _run_phase(cfg, num_steps, counts, variables, training, held_out, mesh, checkpoints, reporter) -> TrainState:
    """`num_steps` steps with a fresh optimiser; returns the last state. `counts`: steps before, and how many were left out."""
    tx, first = make_optimizer(cfg, num_steps), counts[0]
    train_step = make_train_step(cfg, tx)
    state = checkpoints.restore(start(variables, tx, *counts), first, first + num_steps)
    done = int(state.step)
    state = jax.device_put(state, NamedSharding(mesh, PartitionSpec()))
    solver_weight = cfg.matching_weight + cfg.fine_weight + cfg.odometry_weight
    reporter.start("learning poses" if solver_weight else "learning evidence", num_steps, done - first)
    try:
        for batch in _batches(cfg, training, mesh, done, first + num_steps):
            state, metrics = train_step(state, batch)
            done += 1
            num_nonfinite = int(state.num_nonfinite)
            _check_health(done, num_nonfinite)
            reporter.advance(f"loss {float(metrics['loss']):.3f}" + (f", {num_nonfinite} not finite" if num_nonfinite else ""))
            if done % cfg.validate_every == 0 or done == first + num_steps:
                checkpoints.save(done, state)
                if held_out:
                    reporter.validated(done, validate(delo.Model(state.variables, cfg.model), held_out))
    except KeyboardInterrupt:
        if not any(leaf.is_deleted() for leaf in jax.tree.leaves(state)):  # else it came within a step, which had taken the old state
            checkpoints.save(int(state.step), state)
        raise
    return state


def _check_health(step: int, num_nonfinite: int) -> None:
    """Raise once more than a tenth of the steps, and more than ten, were not finite."""
    if num_nonfinite > max(10, step // 10):
        what = f"{num_nonfinite} of {step} with a loss or gradient that is not finite"
        raise ConfigError(f"step {step}: expected finite steps, got {what}; lower learning_rate")


def _batches(cfg: TrainConfig, training: list[World], mesh: Mesh, start: int, stop: int) -> Iterator[PairBatch]:
    """Batches of steps `start` to `stop`, made one ahead in a thread; batch number i is the same in every run."""
    sharding = NamedSharding(mesh, PartitionSpec("batch"))

    def make(step: int) -> PairBatch:
        with_failures = cfg.matching_weight + cfg.fine_weight + cfg.odometry_weight == 0  # a pose is not learned from invented truth
        batch = make_batch(training, cfg, np.random.default_rng((cfg.seed, step)), evidence=with_failures)
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
            return TrainState(stored.variables, state.opt_state, jnp.asarray(last, jnp.int32), stored.num_nonfinite)
        return jax.tree.map(jnp.asarray, stored)
