"""Consistency weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from delo_jax.ops.consistency import consistency_weights
from tests.oracles.agreement import assert_gradient_is_the_slope, assert_transforms_agree


def matches(seed, k=40, num_right=15):
    """Matches of which the first `num_right` follow one rigid motion, up to 5 cm."""
    rng = np.random.default_rng(seed)
    source = rng.uniform(-30, 30, size=(k, 3))
    target = source @ Rotation.random(rng=rng).as_matrix().T + [5, 1, 0]
    target[num_right:] = rng.uniform(-30, 30, size=(k - num_right, 3))
    return source, target + 0.05 * rng.normal(size=(k, 3)), rng.uniform(0.5, 1, size=k)


def as_float32(arrays):
    return [jnp.asarray(array, jnp.float32) for array in arrays]


@pytest.mark.parametrize("seed", range(3))
def test_weights_are_the_squared_leading_eigenvector(seed):
    """Oracle: cdist and np.linalg.eigh in float64; 60 power iterations."""
    source, target, weights = matches(seed)
    source[1] = source[0] + 0.3  # a pair too close to say anything
    lengths = cdist(source, source), cdist(target, target)
    A = np.maximum(1 - ((lengths[1] - lengths[0]) / 0.8) ** 2, 0) * np.sqrt(np.outer(weights, weights))
    A[np.minimum(*lengths) < 1.0] = 0
    leading = np.linalg.eigh(A)[1][:, -1]
    found = jax.jit(lambda *x: consistency_weights(*x, num_iters=60))(*as_float32((source, target, weights)))
    np.testing.assert_allclose(found, leading**2, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_right_matches_stand_out(seed):
    """Oracle: which matches were made right; 15 of 40, at the default number of iterations."""
    found = consistency_weights(*as_float32(matches(seed)))
    assert float(jnp.sum(found)) == pytest.approx(1, abs=1e-6)
    assert float(jnp.sum(found[:15])) > 0.98


def test_scale_of_the_weights_does_not_matter():
    """Oracle: symmetry; down to 1e-30, where squares underflow."""
    source, target, weights = as_float32(matches(0))
    expected = consistency_weights(source, target, weights)
    for factor in (1e-30, 1e30):
        np.testing.assert_allclose(consistency_weights(source, target, factor * weights), expected, atol=1e-6)


def test_gradient_is_the_slope():
    """Oracle: central differences in x64."""
    with jax.enable_x64(True):
        probe = jnp.arange(40.0)
        assert_gradient_is_the_slope(lambda *x: jnp.sum(probe * consistency_weights(*x)), matches(0), rtol=1e-5)


def test_weights_under_jit_and_vmap():
    """Oracle: the same function, one problem at a time, not compiled."""
    batches = [np.stack(x) for x in zip(*map(matches, range(3)), strict=True)]
    assert_transforms_agree(consistency_weights, *as_float32(batches), rtol=1e-4)


@pytest.mark.parametrize("case", ["zero weights", "one match", "one place", "no agreement"])
def test_no_consistent_pair_gives_zeros(case):
    """Oracle: the documented answer, with finite gradients even where points coincide."""
    source, target, weights = as_float32(matches(0))
    if case == "zero weights":
        weights = 0 * weights
    elif case == "one match":
        weights = weights.at[1:].set(0)
    elif case == "one place":
        source = 0 * source
    else:
        target = 10 * source
    np.testing.assert_array_equal(consistency_weights(source, target, weights), np.zeros(40))
    assert all(np.all(np.isfinite(gradient)) for gradient in gradients(source, target, weights))


gradients = jax.jit(jax.grad(lambda *x: jnp.sum(jnp.arange(40.0) * consistency_weights(*x)), argnums=(0, 1, 2)))
