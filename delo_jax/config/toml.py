"""Configs from and to TOML; unknown keys are refused with the nearest name."""

import dataclasses
import difflib
import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from delo_jax.config.checks import require
from delo_jax.errors import ConfigError

T = TypeVar("T")


def from_dict(cls: type[T], table: Mapping[str, Any], where: str = "config") -> T:
    """Config from nested tables; keys not given keep their defaults, unknown keys are an error.

    Raises:
        ConfigError: an unknown key (with the nearest known one) or a value of the wrong type or range.
    """
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in fields:
            near = difflib.get_close_matches(key, fields, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise ConfigError(f"{where}: expected one of {', '.join(fields)}, got {key!r}{hint}")
        values[key] = _value(fields[key].default, value, f"{where}.{key}")
    return cls(**values)


def _value(default: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(default):
        require(isinstance(value, Mapping), where, "a table", value)
        return from_dict(type(default), value, where)
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    require(type(value) is type(default), where, f"a value of type {type(default).__name__}", value)
    return value


def load(cls: type[T], path: Path) -> T:
    """Config from a TOML file.

    Raises:
        ConfigError: unreadable file, TOML syntax, unknown key, wrong type or range.
    """
    try:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: expected a readable TOML file, got {error.strerror}; check the path") from error
    except ValueError as error:
        raise ConfigError(f"{path}: expected valid TOML, got {error}; mend the file") from error
    return from_dict(cls, table, str(path))


def to_toml(config: Any) -> str:
    """The config as TOML that `load` reads back to an equal one."""
    return "\n".join(_lines(config, "")).strip() + "\n"


def _lines(config: Any, prefix: str) -> list[str]:
    values = {field.name: getattr(config, field.name) for field in dataclasses.fields(config) if field.metadata.get("toml", True)}
    values = {key: value for key, value in values.items() if value is not None}  # TOML has no null: the key is left out
    lines = [f"{key} = {_toml_value(value)}" for key, value in values.items() if not dataclasses.is_dataclass(value)]
    for key, value in values.items():
        if dataclasses.is_dataclass(value):
            lines += ["", f"[{prefix}{key}]", *_lines(value, f"{prefix}{key}.")]
    return lines


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str | Path):
        return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")  # the escapes of JSON are TOML's, which has one more
    return repr(value)
