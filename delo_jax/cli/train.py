"""`delo train`: weights from simulated worlds or recorded sequences."""

import dataclasses
import platform
import shlex
import sys
import time
from importlib.metadata import version
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from delo_jax import __version__, config
from delo_jax.cli.command import Command
from delo_jax.errors import ConfigError

if TYPE_CHECKING:
    from rich.progress import Progress

    from delo_jax.train.validate import GapErrors


KITTI_TRAINING = ("00", "01", "02", "03", "04", "05", "06")  # the split of the odometry benchmark in the literature


@dataclasses.dataclass(frozen=True, kw_only=True)
class Train(Command):
    """Weights from simulated worlds, or from recorded sequences; an interrupted training goes on when the same command is given again.

    Example: delo train base --out runs/train-base
    Example: delo train paper --data kitti/dataset
    """

    what: tyro.conf.Positional[str]
    """Preset (base, tiny, paper, official, dcp), or a TOML file such as --dump-config prints."""
    data: Path | None = None
    """KITTI odometry tree to train on, with poses; simulation when not given."""
    sequences: tuple[str, ...] | None = None
    """Sequences of that tree, those of the TOML file or 00 to 06 by default; the last tenth of each is for validation."""
    out: Path | None = None
    """Folder for worlds, checkpoints and weights; runs/train-NAME by default."""

    def effective(self) -> config.TrainConfig:
        """The whole config of the training: save it, change it, train with it."""
        from delo_jax.train.presets import PRESETS

        if self.what in PRESETS:
            cfg = PRESETS[self.what]
        elif Path(self.what).exists():
            cfg = config.load(config.TrainConfig, Path(self.what))
        else:
            raise ConfigError(f"{self.what}: expected a preset ({', '.join(PRESETS)}) or a TOML file, got neither; check the name")
        if self.data is None:
            if self.sequences is not None:
                raise ConfigError("--sequences: expected a tree to find them in, got none; add --data DIR")
            return cfg
        return dataclasses.replace(cfg, recorded=" ".join(self.sequences or cfg.recorded.split() or KITTI_TRAINING))

    def run(self) -> int:
        """Trains, prints the errors on unseen worlds and writes the weights."""
        cfg = self.effective()
        from delo_jax import weights
        from delo_jax.cli.console import progress
        from delo_jax.train.loop import train

        out = self.out or Path("runs") / f"train-{Path(self.what).stem}"
        given = {"--out": (self.out,), "--data": (self.data,), "--sequences": self.sequences or (None,)}
        options = [str(word) for name, values in given.items() if values[0] is not None for word in (name, *values)]
        command = shlex.join(["delo", "train", self.what, *options])
        try:
            with progress("steps") as bar:
                model, errors, num_nonfinite = train(cfg, out, BarReporter(bar), self.data)
        except KeyboardInterrupt:
            print(f"delo: interrupted; worlds and checkpoints are kept, to go on: {command}", file=sys.stderr)
            return 1
        path = weights.save(out / f"delo-{cfg.model.name}", model, card(cfg, command, errors, num_nonfinite))
        print_errors("errors on unseen worlds", errors)
        print(f"weights and card: {path}")
        return 0


class BarReporter:
    """Progress of a training as bars, and a table at each validation."""

    def __init__(self, bar: "Progress"):
        self._bar = bar
        self._task: Any = None

    def start(self, what: str, total: int, done: int = 0) -> None:
        """A new bar."""
        self._task = self._bar.add_task(what, total=total, completed=done, note="")

    def advance(self, note: str = "") -> None:
        """One unit further."""
        self._bar.update(self._task, advance=1, note=note)

    def validated(self, step: int, errors: "list[GapErrors]") -> None:
        """A small table."""
        print_errors(f"unseen worlds after {step} steps", errors)


def print_errors(title: str, errors: "list[GapErrors]") -> None:
    """Errors by frame gap."""
    from delo_jax.cli.console import print_table

    header = "gap", "pairs", "median cm", "p95 cm", "median deg", "lost %", "false alarms %", "missed %"
    rows = [
        (str(row.gap), str(row.num_pairs), f"{row.median_cm:.1f}", f"{row.p95_cm:.1f}", f"{row.median_deg:.3f}")
        + tuple("" if isnan(share) else f"{100 * share:.1f}" for share in (row.lost_share, row.false_alarm_share, row.missed_share))
        for row in errors
    ]
    print_table(title, header, rows, right=range(len(header)))


def card(cfg: config.TrainConfig, command: str, errors: "list[GapErrors]", num_nonfinite: int) -> dict[str, Any]:
    """What a user of the weights should know; `weights.save` adds config, format and SHA-256."""
    from delo_jax.sim import KINDS
    from delo_jax.train.worlds import SEEDS_PER_RUN, VALIDATION_SEED

    scenes = f"{cfg.num_scenes} simulated scenes of {cfg.num_frames} scans, kinds {', '.join(KINDS)}; no recorded data"
    recorded = f"recorded sequences {cfg.recorded}, the last tenth of each for validation, KITTI's elevation lifted by 0.205 deg"
    held_out = f"worlds from seed {cfg.seed * SEEDS_PER_RUN + VALIDATION_SEED} on, never trained on"
    names = "jax", "flax", "optax", "numpy"
    return {
        "name": f"delo-{cfg.model.name}",
        "data": recorded if cfg.recorded else scenes,
        "seeds": {"base": cfg.seed} | ({} if cfg.recorded else {"validation": held_out}),
        "commands": [command],
        "training": config_table(cfg),
        "steps left out as not finite": num_nonfinite,
        "metrics": [{name: value for name, value in row._asdict().items() if not isnan(value)} for row in errors],
        "versions": {"delo-jax": __version__, "python": platform.python_version(), **{name: version(name) for name in names}},
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "license": "that of the recorded data" if cfg.recorded else "MIT",
    }


def config_table(cfg: config.TrainConfig) -> dict[str, Any]:
    """The training's own options; those of the model stand beside them in the card."""
    return {name: value for name, value in dataclasses.asdict(cfg).items() if name != "model"}
