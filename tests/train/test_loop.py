"""The training run: phases, checkpoints, resumption. The network's own step has its tests; here an exact one stands in."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from delo_jax.errors import ConfigError
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


@pytest.fixture(autouse=True)
def stand_ins(monkeypatch):
    """Two street worlds, no validation, weights made before, and a step that any slip would change for good.

    It depends on the batch, on the optimiser's memory and on the phase, and forgets nothing.
    """

    def make_train_step(cfg, tx):
        phase = 1.0 if cfg.evidence_weight else -1.0

        def train_step(state, batch):
            pull = phase * jnp.mean(batch.T_init) + jnp.sum(batch.source.points) * 1e-3 + state.step
            gradients = jax.tree.map(lambda leaf: leaf + pull, state.params)
            updates, opt_state = tx.update(gradients, state.opt_state, state.params)
            return TrainState(optax.apply_updates(state.params, updates), opt_state, state.step + 1), {"loss": pull}

        return jax.jit(train_step, donate_argnums=0)

    def worlds(cfg, folder, *, validation, on_world):
        for _ in range(cfg.num_validation_scenes if validation else cfg.num_scenes):
            yield street_world(cfg.model.preprocess, cfg.num_frames)
            on_world()

    monkeypatch.setattr(loop, "make_train_step", make_train_step)
    monkeypatch.setattr(loop, "worlds", worlds)
    monkeypatch.setattr(loop, "validate", lambda model, held_out: [])
    weights = delo.Model({"params": {"a": jnp.ones(3), "b": {"c": jnp.arange(4.0)}}}, tiny_model().cfg)
    monkeypatch.setattr(delo, "init", lambda cfg, key: delo.Model(jax.tree.map(jnp.array, weights.variables), cfg))


def as_bytes(model):
    return b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(model))


def test_run_goes_through_its_pieces(tmp_path):
    """Oracle: the config, by hand: two phases; validation and checkpoint every fourth step and at the end of a phase."""
    reporter = Reporter()
    model, errors = loop.train(CFG, tmp_path, reporter)
    assert (model.cfg, errors) == (CFG.model, [])
    assert reporter.pieces == [
        ("simulating training worlds", 2, 0),
        ("simulating validation worlds", 1, 0),
        ("learning poses", 11, 0),
        ("learning evidence", 10, 0),
    ]
    assert len(reporter.notes) == 21
    assert all(note.startswith("loss ") for note in reporter.notes)
    assert reporter.validations == [4, 8, 11, 12, 16, 20, 21]


def test_phases_switch_the_losses():
    """Oracle: by hand; first all but the evidence, then the evidence alone."""
    (pose, num_pose), (evidence, num_evidence) = loop.phases(CFG)
    assert (num_pose, num_evidence) == (11, 10)
    assert (pose.coarse_weight, pose.fine_weight, pose.evidence_weight) == (CFG.coarse_weight, CFG.fine_weight, 0.0)
    assert (evidence.coarse_weight, evidence.fine_weight, evidence.evidence_weight) == (0.0, 0.0, CFG.evidence_weight)


@pytest.mark.parametrize(
    ("weights", "pieces", "num_steps"),
    [
        ({"fine_weight": 0.0}, [("learning poses", 11, 0), ("learning evidence", 10, 0)], 21),
        ({"coarse_weight": 0.0}, [("learning poses", 11, 0), ("learning evidence", 10, 0)], 21),
        ({"coarse_weight": 0.0, "fine_weight": 0.0}, [("learning evidence", 10, 0)], 10),
        ({"evidence_weight": 0.0}, [("learning poses", 11, 0)], 11),
        ({"coarse_weight": 0.0, "fine_weight": 0.0, "evidence_weight": 0.0}, [], 0),
    ],
)
def test_phase_without_a_loss_is_left_out(tmp_path, weights, pieces, num_steps):
    """Oracle: by hand; nothing is learned where every weight is 0."""
    reporter = Reporter()
    loop.train(dataclasses.replace(CFG, **weights), tmp_path, reporter)
    assert reporter.pieces[2:] == pieces
    assert len(reporter.notes) == num_steps


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_loss_that_is_no_number_stops_the_training(tmp_path, monkeypatch, value):
    """Oracle: the sentence; of the state that went wrong nothing is stored, the next run goes on from the last good one."""
    make_train_step = loop.make_train_step

    def make_failing(cfg, tx):
        train_step = make_train_step(cfg, tx)

        def failing(state, batch):
            number = int(state.step)
            state, metrics = train_step(state, batch)
            return state, {"loss": jnp.float32(value)} if number == 7 else metrics

        return failing

    reporter, second = Reporter(), Reporter()
    with monkeypatch.context() as patch:
        patch.setattr(loop, "make_train_step", make_failing)
        with pytest.raises(ConfigError, match=f"step 8: expected a finite loss, got {value}; lower learning_rate"):
            loop.train(CFG, tmp_path, reporter)
    assert (len(reporter.notes), reporter.validations) == (7, [4])
    loop.train(CFG, tmp_path, second)
    assert second.pieces[2] == ("learning poses", 11, 4)


def test_batch_that_does_not_divide_over_the_devices(tmp_path, monkeypatch):
    """Oracle: the sentence, before anything is simulated or written."""
    monkeypatch.setattr(jax, "make_mesh", lambda *_, **__: SimpleNamespace(size=2))
    reporter = Reporter()
    with pytest.raises(ConfigError, match="batch_size: expected a multiple of the 2 local devices, got 1"):
        loop.train(CFG, tmp_path / "out", reporter)
    assert reporter.pieces == []
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def whole_run():
    """Bytes of the run that nobody interrupted, made by the first test that asks."""
    return {}


def uninterrupted(whole_run, folder):
    if not whole_run:
        whole_run["bytes"] = as_bytes(loop.train(CFG, folder / "whole", Reporter())[0])
    return whole_run["bytes"]


@pytest.mark.parametrize(
    ("stop_after", "error"),
    [
        (1, KeyboardInterrupt),
        (8, KeyboardInterrupt),
        (11, KeyboardInterrupt),
        (18, KeyboardInterrupt),
        (8, RuntimeError),
        (18, RuntimeError),
    ],
)
def test_interrupted_run_ends_where_the_other_does(tmp_path, whole_run, stop_after, error):
    """Oracle: the run that nobody interrupted, byte by byte; Ctrl-C loses no step, a crash those since the last checkpoint."""
    with pytest.raises(error):
        loop.train(CFG, tmp_path, Reporter(stop_after, error))
    second = Reporter()
    found, _ = loop.train(CFG, tmp_path, second)
    assert as_bytes(found) == uninterrupted(whole_run, tmp_path)
    if error is KeyboardInterrupt:
        assert len(second.notes) == 21 - stop_after
    else:  # a step is reported before its checkpoint is written
        last = max(step for step in (0, 4, 8, 11, 12, 16, 20) if step < stop_after)
        assert len(second.notes) == 21 - last


@pytest.mark.parametrize("moment", ["within a step", "after a step"])
def test_ctrl_c_at_the_worst_moment(tmp_path, whole_run, monkeypatch, moment):
    """Oracle: the run that nobody interrupted. The step has taken the old state and not yet given the new one, or is not yet counted."""
    make_train_step = loop.make_train_step

    class Loss:
        def __float__(self):
            raise KeyboardInterrupt

    def make_interrupted(cfg, tx):
        train_step = make_train_step(cfg, tx)

        def interrupted(state, batch):
            number = int(state.step)
            state, metrics = train_step(state, batch)
            if number == 5 and moment == "within a step":
                raise KeyboardInterrupt
            return state, {"loss": Loss()} if number == 5 else metrics

        return interrupted

    with monkeypatch.context() as patch:
        patch.setattr(loop, "make_train_step", make_interrupted)
        with pytest.raises(KeyboardInterrupt):
            loop.train(CFG, tmp_path, Reporter())
    second = Reporter()
    assert as_bytes(loop.train(CFG, tmp_path, second)[0]) == uninterrupted(whole_run, tmp_path)
    assert second.pieces[2] == ("learning poses", 11, 4 if moment == "within a step" else 6)


def test_finished_run_is_only_read(tmp_path):
    """Oracle: the first run's weights; not one step more."""
    first, _ = loop.train(CFG, tmp_path, Reporter())
    reporter = Reporter()
    again, _ = loop.train(CFG, tmp_path, reporter)
    assert as_bytes(again) == as_bytes(first)
    assert reporter.notes == []
    assert reporter.pieces[-2:] == [("learning poses", 11, 11), ("learning evidence", 10, 10)]


def test_checkpoints_of_another_config_are_refused(tmp_path):
    """Oracle: the sentence; training goes on from what it was, or not at all."""
    loop.train(CFG, tmp_path, Reporter())
    other = dataclasses.replace(CFG, learning_rate=1e-3)
    with pytest.raises(ConfigError, match="checkpoints: expected checkpoints of this config, got those of another; choose another --out"):
        loop.train(other, tmp_path, Reporter())


def test_phase_without_steps_is_left_out(tmp_path):
    """Oracle: by hand; the weights are then those of the first phase."""
    cfg = dataclasses.replace(CFG, num_evidence_steps=0)
    reporter = Reporter()
    loop.train(cfg, tmp_path, reporter)
    assert [what for what, _, _ in reporter.pieces][2:] == ["learning poses"]
    assert len(reporter.notes) == 11


def test_seed_decides_the_run(tmp_path):
    """Oracle: repetition in another folder; another seed draws other batches."""
    runs = [as_bytes(loop.train(dataclasses.replace(CFG, seed=seed), tmp_path / str(k), Reporter())[0]) for k, seed in enumerate((0, 0, 1))]
    assert runs[0] == runs[1] != runs[2]


@pytest.mark.slow
def test_the_real_thing_runs_from_end_to_end(tmp_path, monkeypatch):
    """Oracle: finite errors at every gap of the worlds, on the network itself."""
    monkeypatch.undo()
    cfg = dataclasses.replace(CFG, num_scenes=1, num_steps=10, num_evidence_steps=10, validate_every=10, num_frames=2)
    monkeypatch.setattr(loop, "worlds", lambda cfg, folder, **_: iter([street_world(cfg.model.preprocess, cfg.num_frames)]))
    model, errors = loop.train(cfg, tmp_path, Reporter())
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model))
    assert [row.gap for row in errors] == [1]
    assert np.isfinite(errors[0].median_cm)
