"""One simulated tree, one set of untrained weights and one compilation for all commands."""

from pathlib import Path
from typing import NamedTuple

import jax
import pytest

from delo_jax import weights
from delo_jax.cli import main
from delo_jax.config import DeloConfig, StatusConfig
from delo_jax.model import delo

NUM_SCANS = 8
CONFIG = DeloConfig(status=StatusConfig(ok_confidence=0.0, rejected_confidence=0.0, min_observability=0.0))  # no word of untrained evidence
SEED = 50  # a car that hardly moves: what untrained weights can track


class Done(NamedTuple):
    """What a command left."""

    code: int
    out: str
    err: str


@pytest.fixture(scope="package")
def weights_file(tmp_path_factory) -> str:
    """Untrained weights: they register neighbouring scans, roughly."""
    path = tmp_path_factory.mktemp("weights") / "untrained"
    return str(weights.save(path, jax.jit(delo.init, static_argnums=0)(CONFIG, jax.random.key(0)), {"name": "untrained"}))


@pytest.fixture(scope="package")
def tree(tmp_path_factory) -> Path:
    """A KITTI tree of a simulated drive, motion-compensated."""
    root = tmp_path_factory.mktemp("tree")
    assert main(["simulate", str(root), "--seed", str(SEED), "--num-scans", str(NUM_SCANS)]) == 0
    return root


@pytest.fixture(scope="package")
def scans(tree) -> list[Path]:
    """The scan files of the tree."""
    return sorted((tree / "sequences" / f"mixed-{SEED}" / "velodyne").glob("*.bin"))


@pytest.fixture
def cli(capfd, weights_file):
    """Runs a command line in this process; the weights are those of the fixture where the command takes some."""

    def call(*arguments: object) -> Done:
        argv = [str(argument) for argument in arguments]
        if argv[0] in ("run", "demo", "doctor") and "--weights" not in argv:
            argv += ["--weights", weights_file]
        capfd.readouterr()
        code = main(argv)
        done = Done(code, *capfd.readouterr())
        assert "Traceback" not in done.out + done.err
        return done

    return call
