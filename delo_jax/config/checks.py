"""Checks that configs share: one sentence, what was expected and what was found."""

import difflib
from collections.abc import Sequence

from delo_jax.errors import ConfigError


def require(condition: bool, name: str, expected: str, got: object) -> None:
    """Raise a ConfigError `name: expected ..., got ...` unless the condition holds."""
    if not condition:
        raise ConfigError(f"{name}: expected {expected}, got {got!r}")


def require_positive(config: object, where: str, *names: str) -> None:
    """Raise a ConfigError unless all of these fields are above zero."""
    for name in names:
        require(getattr(config, name) > 0, f"{where}{name}", "a value above 0", getattr(config, name))


def require_one_of(value: str, name: str, known: Sequence[str]) -> None:
    """Raise a ConfigError, with the nearest known value, unless the value is known."""
    if value not in known:
        near = difflib.get_close_matches(value, known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ConfigError(f"{name}: expected one of {', '.join(known)}, got {value!r}{hint}")
