"""`delo train` on recorded sequences."""

import dataclasses
import sys
import tomllib
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from delo_jax import config, weights
from delo_jax.data import KittiTreeWriter
from delo_jax.inference import odometry
from delo_jax.train.presets import PRESETS
from tests.fixtures import narrow
from tests.oracles import street

NUM_SCANS = 20  # 9 to train on, 5 in between, 6 held out


def points(index):
    return street.scan(street.pose(0.5 * index - 8.0, yaw_deg=index), num_rings=16, num_columns=240).points


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """A KITTI tree of two drives along the street."""
    root = tmp_path_factory.mktemp("recordings")
    for name in ("00", "01"):
        with KittiTreeWriter(root, name) as writer:
            for index in range(NUM_SCANS):
                writer.append(points(index), street.pose(0.5 * index - 8.0, yaw_deg=index))
    return root


def test_sequences_are_part_of_the_config(cli, recordings):
    """Oracle: the preset, and the names as given; seven sequences when none are."""
    done = cli("train", "paper", "--data", recordings, "--sequences", "00", "01", "--dump-config")
    assert done.code == 0
    assert config.from_dict(config.TrainConfig, tomllib.loads(done.out)) == dataclasses.replace(PRESETS["paper"], recorded="00 01")
    default = tomllib.loads(cli("train", "paper", "--data", recordings, "--dump-config").out)
    assert default["recorded"] == "00 01 02 03 04 05 06"
    assert tomllib.loads(cli("train", "paper", "--dump-config").out)["recorded"] == ""


def test_sequences_of_a_config_stand_unless_others_are_named(cli, recordings, tmp_path):
    """Oracle: the order option, file, default; sequences without a tree are refused with one sentence."""
    text = config.to_toml(dataclasses.replace(PRESETS["paper"], recorded="01"))
    (tmp_path / "config.toml").write_text(text)
    for options, expected in (((), "01"), (("--sequences", "00"), "00")):
        done = cli("train", tmp_path / "config.toml", "--data", recordings, *options, "--dump-config")
        assert tomllib.loads(done.out)["recorded"] == expected
    alone = cli("train", "paper", "--sequences", "00", "--dump-config")
    assert alone.code == 2
    assert "--sequences: expected a tree to find them in, got none; add --data DIR" in alone.err


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_can_be_named(preset, cli):
    """Oracle: the table of presets."""
    done = cli("train", preset, "--dump-config")
    assert config.from_dict(config.TrainConfig, tomllib.loads(done.out)) == PRESETS[preset]


def test_unknown_sequence_is_one_sentence_and_leaves_nothing(cli, recordings, tmp_path):
    """Oracle: the sentence, exit code 2; the command with the right name is not refused for what the wrong one left."""
    done = cli("train", "paper", "--data", recordings, "--sequences", "00", "02", "--out", tmp_path / "out")
    assert done.code == 2
    assert done.err.strip().startswith("delo: ")  # after the line of the bars
    assert done.err.strip().endswith("expected a sequence '02', got 00, 01; name one of these")
    assert done.err.strip().count("\n") == 0
    assert not (tmp_path / "out").exists()


def test_names_without_a_tree_are_one_sentence(cli, tmp_path):
    """Oracle: the sentence, exit code 2."""
    (tmp_path / "my.toml").write_text(config.to_toml(dataclasses.replace(PRESETS["paper"], recorded="00")))
    done = cli("train", tmp_path / "my.toml", "--out", tmp_path / "out")
    assert done.code == 2
    assert "recorded: expected sequence names exactly when there is a tree" in done.err


def test_card_tells_of_the_recordings(cli, monkeypatch, tmp_path, recordings, weights_file):
    """Oracle: a training that is told by hand: what it was called with, and what a card must say of recorded data."""
    calls = []

    def learn(cfg, out, reporter, data):
        calls.append((cfg, out, data))
        return weights.load(weights_file), [], 0

    monkeypatch.setitem(sys.modules, "delo_jax.train.loop", SimpleNamespace(train=learn))
    out = tmp_path / "out"
    assert cli("train", "paper", "--data", recordings, "--sequences", "01", "--out", out).code == 0
    assert calls == [(dataclasses.replace(PRESETS["paper"], recorded="01"), out, recordings)]
    card = weights.read_card(out / "delo-paper.safetensors")
    assert card["data"] == "recorded sequences 01, the last tenth of each for validation, KITTI's elevation lifted by 0.205 deg"
    assert card["license"] == "that of the recorded data"
    assert card["seeds"] == {"base": 0}
    assert card["training"]["recorded"] == "01"
    assert card["commands"] == [f"delo train paper --out {out} --data {recordings} --sequences 01"]


@pytest.mark.slow
def test_narrow_paper_preset_trains_on_recordings(cli, tmp_path, recordings):
    """Oracle: ten steps by hand (a config from TOML), finite weights that load again, and a pose of two scans of the drive."""
    cfg = dataclasses.replace(narrow("paper"), num_epochs=0, num_steps=10, validate_every=10)
    (tmp_path / "narrow.toml").write_text(config.to_toml(cfg))
    done = cli("train", tmp_path / "narrow.toml", "--data", recordings, "--sequences", "00", "01", "--out", tmp_path / "out")
    assert done.code == 0, done.err
    assert "unseen worlds after 10 steps" in done.out
    model = weights.load(tmp_path / "out" / "delo-paper.safetensors")
    assert model.cfg == cfg.model
    assert model.variables.keys() == {"params", "batch_stats"}
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model))
    assert weights.read_card(tmp_path / "out" / "delo-paper")["steps left out as not finite"] == 0
    estimate = odometry(model, points(0), points(1))
    assert np.isfinite(estimate.T_target_source).all()
