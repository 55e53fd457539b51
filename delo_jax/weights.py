"""Weights as safetensors with a JSON card beside them: typed, hashed, no pickle."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from safetensors import SafetensorError
from safetensors.numpy import load as parse_tensors
from safetensors.numpy import save as dump_tensors

from delo_jax import config
from delo_jax.errors import WeightsError
from delo_jax.model import delo

FOLDER = Path(__file__).parent / "weights"
FORMAT = 1


def released() -> list[str]:
    """Names of the weights that come with the package."""
    return sorted(path.stem for path in FOLDER.glob("*.safetensors"))


def find(name: str | Path) -> Path:
    """The safetensors file of released weights, by name, or of a path.

    Raises:
        WeightsError: no such weights; the message lists those there are.
    """
    for path in (FOLDER / f"{name}.safetensors", Path(name)):
        if path.is_file():
            return path
    raise WeightsError(f"{name}: expected one of {', '.join(released())} or a .safetensors file, got neither; check the name")


def read_card(name: str | Path) -> dict[str, Any]:
    """The model card of some weights: config, data, seeds, commands, metrics, SHA-256.

    Raises:
        WeightsError: missing or damaged card.
    """
    path = find(name).with_suffix(".json")
    try:
        card = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise WeightsError(f"{path}: expected the model card of the weights, got {error}; restore the file") from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        got = card.get("format") if isinstance(card, dict) else type(card).__name__
        raise WeightsError(f"{path}: expected format {FORMAT}, got {got}; update delo-jax or the weights")
    if not isinstance(card.get("config"), dict):
        raise WeightsError(f"{path}: expected a card with a config, got {card.get('config')!r}; restore the file")
    return card


def load(name: str | Path = "delo-base") -> delo.Model:
    """Model of released weights, by name, or of a safetensors file with its card.

    Raises:
        WeightsError: unknown name, damaged file, hash or shapes that do not fit the card.
    """
    path, card = find(name), read_card(name)
    data = path.read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    if digest != card.get("sha256"):
        raise WeightsError(f"{path}: expected SHA-256 {card.get('sha256')}, got {digest}; the file is damaged, fetch it again")
    try:
        tensors = parse_tensors(data)
    except SafetensorError as error:
        raise WeightsError(f"{path}: expected a safetensors file, got {error}; fetch it again") from error
    cfg = config.from_dict(config.DeloConfig, card["config"], f"{path.name} config")
    template = jax.eval_shape(lambda: delo.init(cfg, jax.random.key(0))).variables
    if any(name.startswith("stream/") for name in tensors):  # weights from before, or not calibrated for drives, have none
        template["stream"] = {name: jax.ShapeDtypeStruct((), jnp.float32) for name in delo.STREAM_NUMBERS}
    if any(name.startswith("gate/") for name in tensors):
        template["gate"] = {name: jax.ShapeDtypeStruct(shape, jnp.float32) for name, shape in delo.GATE_SHAPES.items()}
    leaves, tree = jax.tree_util.tree_flatten_with_path(template)
    names = [_name(key_path) for key_path, _ in leaves]
    expected = {name: (leaf.shape, leaf.dtype) for name, (_, leaf) in zip(names, leaves, strict=True)}
    got = {name: (array.shape, array.dtype) for name, array in tensors.items()}
    if got != expected:
        wrong = sorted(name for name in expected.keys() | got.keys() if expected.get(name) != got.get(name))
        raise WeightsError(
            f"{path}: expected the arrays of preset {cfg.name!r}, got other shapes or types at {', '.join(wrong[:3])}; use matching weights"
        )
    arrays = jax.device_put([tensors[name] for name in names])  # at once: one by one JAX compiles a transfer for every shape
    return delo.Model(jax.tree_util.tree_unflatten(tree, arrays), cfg)


def save(path: str | Path, model: delo.Model, card: dict[str, Any]) -> Path:
    """Write `<path>.safetensors` and its card `<path>.json`.

    Args:
        path: file name; the suffix is replaced.
        model: weights and config; both are stored.
        card: what a user should know: data, seeds, commands, metrics. Config, format and SHA-256 are added.

    Returns:
        The safetensors file.
    """
    path = Path(path).with_suffix(".safetensors")
    leaves, _ = jax.tree_util.tree_flatten_with_path(jax.device_get(model.variables))
    data = dump_tensors({_name(key_path): array for key_path, array in leaves})
    full = {"format": FORMAT, **card, "sha256": hashlib.sha256(data).hexdigest(), "config": dataclasses.asdict(model.cfg)}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    path.with_suffix(".json").write_text(json.dumps(full, indent=2) + "\n")
    return path


def _name(key_path: tuple) -> str:
    return "/".join(str(key.key) for key in key_path)
