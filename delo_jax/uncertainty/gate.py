"""Confidence of a pair on the scale of held-out pairs, and what it means for a pose graph: the paper's gate (section 3.3)."""

from typing import Any, Literal, NamedTuple

import numpy as np

from delo_jax.config import RefineConfig

NAME = "gate"  # of the quantiles among a model's variables
LEVELS = np.linspace(0.0, 1.0, 101)
REGIONS = ("under-confident", "confident", "over-confident")


class Quantiles(NamedTuple):
    """Of held-out pairs, at 0, 1, ... 100 %."""

    sigmas: Any  # (101, 6) epistemic standard deviations per axis [rad, m]
    ranks: Any  # (101,) the mean over the axes of where a pair stands among these

    @classmethod
    def of(cls, variables: dict[str, Any]) -> "Quantiles | None":
        """Those of a model; None where it is not calibrated."""
        return None if NAME not in variables else cls(**{name: np.asarray(variables[NAME][name], np.float64) for name in cls._fields})

    @classmethod
    def fit(cls, epistemic: np.ndarray) -> "Quantiles":
        """From the epistemic variances (n, 6) of held-out pairs."""
        sigmas = np.quantile(np.sqrt(epistemic), LEVELS, axis=0)
        means = np.array([_mean_rank(one, sigmas) for one in epistemic])
        return cls(sigmas, np.quantile(means, LEVELS))

    def stored(self) -> dict[str, Any]:
        """As one of a model's variables."""
        return {name: np.asarray(array, np.float32) for name, array in self._asdict().items()}


class Verdict(NamedTuple):
    """What to do with a pair of key frames."""

    action: Literal["skip", "refine"]
    """skip: the odometry stands; refine: the pair's factor and an update of the graph are added."""
    region: str
    """One of REGIONS."""


def _mean_rank(epistemic: np.ndarray, sigmas: np.ndarray) -> float:
    ranks = [np.interp(sigma, column, LEVELS) for sigma, column in zip(np.sqrt(epistemic), sigmas.T, strict=True)]
    return float(np.mean(ranks))


def confidence(epistemic: np.ndarray, quantiles: Quantiles) -> float:
    """Share of held-out pairs that the network doubts more than this one, in [0, 1].

    The paper has 1 - Var[mu] here, six numbers in rad^2 and m^2, which is near 1 for any trained network; so each axis is ranked among
    held-out pairs, the ranks are averaged, and the average is ranked again.

    Args:
        epistemic: (6,) variances of the pair [rad^2, m^2].
        quantiles: of held-out pairs.
    """
    return 1.0 - float(np.interp(_mean_rank(epistemic, quantiles.sigmas), quantiles.ranks, LEVELS))


def judge(confidence: float, cfg: RefineConfig) -> Verdict:
    """The paper's gate: between theta_min and theta_max the odometry stands.

    Args:
        confidence: from `confidence`.
        cfg: thresholds, or no gate at all.
    """
    place = int(confidence >= cfg.theta_min) + int(confidence > cfg.theta_max)
    refine = cfg.gate == "none" or place != 1
    return Verdict("refine" if refine else "skip", REGIONS[place])
