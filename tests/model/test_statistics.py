"""What the solver knows about its own answer."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delo_jax.model import fine
from delo_jax.model.statistics import _TABLE, NUM_STATISTICS, consensus, statistics
from tests.fixtures import TINY, T_street
from tests.oracles.street import pose

FINE = TINY.fine


def matches(seed, num=200, num_valid=150):
    """Matches with errors from millimetres to metres; the rows from `num_valid` on are padding."""
    rng = np.random.default_rng(seed)
    targets = rng.uniform(-30, 30, size=(num, 3))
    normals = rng.normal(size=(num, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = targets + rng.normal(size=(num, 3)) * 10 ** rng.uniform(-3, 0.3, size=(num, 1))
    distance, agreement = np.sum((points - targets) * normals, axis=1), rng.uniform(-0.5, 1, num)
    weights = np.where(np.arange(num) < num_valid, rng.uniform(0.05, 1, num), 0.0)
    return fine.Matches(*(jnp.asarray(a, jnp.float32) for a in (points, targets, normals, distance, agreement, weights, 0.01 * weights)))


def arguments(seed, **sizes):
    found = matches(seed, **sizes)
    T_delta, information = fine.step(found, cfg=FINE)
    T, apart = (jnp.asarray(P, jnp.float32) for P in (T_street(), pose(0.3, 0.0, 0.1, yaw_deg=2.0)))
    return found, information, T, T_delta, apart, jnp.asarray(0.4), jnp.asarray(0.2)


compiled = jax.jit(statistics)


@functools.cache
def expected(seed):
    """Every statistic by its name, in float64 NumPy, from the valid rows alone."""
    found, information, T, T_delta, apart, inlier_share, other = arguments(seed)
    valid = np.asarray(found.weights) > 0
    rows = fine.Matches(*(np.asarray(field, np.float64)[valid] for field in found))
    w, d, away = rows.weights, np.abs(rows.plane_distance), np.linalg.norm(rows.points - rows.targets, axis=1)
    score = np.mean(np.maximum(rows.agreement, 0) ** 2 / (1 + (d / 0.1) ** 2) / (1 + away**2))
    values = {"mean confidence": w.sum() / len(valid), "consensus": score, "consensus of the other hypothesis": 0.2}
    values["difference of the two"] = score - 0.2
    for share in ("25", "50", "75", "90"):
        values[f"plane distance, log10 of quantile .{share}"] = np.log10(np.quantile(d, int(share) / 100) + 1e-3)
    values["plane distance, log10 of weighted rms"] = np.log10(np.sqrt(np.average(d**2, weights=w)) + 1e-3)
    lever = np.diag([1 / 15.0] * 3 + [1.0] * 3)
    eigenvalues = np.linalg.eigvalsh(lever @ np.asarray(information, np.float64) @ lever) / w.sum()
    for number, eigenvalue in enumerate(eigenvalues, start=1):
        values[f"information, log10 of eigenvalue {number}"] = np.log10(max(eigenvalue, 1e-6))
    for name, P in (("last step", T_delta), ("between the hypotheses", apart), ("pose", T)):
        P = np.asarray(P, np.float64)
        angle = np.arctan2(np.linalg.norm([P[2, 1] - P[1, 2], P[0, 2] - P[2, 0], P[1, 0] - P[0, 1]]), np.trace(P[:3, :3]) - 1)
        values[f"{name}, log10 of translation"] = np.log10(np.linalg.norm(P[:3, 3]) + 1e-4)
        values[f"{name}, log10 of rotation times lever"] = np.log10(15.0 * angle + 1e-4)
    values |= {"inlier share of the coarse pose": 0.4, "mean agreement of normals": rows.agreement.mean(), "valid points": valid.sum()}
    return values


@pytest.mark.parametrize("seed", range(2))
def test_statistics_are_what_their_names_say(seed):
    """Oracle: NumPy in float64, statistic by statistic; float32 logarithms, over deviations of 0.03 and more."""
    found = compiled(*arguments(seed))
    assert found.shape == (NUM_STATISTICS,) == (len(expected(seed)),)
    names, means, deviations = zip(*_TABLE, strict=True)
    standardised = (np.array([expected(seed)[name] for name in names]) - means) / deviations
    np.testing.assert_allclose(found, standardised, rtol=1e-3, atol=2e-2)


def test_padding_has_no_say():
    """Oracle: symmetry; garbage in the padded rows leaves the bytes."""
    found, *rest = arguments(0)
    padded = found.weights == 0
    garbage = [jnp.where(padded.reshape(-1, *[1] * (field.ndim - 1)), 7.0, field) for field in found[:5]]
    other = fine.Matches(*garbage, *found[5:])
    assert np.array_equal(compiled(found, *rest), compiled(other, *rest))
    assert consensus(found) == consensus(other)


@pytest.mark.parametrize("num_valid", [0, 1, 2])
def test_hardly_any_match_is_finite(num_valid):
    """Oracle: finite numbers and slopes, from nothing too."""
    data = arguments(0, num_valid=num_valid)
    assert np.isfinite(compiled(*data)).all()
    gradients = jax.jit(jax.grad(lambda *x: jnp.sum(statistics(*x))))(*data)
    assert all(np.isfinite(leaf).all() for leaf in gradients)


def test_compiled_or_not():
    """Oracle: the same function, not compiled."""
    np.testing.assert_allclose(compiled(*arguments(1)), statistics(*arguments(1)), atol=2e-3)


def test_consensus_is_one_at_a_perfect_fit_and_falls_with_distance():
    """Oracle: by hand. On its plane and agreeing: 1; 10 cm off the plane: about a half; facing away: nothing."""
    perfect = matches(0)._replace(plane_distance=jnp.zeros(200), agreement=jnp.ones(200))
    perfect = perfect._replace(points=perfect.targets)
    assert consensus(perfect) == 1.0
    off = perfect._replace(plane_distance=jnp.full(200, -0.1), points=perfect.points + jnp.array([[0.0, 0.0, 0.1]]))
    assert consensus(off) == pytest.approx(0.5 / 1.01, rel=1e-3)
    assert consensus(perfect._replace(agreement=jnp.full(200, -1.0))) == 0.0
