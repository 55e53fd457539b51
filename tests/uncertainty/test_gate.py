"""The paper's gate on calibrated confidences."""

import numpy as np
import pytest
from scipy.stats import kstest

from delo_jax.config import RefineConfig
from delo_jax.uncertainty import gate

UNITS = np.array([1e-6, 2e-6, 5e-6, 1e-4, 3e-4, 2e-4])


def doubts(seed: int, count: int) -> np.ndarray:
    """Epistemic variances (n, 6) of pairs: a common part and one per axis."""
    rng = np.random.default_rng(seed)
    return UNITS * np.exp(rng.normal(size=(count, 1)) + 0.7 * rng.normal(size=(count, 6)))


def test_confidence_of_new_pairs_is_uniform():
    """Oracle: Kolmogorov and Smirnov; pairs of the same kind as those the quantiles are of."""
    quantiles = gate.Quantiles.fit(doubts(0, 4000))
    found = [gate.confidence(one, quantiles) for one in doubts(1, 800)]
    assert kstest(found, "uniform").pvalue > 0.01


def test_more_doubt_is_less_confidence():
    """Oracle: order; and beyond all that was held out lies 0 and 1."""
    quantiles = gate.Quantiles.fit(doubts(0, 500))
    found = [gate.confidence(scale * UNITS, quantiles) for scale in (1e-4, 0.3, 1.0, 3.0, 1e4)]
    assert found == sorted(found, reverse=True)
    assert (found[0], found[-1]) == (1.0, 0.0)


@pytest.mark.parametrize(
    ("cfg", "expected"),
    [
        (RefineConfig(theta_min=0.2, theta_max=0.7), "rrsssrr"),
        (RefineConfig(theta_min=0.2, theta_max=1.0), "rrsssss"),
        (RefineConfig(gate="none", theta_min=0.2, theta_max=0.7), "rrrrrrr"),
    ],
)
def test_verdicts_are_those_of_the_paper(cfg, expected):
    """Oracle: the inequality of section 3.3, by hand: inside the band nothing is refined; with theta_max = 1 the gate is monotone."""
    found = [gate.judge(confidence, cfg) for confidence in (0.0, 0.19, 0.2, 0.5, 0.7, 0.71, 1.0)]
    assert "".join(verdict.action[0] for verdict in found) == expected
    assert [verdict.region for verdict in found[::3]] == [
        "under-confident",
        "confident",
        "over-confident" if cfg.theta_max < 1 else "confident",
    ]


def test_quantiles_survive_storage():
    """Oracle: the numbers themselves, in float32."""
    quantiles = gate.Quantiles.fit(doubts(0, 300))
    again = gate.Quantiles.of({"gate": quantiles.stored()})
    assert again is not None
    for a, b in zip(again, quantiles, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)
    assert gate.Quantiles.of({}) is None
