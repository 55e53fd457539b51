"""`delo calibrate`: covariances that fit the errors, fitted on simulated worlds and drives."""

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

    from delo_jax.model.delo import Model
    from delo_jax.train.calibrate_stream import Segments

MIN_WORLDS, MIN_DRIVES = 8, 2


@dataclasses.dataclass(frozen=True, kw_only=True)
class Calibrate(Command):
    """Fits the covariances of a pair and of a drive on the map to errors made on simulated worlds that no training has seen.

    Example: delo calibrate delo-base --out runs/calibrated
    """

    weights: tyro.conf.Positional[str] = "delo-base"
    """Name of released weights, or a .safetensors file with its card."""
    out: Path = Path("runs/calibrated")
    """Folder for worlds, solved pairs, drives and the calibrated weights; what is there is not made again."""
    num_worlds: int = 900
    """Simulated worlds, thirty pairs each: a second or two each on two cores. 0: the covariance of a pair stays as it is."""
    num_drives: int = 16
    """Simulated drives of 12 s: about half a minute each on two cores. 0: the covariance of a drive stays as it is."""

    def run(self) -> int:
        """Simulates, fits, prints the coverage on worlds and drives that the fit had not seen, and writes the weights."""
        for name, number, least in (("--num-worlds", self.num_worlds, MIN_WORLDS), ("--num-drives", self.num_drives, MIN_DRIVES)):
            if number != 0 and number < least:
                raise ConfigError(f"{name}: expected {least} or more, or 0 to leave that part as it is, got {number}")
        from delo_jax import weights

        model, card = weights.load(self.weights), weights.read_card(self.weights)
        if model.cfg.evidence.head != "statistics":
            raise WeightsError(
                f"{self.weights}: expected a statistics head, got {model.cfg.evidence.head!r}; there is nothing to calibrate"
            )
        numbers = f"--num-worlds {self.num_worlds} --num-drives {self.num_drives}"
        command = f"delo calibrate {shlex.quote(self.weights)} {numbers}"
        rest = {name: value for name, value in card.items() if name not in ("format", "sha256", "config")}
        stages = ("calibration", self._pairs, self.num_worlds), ("stream calibration", self._stream, self.num_drives)
        try:
            for name, stage, number in stages:
                if number:
                    model, about = stage(model)
                    rest[name] = {"command": command} | about
        except KeyboardInterrupt:
            what = "worlds, pairs and drives are kept, to go on"
            print(f"delo: interrupted; {what}: {command} --out {shlex.quote(str(self.out))}", file=sys.stderr)
            return 1
        path = weights.save(self.out / Path(self.weights).stem, model, rest)
        print(f"calibrated weights and card: {path}")
        return 0

    def _pairs(self, model: "Model") -> tuple["Model", dict[str, Any]]:
        """The covariance of a pair, and what the card says of it."""
        from delo_jax.cli.console import progress
        from delo_jax.train.calibrate import NUM_FOLDS, calibrate, stored_pairs
        from delo_jax.train.worlds import CALIBRATION_SEED

        with progress("worlds") as bar:
            task, folder = bar.add_task("simulating and solving", total=self.num_worlds, note=""), self.out / "worlds"
            pairs = stored_pairs(
                folder, "calibration", model, self.num_worlds, CALIBRATION_SEED, on_world=lambda: bar.update(task, advance=1)
            )
            fits = bar.add_task("fitting", total=NUM_FOLDS + 1, note="")
            calibrated, covariances = calibrate(model, pairs, lambda: bar.update(fits, advance=1))
        good = ~pairs.lost(model)
        measured = measures(pairs.errors[good], covariances[good])
        show(f"{good.sum()} pairs, {(~good).sum()} lost ones apart, by fits that had not seen their worlds", measured)
        seeds = f"worlds {CALIBRATION_SEED} to {CALIBRATION_SEED + self.num_worlds - 1}, never trained on"
        return calibrated, {"worlds": seeds, "pairs": int(good.sum()), "out of fold": measured}

    def _stream(self, model: "Model") -> tuple["Model", dict[str, Any]]:
        """The covariance of a drive on the map, and what the card says of it."""
        from delo_jax.cli.console import progress
        from delo_jax.train.calibrate_stream import DRIVE_SEED, NUM_SCANS, calibrate, num_fits, segments, stored_drives

        with progress("scans") as bar:
            task = bar.add_task("simulating and registering", total=self.num_drives * NUM_SCANS, note="")
            drives = stored_drives(
                self.out / "drives", model, self.num_drives, DRIVE_SEED, num_scans=NUM_SCANS, on_scan=lambda: bar.update(task, advance=1)
            )
            rows = segments(list(drives))
            fits = bar.add_task("fitting", total=num_fits(rows), note="")
            calibrated, covariances = calibrate(model, rows, lambda: bar.update(fits, advance=1))
        measured = measures_of(rows, covariances)
        for name, numbers in measured.items():
            show(f"drives on the map, {name}, by fits that had not seen them", numbers)
        seeds = f"drives {DRIVE_SEED} to {DRIVE_SEED + self.num_drives - 1}, {NUM_SCANS} scans each, never trained on"
        return calibrated, {"drives": seeds, "out of fold": measured}


def measures(errors: "np.ndarray", covariances: "np.ndarray") -> dict[str, Any]:
    """How well covariances fit errors, for people."""
    import numpy as np

    from delo_jax.metrics.calibration import coverage, nees, negative_log_likelihood
    from delo_jax.train.calibrate import LEVELS

    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    shares = {f"coverage at {100 * level:.0f} %": [round(float(share), 4) for share in coverage(errors, sigmas, level)] for level in LEVELS}
    squares = float(np.mean(nees(errors, covariances))) / errors.shape[1]
    return shares | {"nees / 6": round(squares, 4), "nats": round(float(np.mean(negative_log_likelihood(errors, covariances))), 4)}


def measures_of(rows: "Segments", covariances: "np.ndarray") -> dict[str, Any]:
    """The same for motions over so many frames and for poses in the world, in rad and m."""
    import numpy as np

    from delo_jax.train.calibrate_stream import GAPS, UNITS, WORLD

    errors, covariances = rows.errors * UNITS, covariances * np.outer(UNITS, UNITS)
    names = {gap: f"over {gap} frame{'s' if gap > 1 else ''}" for gap in GAPS} | {WORLD: "poses in the world"}
    wanted = {name: rows.gaps == gap for gap, name in names.items()}
    return {name: measures(errors[which], covariances[which]) for name, which in wanted.items() if which.any()}


def show(title: str, measured: dict[str, Any]) -> None:
    """A table of them."""
    from delo_jax.cli.console import print_table
    from delo_jax.uncertainty.observability import AXES

    rows = [(name, *(f"{100 * share:.1f}" for share in value)) for name, value in measured.items() if isinstance(value, list)]
    print_table(title, ("", *AXES), rows, right=range(1, 7))
    print(f"error squared / its expectation: {measured['nees / 6']:.2f}; negative log likelihood: {measured['nats']:.2f} nats on average")
