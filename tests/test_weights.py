"""Weights: safetensors and a card, typed and hashed."""

import dataclasses
import hashlib
import json
import pickletools
import struct

import jax
import numpy as np
import pytest
from safetensors.numpy import load, save

from delo_jax import weights
from delo_jax.errors import DeloError, WeightsError
from delo_jax.model import delo
from tests.fixtures import TINY, tiny_model

CARD = {"data": "none", "seeds": [0], "commands": ["pytest"], "metrics": {"median_cm": 1.5}}


@pytest.fixture
def stored(tmp_path):
    return weights.save(tmp_path / "folder" / "tiny", tiny_model(), CARD)


def change_card(path, **changes):
    """Rewrites the card; a value of None removes its key."""
    card = json.loads(path.with_suffix(".json").read_text()) | changes
    path.with_suffix(".json").write_text(json.dumps({key: value for key, value in card.items() if value is not None}))


def replace_data(path, data):
    """Other bytes under a card that agrees with them."""
    path.write_bytes(data)
    change_card(path, sha256=hashlib.sha256(data).hexdigest())


def read_safetensors(data):
    """The format by hand: length of the header, header in JSON, then the arrays."""
    (length,) = struct.unpack("<Q", data[:8])
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    header.pop("__metadata__", None)
    assert {entry["dtype"] for entry in header.values()} == {"F32"}
    return {name: np.frombuffer(body[slice(*entry["data_offsets"])], "<f4").reshape(entry["shape"]) for name, entry in header.items()}


def test_round_trip_keeps_every_bit(stored):
    """Oracle: the model that was saved; no array changes, nor does the config."""
    model = weights.load(stored)
    assert model.cfg == TINY
    leaves, expected = (jax.tree_util.tree_leaves_with_path(m) for m in (model, tiny_model()))
    assert [path for path, _ in leaves] == [path for path, _ in expected]
    assert all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for (_, a), (_, b) in zip(leaves, expected, strict=True))


def test_numbers_of_a_drive_travel_with_the_weights(tmp_path, stored):
    """Oracle: what was saved; weights without them load too, and a missing number is noticed."""
    numbers = {name: np.float32(0.1 * k) for k, name in enumerate(delo.STREAM_NUMBERS)}
    model = dataclasses.replace(tiny_model(), variables=tiny_model().variables | {"stream": numbers})
    found = weights.load(weights.save(tmp_path / "with", model, {})).variables["stream"]
    assert {name: float(value) for name, value in found.items()} == {name: float(value) for name, value in numbers.items()}
    assert "stream" not in weights.load(stored).variables
    del numbers[delo.STREAM_NUMBERS[0]]
    with pytest.raises(WeightsError, match="stream/share"):
        weights.load(weights.save(tmp_path / "less", model, {}))


def test_file_is_plain_safetensors(stored):
    """Oracle: the format read by hand, and the names of the params; there is no pickle in it."""
    tensors = read_safetensors(stored.read_bytes())
    leaves = jax.tree_util.tree_leaves_with_path(tiny_model().variables)
    expected = {"/".join(key.key for key in path): leaf for path, leaf in leaves}
    assert tensors.keys() == expected.keys()
    assert all(np.array_equal(tensors[name], expected[name]) for name in expected)
    with pytest.raises(ValueError, match="opcode"):
        list(pickletools.genops(stored.read_bytes()))


def test_same_model_same_bytes(tmp_path):
    """Oracle: repetition."""
    first, second = (weights.save(tmp_path / name, tiny_model(), CARD) for name in ("a", "b.safetensors"))
    assert first.read_bytes() == second.read_bytes()
    assert first.with_suffix(".json").read_bytes() == second.with_suffix(".json").read_bytes()


def test_card_says_what_the_weights_are(stored):
    """Oracle: hashlib and the config."""
    card = weights.read_card(stored)
    assert card | CARD == card
    assert card["sha256"] == hashlib.sha256(stored.read_bytes()).hexdigest()
    assert card["config"] == dataclasses.asdict(TINY)


def test_a_flipped_bit_is_noticed(stored):
    """Oracle: SHA-256."""
    data = bytearray(stored.read_bytes())
    data[-1] ^= 1
    stored.write_bytes(data)
    with pytest.raises(WeightsError, match="tiny.safetensors: expected SHA-256 .*; the file is damaged, fetch it again"):
        weights.load(stored)


@pytest.mark.parametrize("keep", [0, 5, 300, -4])
def test_a_truncated_file_is_one_sentence(stored, keep):
    """Oracle: the sentence; the card agrees with the damaged bytes, so that the hash does not help."""
    replace_data(stored, stored.read_bytes()[:keep])
    with pytest.raises(WeightsError, match="tiny.safetensors: expected a safetensors file, got .*; fetch it again"):
        weights.load(stored)


@pytest.mark.parametrize("change", ["wider", "missing", "extra", "half"])
def test_arrays_of_another_network_are_refused(stored, change):
    """Oracle: the array that was changed is named."""
    tensors = load(stored.read_bytes())
    name = "params/encoder/descriptor/kernel"
    if change == "wider":
        tensors[name] = np.zeros((tensors[name].shape[0], 7), np.float32)
    elif change == "missing":
        del tensors[name]
    elif change == "extra":
        name = "params/other"
        tensors[name] = np.zeros(3, np.float32)
    else:
        tensors[name] = tensors[name].astype(np.float16)
    replace_data(stored, save(tensors))
    with pytest.raises(WeightsError, match=f"expected the arrays of preset 'tiny', got other shapes or types at {name}; use matching"):
        weights.load(stored)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "expected the model card of the weights, got .*; restore the file"),
        ("[1]", "expected format 1, got list; update"),
        ("{}", "expected format 1, got None; update"),
        ('{"format": 2}', "expected format 1, got 2; update delo-jax or the weights"),
    ],
)
def test_damaged_card_is_one_sentence(stored, content, message):
    """Oracle: the sentence, written by hand."""
    stored.with_suffix(".json").write_text(content)
    with pytest.raises(WeightsError, match=f"tiny.json: {message}"):
        weights.load(stored)


@pytest.mark.parametrize("config", [None, 3, {"nmae": "tiny"}, {"matching": {"mass": 7.0}}])
def test_card_without_a_usable_config_is_one_sentence(stored, config):
    """Oracle: an error that this package raises on purpose, naming the file."""
    change_card(stored, config=config)
    with pytest.raises(DeloError, match="tiny|matching.mass"):
        weights.load(stored)


def test_missing_card_and_unknown_name(stored):
    """Oracle: the sentence; a name that is not there lists those that are."""
    stored.with_suffix(".json").unlink()
    with pytest.raises(WeightsError, match="tiny.json: expected the model card of the weights, got .*No such file"):
        weights.load(stored)
    with pytest.raises(WeightsError, match="delo-bse: expected one of .* or a .safetensors file, got neither; check the name"):
        weights.load("delo-bse")
    with pytest.raises(WeightsError, match="got neither"):
        weights.load(stored.parent)


def test_released_weights_load_by_name():
    """Oracle: what a model card must tell, and finite numbers; every set of weights in the package is loaded."""
    assert "delo-base" in weights.released()
    assert weights.released() == sorted(weights.released())
    for name in weights.released():
        model, card = weights.load(name), weights.read_card(name)
        assert isinstance(model, delo.Model)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model))
        assert {"data", "seeds", "commands", "metrics", "sha256", "config"} <= card.keys()
