"""An ensemble of networks: members trained on from given weights, each on worlds of its own, and the same pairs by all of them."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import _harness
import jax
import numpy as np
from rich.progress import Progress

from delo_jax.config import TrainConfig
from delo_jax.model.delo import Model
from delo_jax.train import loop
from delo_jax.train.calibrate import Pairs
from delo_jax.train.worlds import worlds


class Budget(NamedTuple):
    """Of each member."""

    num_scenes: int = 120  # of its own seed
    num_steps: int = 500  # of matching and pose
    num_evidence_steps: int = 200


QUICK = Budget(num_scenes=4, num_steps=10, num_evidence_steps=10)


class Solved(NamedTuple):
    """Pairs by the weights that are asked about, and the same pairs by every member, row by row."""

    pairs: Pairs
    members: tuple[Pairs, ...]

    def rows(self, which: np.ndarray) -> "Solved":
        """Some of them."""
        return jax.tree.map(lambda array: array[which], self)


def trained(model: Model, count: int, folder: Path, bar: Progress, budget: Budget) -> list[Model]:
    """Members, trained on with a warm restart of the learning rate; an interrupted training goes on, a finished one is read.

    Args:
        model: weights to start from; their calibration is not the members'.
        count: how many; the seed of each is its number, from 1 on, so that none shares a world with the training of the released weights.
        folder: of worlds and checkpoints.
        bar: progress.
        budget: scenes and steps.
    """
    start = Model({"params": model.variables["params"]}, replace(model.cfg, evidence=replace(model.cfg.evidence, covariance_width=0)))
    found = []
    for seed in range(1, count + 1):
        cfg = replace(TrainConfig(), model=start.cfg, seed=seed, **budget._asdict())
        reporter, own = _harness.BarReporter(bar, f"member {seed}"), folder / "-".join(["member", str(seed), *map(str, budget)])
        reporter.start("worlds", cfg.num_scenes)
        training = list(worlds(cfg, own / "worlds", validation=False, on_world=reporter.advance))
        member, num_nonfinite = loop.fit(cfg, training, [], start, own, reporter)
        if num_nonfinite:
            print(f"member {seed}: {num_nonfinite} steps were left out as not finite")
        found.append(member)
    return found
