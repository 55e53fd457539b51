"""The command `delo`. Nothing heavy is imported before a command runs."""

import hashlib
import os
import platform
import sys
from collections.abc import Sequence
from pathlib import Path

import tyro

import delo_jax
from delo_jax.cli.bench import Bench
from delo_jax.cli.calibrate import Calibrate
from delo_jax.cli.command import Command
from delo_jax.cli.demo import Demo
from delo_jax.cli.doctor import Doctor
from delo_jax.cli.eval import Eval
from delo_jax.cli.refine import Refine
from delo_jax.cli.run import Run
from delo_jax.cli.simulate import Simulate
from delo_jax.cli.train import Train
from delo_jax.config import to_toml
from delo_jax.errors import DeloError

COMMANDS: dict[str, type[Command]] = {
    "run": Run,
    "refine": Refine,
    "eval": Eval,
    "demo": Demo,
    "simulate": Simulate,
    "train": Train,
    "calibrate": Calibrate,
    "doctor": Doctor,
    "bench": Bench,
}
FELL_SHORT, USAGE = 1, 2


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command line and returns its exit code.

    Args:
        argv: arguments after the name of the program; those of this process by default.

    Returns:
        0; 1 when the command ran but fell short or was interrupted; 2 when the command line or an input is at fault.
    """
    try:
        command = _parse(sys.argv[1:] if argv is None else argv)
        if command.dump_config:
            print(to_toml(command.effective()), end="")
            return 0
        keep_compiled()
        return command.run()
    except SystemExit as stop:  # of the parser: after --help, or a mistake that it has described
        return stop.code if isinstance(stop.code, int) else USAGE
    except KeyboardInterrupt:
        return _say("interrupted", FELL_SHORT)
    except DeloError as error:
        return _say(str(error), USAGE, error)
    except Exception as error:  # the last resort: a user never sees a traceback unasked
        text = " ".join(str(error).split())[:300] or "no message"
        return _say(f"unexpected {type(error).__name__}: {text}; set DELO_DEBUG=1 for the traceback", FELL_SHORT, error)


def keep_compiled() -> None:
    """Lets JAX keep what it compiles in the user's cache, so that only the first start waits for it; a folder that the user has set stands.

    A folder for each kind of processor: compiled code is made for the instructions of one.
    """
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = root / "delo-jax" / f"compiled-{_processor()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return  # nowhere to keep it: it is compiled each time
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))  # read when JAX is imported
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")


def _processor() -> str:
    """Eight characters that tell kinds of processors apart."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        flags = next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        flags = platform.processor()
    return hashlib.sha256(f"{platform.machine()} {flags}".encode()).hexdigest()[:8]


def _parse(argv: Sequence[str]) -> Command:
    description = (delo_jax.__doc__ or "").splitlines()[0]
    return tyro.extras.subcommand_cli_from_dict(
        dict(COMMANDS), prog="delo", description=description, args=list(argv), config=(tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone)
    )


def _say(sentence: str, code: int, error: Exception | None = None) -> int:
    if error is not None and os.environ.get("DELO_DEBUG"):
        raise error
    print(f"delo: {sentence}", file=sys.stderr)
    return code
