"""Stands in for the network's step in tests of the training run: exact, fast, and any slip of the run changes it for good."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from delo_jax.model import delo
from delo_jax.train import loop
from delo_jax.train.step import TrainState
from tests.fixtures import TINY_TRAINING, street_world, tiny_model

CFG = dataclasses.replace(TINY_TRAINING, num_steps=11, num_evidence_steps=10, validate_every=4, num_frames=3, batch_size=1)


class Reporter:
    """Writes everything down; raises what it is told to after so many steps."""

    def __init__(self, stop_after=None, error=KeyboardInterrupt):
        self.pieces, self.notes, self.validations = [], [], []
        self._stop_after, self._error = stop_after, error

    def start(self, what, total, done=0):
        self.pieces.append((what, total, done))

    def advance(self, note=""):
        self.notes += [note] if note else []
        if self._stop_after is not None and len(self.notes) == self._stop_after:
            raise self._error

    def validated(self, step, errors):
        self.validations.append(step)


@pytest.fixture
def stand_ins(monkeypatch):
    """Two street worlds, no validation, weights made before, and a step that any slip would change for good.

    It depends on the batch, on the optimiser's memory and on the phase, and forgets nothing.
    """

    def make_train_step(cfg, tx):
        phase = 1.0 if cfg.evidence_weight else -1.0

        def train_step(state, batch):
            pull = phase * jnp.mean(batch.T_init) + jnp.sum(batch.source.points) * 1e-3 + state.step
            params = state.variables["params"]
            updates, opt_state = tx.update(jax.tree.map(lambda leaf: leaf + pull, params), state.opt_state, params)
            variables = {
                "params": optax.apply_updates(params, updates),
                "batch_stats": {"mean": state.variables["batch_stats"]["mean"] + pull},
            }
            return TrainState(variables, opt_state, state.step + 1, state.num_nonfinite), {"loss": pull}

        return jax.jit(train_step, donate_argnums=0)

    def worlds(cfg, folder, *, validation, on_world):
        for _ in range(cfg.num_validation_scenes if validation else cfg.num_scenes):
            yield street_world(cfg.model.preprocess, cfg.num_frames)
            on_world()

    monkeypatch.setattr(loop, "make_train_step", make_train_step)
    monkeypatch.setattr(loop, "worlds", worlds)
    monkeypatch.setattr(loop, "validate", lambda model, held_out: [])
    params = {"a": jnp.ones(3), "b": {"c": jnp.arange(4.0)}}
    weights = delo.Model({"params": params, "batch_stats": {"mean": jnp.zeros(2)}}, tiny_model().cfg)
    monkeypatch.setattr(delo, "init", lambda cfg, key: delo.Model(jax.tree.map(jnp.array, weights.variables), cfg))


def as_bytes(model):
    return b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(model))


def failing_at(steps):
    """A stand-in that leaves out these steps and counts them, as the real one does."""
    make_train_step = loop.make_train_step

    def make_failing(cfg, tx):
        train_step = make_train_step(cfg, tx)

        def failing(state, batch):
            if int(state.step) in steps:
                return state._replace(step=state.step + 1, num_nonfinite=state.num_nonfinite + 1), {"loss": jnp.float32(np.nan)}
            return train_step(state, batch)

        return failing

    return make_failing
