"""What every command has."""

import dataclasses
from typing import Any


@dataclasses.dataclass(frozen=True, kw_only=True)
class Command:
    """Options of a command; its docstring is the help text, its fields are the options."""

    dump_config: bool = dataclasses.field(default=False, metadata={"toml": False})
    """Print the effective options as TOML and stop."""

    def effective(self) -> Any:
        """The config that `--dump-config` prints."""
        return self

    def run(self) -> int:
        """Does the work and returns the exit code.

        Raises:
            DeloError: an input that cannot be used.
        """
        raise NotImplementedError
