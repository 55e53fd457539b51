"""Checkpoints and resumption of the training run, on the exact step."""

import dataclasses

import pytest

from delo_jax.errors import ConfigError
from delo_jax.train import loop
from tests.train.exact_step import CFG, Reporter, as_bytes, failing_at, stand_ins

__all__ = ["stand_ins"]  # a fixture
pytestmark = pytest.mark.usefixtures("stand_ins")


def test_left_out_steps_are_counted_across_an_interruption(tmp_path, monkeypatch):
    """Oracle: the count of the run that nobody interrupted."""
    monkeypatch.setattr(loop, "make_train_step", failing_at({2, 4, 12}))
    _, _, expected = loop.train(CFG, tmp_path / "whole", Reporter())
    for stop_after in (7, 9):  # within the first phase, within the second
        with pytest.raises(KeyboardInterrupt):
            loop.train(CFG, tmp_path / "other", Reporter(stop_after))
    _, _, found = loop.train(CFG, tmp_path / "other", Reporter())
    assert found == expected == 3


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
    found, _, _ = loop.train(CFG, tmp_path, second)
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
    first, _, _ = loop.train(CFG, tmp_path, Reporter())
    reporter = Reporter()
    again, _, _ = loop.train(CFG, tmp_path, reporter)
    assert as_bytes(again) == as_bytes(first)
    assert reporter.notes == []
    assert reporter.pieces[-2:] == [("learning poses", 11, 11), ("learning evidence", 10, 10)]


def test_checkpoints_of_another_config_are_refused(tmp_path):
    """Oracle: the sentence; training goes on from what it was, or not at all."""
    loop.train(CFG, tmp_path, Reporter())
    other = dataclasses.replace(CFG, learning_rate=1e-3)
    with pytest.raises(ConfigError, match="checkpoints: expected checkpoints of this config, got those of another; choose another --out"):
        loop.train(other, tmp_path, Reporter())
