"""Pairs per second of training: the input pipeline on the host, the train step on the device."""

from dataclasses import replace

import jax
import numpy as np

from delo_jax.bench.rows import Group, LeftOut, TooMuch
from delo_jax.model import delo
from delo_jax.train.pairs import make_batch
from delo_jax.train.presets import PRESETS
from delo_jax.train.step import make_optimizer, make_train_step, start
from delo_jax.train.worlds import VALIDATION_SEED, World, make_world

BATCH = {"tiny": 4, "base": 4, "paper": 2}  # pairs of a step, fewer than a training takes
NUM_FRAMES, NUM_STEPS = 3, 100


def training_world(preset: str) -> World:
    """A small world for a preset."""
    return make_world(0, seed=VALIDATION_SEED, num_frames=NUM_FRAMES, cfg=PRESETS[preset].model.preprocess)


def measure_training(preset: str, world: World, group: Group) -> list[LeftOut]:
    """Adds input pipeline and train step at the preset's own sizes; returns what was left out, and why.

    Args:
        preset: name of the training run.
        world: of `training_world`.
        group: takes the rows.
    """
    cfg, rng = replace(PRESETS[preset], batch_size=BATCH[preset]), np.random.default_rng(0)
    group.product()
    batch = group.host("input pipeline", lambda: make_batch([world], cfg, rng), batch=cfg.batch_size)
    tx = make_optimizer(cfg, NUM_STEPS)
    state = start(delo.init(cfg.model, jax.random.key(0)).variables, tx)
    try:
        group.chained("train step", make_train_step(cfg, tx), state, jax.device_put(batch), batch=cfg.batch_size)
    except TooMuch as stop:
        return [LeftOut(group.name, str(stop))]
    return []
