"""The training run: phases, steps, data, what is left out. The network's own step has its tests; here an exact one stands in."""

import dataclasses
import logging
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from delo_jax.errors import ConfigError
from delo_jax.model import delo
from delo_jax.train import loop
from delo_jax.train.presets import PRESETS
from tests.fixtures import street_world
from tests.train.exact_step import CFG, Reporter, as_bytes, failing_at, stand_ins

__all__ = ["stand_ins"]  # a fixture
pytestmark = pytest.mark.usefixtures("stand_ins")


def test_run_goes_through_its_pieces(tmp_path):
    """Oracle: the config, by hand: two phases; validation and checkpoint every fourth step and at the end of a phase."""
    reporter = Reporter()
    model, errors, num_nonfinite = loop.train(CFG, tmp_path, reporter)
    assert (model.cfg, errors, num_nonfinite) == (CFG.model, [], 0)
    assert reporter.pieces == [
        ("simulating training worlds", 2, 0),
        ("simulating validation worlds", 1, 0),
        ("learning poses", 11, 0),
        ("learning evidence", 10, 0),
    ]
    assert len(reporter.notes) == 21
    assert all(note.startswith("loss ") for note in reporter.notes)
    assert reporter.validations == [4, 8, 11, 12, 16, 20, 21]


def test_fit_starts_from_given_weights_and_leaves_them(tmp_path):
    """Oracle: repetition from the same weights gives the same bytes; nothing is validated without worlds to do it on."""
    worlds = [street_world(CFG.model.preprocess, CFG.num_frames)]
    begin, reporter = delo.init(CFG.model, jax.random.key(0)), Reporter()
    before = as_bytes(begin)
    runs = [loop.fit(CFG, worlds, [], begin, tmp_path / str(number), reporter) for number in range(2)]
    assert as_bytes(begin) == before
    assert as_bytes(runs[0][0]) == as_bytes(runs[1][0]) != before
    assert [num_nonfinite for _, num_nonfinite in runs] == [0, 0]
    assert reporter.validations == []


def test_phases_switch_the_losses():
    """Oracle: by hand; first all but the evidence, then the evidence alone."""
    (pose, num_pose), (evidence, num_evidence) = loop.phases(CFG, 11)
    assert (num_pose, num_evidence) == (11, 10)
    assert (pose.matching_weight, pose.fine_weight, pose.evidence_weight) == (CFG.matching_weight, CFG.fine_weight, 0.0)
    assert (evidence.matching_weight, evidence.fine_weight, evidence.evidence_weight) == (0.0, 0.0, CFG.evidence_weight)


def test_evidence_learned_together_is_one_phase():
    """Oracle: by hand; the paper's loss of everything at once, for all steps of the run."""
    paper = PRESETS["paper"]
    assert loop.phases(paper, 1234) == [(paper, 1234)]
    apart = dataclasses.replace(paper, num_evidence_steps=20)
    (pose, num_pose), (evidence, num_evidence) = loop.phases(apart, 1234)
    assert (num_pose, num_evidence) == (1234, 20)
    assert (pose.odometry_weight, pose.evidence_weight) == (1.0, 0.0)
    assert (evidence.odometry_weight, evidence.evidence_weight) == (0.0, 1.0)


def test_epochs_are_counted_in_frames_that_have_a_successor():
    """Oracle: by hand; worlds of 6 and 5 frames hold 5 + 4 of them, in batches of 2 that is 4 steps an epoch."""
    worlds = [street_world(CFG.model.preprocess), street_world(CFG.model.preprocess, 5)]
    cfg = dataclasses.replace(CFG, num_steps=11, batch_size=2)
    assert loop.count_steps(cfg, worlds) == 11
    assert loop.count_steps(dataclasses.replace(cfg, num_epochs=75), worlds) == 75 * 4
    assert loop.count_steps(dataclasses.replace(cfg, num_epochs=3, batch_size=16), worlds) == 3  # at least one step an epoch


def test_joint_run_of_epochs(tmp_path):
    """Oracle: by hand; one phase of 5 epochs of 4 steps: two worlds of 3 frames, one pair a step."""
    reporter = Reporter()
    loop.train(dataclasses.replace(CFG, num_epochs=5, num_steps=0, num_evidence_steps=0), tmp_path, reporter)
    assert reporter.pieces[2:] == [("learning poses", 20, 0)]
    assert reporter.validations == [4, 8, 12, 16, 20]


@pytest.mark.parametrize(
    ("weights", "pieces", "num_steps"),
    [
        ({"fine_weight": 0.0}, [("learning poses", 11, 0), ("learning evidence", 10, 0)], 21),
        ({"matching_weight": 0.0}, [("learning poses", 11, 0), ("learning evidence", 10, 0)], 21),
        ({"matching_weight": 0.0, "fine_weight": 0.0}, [("learning evidence", 10, 0)], 10),
        ({"evidence_weight": 0.0}, [("learning poses", 11, 0)], 11),
        ({"matching_weight": 0.0, "fine_weight": 0.0, "evidence_weight": 0.0}, [], 0),
    ],
)
def test_phase_without_a_loss_is_left_out(tmp_path, weights, pieces, num_steps):
    """Oracle: by hand; nothing is learned where every weight is 0."""
    reporter = Reporter()
    loop.train(dataclasses.replace(CFG, **weights), tmp_path, reporter)
    assert reporter.pieces[2:] == pieces
    assert len(reporter.notes) == num_steps


def test_steps_left_out_are_counted_and_reported(tmp_path, monkeypatch, caplog):
    """Oracle: by hand; the third and fifth of the first phase, the second of the second phase."""
    monkeypatch.setattr(loop, "make_train_step", failing_at({2, 4, 12}))
    reporter = Reporter()
    with caplog.at_level(logging.WARNING, loop.__name__):
        _, _, num_nonfinite = loop.train(CFG, tmp_path, reporter)
    assert num_nonfinite == 3
    assert len(reporter.notes) == 21
    counts = [int(note.split(", ")[1].split()[0]) if "," in note else 0 for note in reporter.notes]
    assert counts == [0, 0, 1, 1] + [2] * 8 + [3] * 9
    assert reporter.notes[4].endswith(", 2 not finite")
    assert [record.getMessage() for record in caplog.records] == ["3 of 21 steps were left out: loss or gradient was not finite"]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(loop.train(CFG, tmp_path, Reporter())[0]))


def test_training_that_goes_nowhere_stops(tmp_path, monkeypatch):
    """Oracle: the sentence; ten steps may fail whenever they like, of more a tenth. The next run goes on from the last checkpoint."""
    cfg = dataclasses.replace(CFG, num_steps=40, num_evidence_steps=0, validate_every=30)
    reporter = Reporter()
    with monkeypatch.context() as patch:
        patch.setattr(loop, "make_train_step", failing_at(range(20, 40)))
        with pytest.raises(ConfigError, match="step 31: expected finite steps, got 11 of 31 with a loss or gradient that is not fin"):
            loop.train(cfg, tmp_path, reporter)
    assert (len(reporter.notes), reporter.validations) == (30, [30])
    second = Reporter()
    _, _, num_nonfinite = loop.train(cfg, tmp_path, second)
    assert second.pieces[2] == ("learning poses", 40, 30)
    assert num_nonfinite == 10


@pytest.mark.parametrize(
    ("num_nonfinite", "num_done", "healthy"), [(10, 10, True), (11, 109, False), (11, 110, True), (120, 1200, True), (121, 1200, False)]
)
def test_a_tenth_of_the_steps_may_fail(num_nonfinite, num_done, healthy):
    """Oracle: the documented limit, by hand."""
    if healthy:
        loop._check_health(num_done, num_nonfinite)
    else:
        with pytest.raises(ConfigError, match="lower learning_rate"):
            loop._check_health(num_done, num_nonfinite)


@pytest.mark.parametrize(("recorded", "data"), [("00 01", False), ("", True)])
def test_sequences_and_their_tree_come_together(tmp_path, recorded, data):
    """Oracle: the sentence."""
    with pytest.raises(ConfigError, match="recorded: expected sequence names exactly when there is a tree of recorded data; give both"):
        loop.train(dataclasses.replace(CFG, recorded=recorded), tmp_path / "out", Reporter(), tmp_path if data else None)
    assert not (tmp_path / "out").exists()


def test_recorded_worlds_are_what_is_trained_on(tmp_path, monkeypatch):
    """Oracle: the calls; names, tree and both parts of every sequence, and no simulation."""
    calls = []

    def recorded_worlds(root, names, cfg, folder, *, validation, on_world):
        calls.append((root, names, cfg, folder, validation))
        yield street_world(cfg, 3)
        on_world()

    monkeypatch.setattr(loop, "recorded_worlds", recorded_worlds)
    monkeypatch.setattr(loop, "count_recorded", lambda root, names, *, validation: 1)
    monkeypatch.delattr(loop, "worlds")
    reporter, tree = Reporter(), tmp_path / "tree"
    loop.train(dataclasses.replace(CFG, recorded="00 07"), tmp_path, reporter, tree)
    expected = tree, ["00", "07"], CFG.model.preprocess, tmp_path / "worlds"
    assert calls == [(*expected, False), (*expected, True)]
    assert reporter.pieces[:2] == [("reading training scans", 1, 0), ("reading validation scans", 1, 0)]


def test_batch_that_does_not_divide_over_the_devices(tmp_path, monkeypatch):
    """Oracle: the sentence, before anything is simulated or written."""
    monkeypatch.setattr(jax, "make_mesh", lambda *_, **__: SimpleNamespace(size=2))
    reporter = Reporter()
    with pytest.raises(ConfigError, match="batch_size: expected a multiple of the 2 local devices, got 1"):
        loop.train(CFG, tmp_path / "out", reporter)
    assert reporter.pieces == []
    assert not (tmp_path / "out").exists()


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
    model, errors, _ = loop.train(cfg, tmp_path, Reporter())
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model))
    assert [row.gap for row in errors] == [1]
    assert np.isfinite(errors[0].median_cm)
