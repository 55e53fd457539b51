"""Covariances fitted to errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delo_jax.metrics.calibration import coverage, nees
from delo_jax.model import delo
from delo_jax.ops import spread
from delo_jax.ops.evidence import NIG
from delo_jax.train import calibrate as module
from delo_jax.train.presets import PRESETS

NUM_STATISTICS = 24


@pytest.fixture(scope="module")
def model():
    """Its weights do not matter here."""
    return delo.init(PRESETS["tiny"].model, jax.random.key(0))


def drawn(seed, n):
    """Pairs whose errors have a size that one statistic tells, roll and lateral being correlated, far from what the evidence says."""
    rng = np.random.default_rng(seed)
    statistics = rng.normal(size=(n, NUM_STATISTICS)).astype(np.float32)
    half = np.diag([1e-3, 5e-4, 2e-3, 0.02, 0.01, 0.005])
    half[4, 0] = 0.01
    size = np.exp(0.7 * statistics[:, 0])
    errors = size[:, None] * (rng.normal(size=(n, 6)) @ half.T)
    Ts = np.tile(np.eye(4), (n, 1, 1))
    Ts[:, 0, 3] = -2.0  # towards -x of the source frame: the frame of the motion is turned by 180 degrees
    ones = np.ones((n, 6), np.float32)
    nig = NIG(0 * ones, ones, 2 * ones, 1e-4 * ones)
    information = np.tile(np.eye(6), (n, 1, 1))
    covariances = size[:, None, None] ** 2 * (half @ half.T)
    pairs = module.Pairs(errors, Ts, statistics, nig, np.full(n, 0.9, np.float32), information, np.arange(n) // 11, np.ones(n, int))
    return pairs, covariances


def test_fit_finds_the_covariances_that_the_errors_were_drawn_from(model, monkeypatch):
    """Oracle: the construction, on pairs that the fit has not seen; a tenth of them lost, by metres, which must not widen the others."""
    monkeypatch.setattr(module, "NUM_FOLDS", 2)
    monkeypatch.setattr(module, "MAX_STEPS", 80)
    pairs, _ = drawn(0, 4400)
    pairs.errors[::10] += 3.0
    assert pairs.lost(model).sum() >= 440
    calibrated, unseen = module.calibrate(model, pairs)
    fresh, expected = drawn(1, 1000)
    H = module.halves(calibrated, calibrated.variables["covariance"], fresh)
    covariances = H @ H.transpose(0, 2, 1)
    sigma, true = (np.sqrt(np.diagonal(C, axis1=1, axis2=2)) for C in (covariances, expected))
    assert np.median(np.abs(np.log(sigma / true))) < 0.2
    correlation, right = (C[:, 0, 4] / np.sqrt(C[:, 0, 0] * C[:, 4, 4]) for C in (covariances, expected))
    assert np.abs(np.median(correlation) - np.median(right)) < 0.1
    assert 0.8 < nees(fresh.errors, covariances).mean() / 6 < 1.25
    good = ~pairs.lost(model)
    spreads = np.sqrt(np.diagonal(unseen[good], axis1=1, axis2=2))
    off = [coverage(pairs.errors[good], spreads, level) - level for level in module.LEVELS]
    np.testing.assert_allclose(off, 0.0, atol=0.03)
    np.testing.assert_allclose(coverage(fresh.errors, sigma, 0.68), 0.68, atol=0.07)
    assert calibrated.cfg.evidence.covariance_width == module.WIDTH


def test_scale_is_as_far_above_at_one_level_as_below_at_the_other():
    """Oracle: quantiles of drawn errors: of Gaussian ones, and of such with heavy tails (Student-t, 3 degrees of freedom)."""
    rng = np.random.default_rng(0)
    errors = np.column_stack([rng.normal(size=(20_000, 3)) * [1.0, 2.0, 0.5], rng.standard_t(3, (20_000, 3)) * [1.0, 1.5, 0.1]])
    scale = module._scale(errors, np.tile(np.eye(6), (len(errors), 1, 1)))
    np.testing.assert_allclose(scale[:3], [1.0, 2.0, 0.5], rtol=0.02)
    above, below = (coverage(errors, np.tile(scale, (len(errors), 1)), level) - level for level in module.LEVELS)
    np.testing.assert_allclose(above, -below, atol=1e-3)
    assert (above[3:] > 0.01).all()


@pytest.mark.parametrize("freedom", [4.0])
def test_student_fit_finds_the_degrees_of_freedom(model, monkeypatch, freedom):
    """Oracle: the construction: Gaussian errors over the root of a chi-squared number, shared by the axes."""
    monkeypatch.setattr(module, "MAX_STEPS", 60)
    pairs, covariances = drawn(0, 4400)
    rng = np.random.default_rng(1)
    heavy = pairs._replace(errors=pairs.errors * np.sqrt(freedom / rng.chisquare(freedom, (len(pairs.errors), 1))))
    heavy = heavy.rows(np.flatnonzero(~heavy.lost(model)))
    weights = module.fit(model, heavy, likelihood=spread.student_negative_log_likelihood, more={"freedom": jnp.array(2.0)})
    assert float(spread.freedom(weights)) == pytest.approx(freedom, rel=0.25)
    H = module.halves(model, weights, pairs)
    sigma, true = (np.sqrt(np.diagonal(C, axis1=1, axis2=2)) for C in (H @ H.transpose(0, 2, 1), covariances))
    assert np.median(np.abs(np.log(sigma / true))) < 0.2


def test_pairs_of_a_world_are_solved_once_and_measured(model, monkeypatch, tmp_path):
    """Oracle: worlds of one scan seen again and again: the truth of every pair is the identity; a store is read, not made again."""
    from delo_jax.preprocess import Scan, preprocess
    from delo_jax.train import worlds
    from tests.oracles import street

    scan = preprocess(street.scan(street.pose()).points, model.cfg.preprocess)
    world = worlds.World(
        Scan(*(np.stack([array] * module.NUM_FRAMES) for array in scan)), np.tile(street.pose(), (module.NUM_FRAMES, 1, 1))
    )
    made = []

    def make_world(index, *, seed, **settings):
        made.append(seed + index)
        return world

    monkeypatch.setattr(worlds, "make_world", make_world)
    monkeypatch.setattr(module, "FRAMES", ((0, 1), (5, 2)))
    pairs = module.stored_pairs(tmp_path, "some", model, 2, 500)
    assert made == [500, 501]
    assert pairs.errors.shape == (4, 6)
    np.testing.assert_array_equal(pairs.worlds, [0, 0, 1, 1])
    np.testing.assert_array_equal(pairs.gaps, [1, -3, 1, -3])
    for error, T in zip(pairs.errors, pairs.Ts_target_source, strict=True):
        np.testing.assert_allclose(np.linalg.norm(error[3:]), np.linalg.norm(np.linalg.inv(T)[:3, 3]), rtol=0.2, atol=1e-6)
    monkeypatch.setattr(module, "solved_pairs", None)
    for first, again in zip(jax.tree.leaves(pairs), jax.tree.leaves(module.stored_pairs(tmp_path, "some", model, 2, 500)), strict=True):
        np.testing.assert_array_equal(first, again)


def test_fingerprint_tells_networks_apart_but_not_calibrations(model):
    """Oracle: what a pair's solution depends on."""
    from dataclasses import replace

    other = delo.init(PRESETS["tiny"].model, jax.random.key(1))
    calibrated = replace(model, cfg=replace(model.cfg, evidence=replace(model.cfg.evidence, covariance_width=8)))
    assert module.fingerprint(model, 1) == module.fingerprint(calibrated, 1)
    assert len({module.fingerprint(model, 1), module.fingerprint(model, 2), module.fingerprint(other, 1)}) == 3
