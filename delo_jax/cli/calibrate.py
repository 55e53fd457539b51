"""`delo calibrate`: covariances that fit the errors, fitted on simulated worlds."""

import dataclasses
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from delo_jax.cli.command import Command
from delo_jax.errors import ConfigError, WeightsError

if TYPE_CHECKING:
    import numpy as np

MIN_WORLDS = 8


@dataclasses.dataclass(frozen=True, kw_only=True)
class Calibrate(Command):
    """Fits the covariance of a pair to the errors that the weights make on simulated worlds no training has seen.

    Example: delo calibrate delo-base --out runs/calibrated
    """

    weights: tyro.conf.Positional[str] = "delo-base"
    """Name of released weights, or a .safetensors file with its card."""
    out: Path = Path("runs/calibrated")
    """Folder for worlds and the calibrated weights; worlds that are there are not made again."""
    num_worlds: int = 900
    """Simulated worlds, eleven pairs each: about a second each on two cores."""

    def run(self) -> int:
        """Simulates, fits, prints the coverage on worlds that the fit had not seen, and writes the weights."""
        if self.num_worlds < MIN_WORLDS:
            raise ConfigError(f"--num-worlds: expected {MIN_WORLDS} or more, got {self.num_worlds}")
        from delo_jax import weights
        from delo_jax.cli.console import progress
        from delo_jax.train.calibrate import NUM_FOLDS, NUM_FRAMES, calibrate, solved_pairs
        from delo_jax.train.worlds import CALIBRATION_SEED, stored_worlds

        model, card = weights.load(self.weights), weights.read_card(self.weights)
        if model.cfg.evidence.head != "statistics":
            raise WeightsError(
                f"{self.weights}: expected a statistics head, got {model.cfg.evidence.head!r}; there is nothing to calibrate"
            )
        command = shlex.join(["delo", "calibrate", self.weights, "--num-worlds", str(self.num_worlds)])
        try:
            with progress("worlds") as bar:
                task = bar.add_task("simulating and solving", total=self.num_worlds, note="")
                worlds = stored_worlds(
                    self.out / "worlds",
                    "calibration",
                    self.num_worlds,
                    CALIBRATION_SEED,
                    num_frames=NUM_FRAMES,
                    cfg=model.cfg.preprocess,
                    on_world=lambda: bar.update(task, advance=1),
                )
                pairs = solved_pairs(model, worlds)
                fits = bar.add_task("fitting", total=NUM_FOLDS + 1, note="")
                calibrated, covariances = calibrate(model, pairs, lambda: bar.update(fits, advance=1))
        except KeyboardInterrupt:
            print(f"delo: interrupted; worlds are kept, to go on: {command} --out {shlex.quote(str(self.out))}", file=sys.stderr)
            return 1
        good = ~pairs.lost(model)
        measured = measures(pairs.errors[good], covariances[good])
        show(f"{good.sum()} pairs, {(~good).sum()} lost ones apart, by fits that had not seen their worlds", measured)
        seeds = f"worlds {CALIBRATION_SEED} to {CALIBRATION_SEED + self.num_worlds - 1}, never trained on"
        about = {"command": command, "worlds": seeds, "pairs": int(good.sum()), "out of fold": measured}
        rest = {name: value for name, value in card.items() if name not in ("format", "sha256", "config")}
        path = weights.save(self.out / Path(self.weights).stem, calibrated, rest | {"calibration": about})
        print(f"calibrated weights and card: {path}")
        return 0


def measures(errors: "np.ndarray", covariances: "np.ndarray") -> dict[str, Any]:
    """How well covariances fit errors, for people."""
    import numpy as np

    from delo_jax.metrics.calibration import coverage, nees, negative_log_likelihood
    from delo_jax.train.calibrate import LEVELS

    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    shares = {f"coverage at {100 * level:.0f} %": [round(float(share), 4) for share in coverage(errors, sigmas, level)] for level in LEVELS}
    squares = float(np.mean(nees(errors, covariances))) / errors.shape[1]
    return shares | {"nees / 6": round(squares, 4), "nats": round(float(np.mean(negative_log_likelihood(errors, covariances))), 4)}


def show(title: str, measured: dict[str, Any]) -> None:
    """A table of them."""
    from delo_jax.cli.console import print_table
    from delo_jax.uncertainty.observability import AXES

    rows = [(name, *(f"{100 * share:.1f}" for share in value)) for name, value in measured.items() if isinstance(value, list)]
    print_table(title, ("", *AXES), rows, right=range(1, 7))
    print(f"error squared / its expectation: {measured['nees / 6']:.2f}; negative log likelihood: {measured['nats']:.2f} nats a pair")
