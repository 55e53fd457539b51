"""The largest of several numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delo_jax.ops.pooling import largest


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_value_and_slope(axis):
    """Oracle: numpy's maximum, and central differences where no two entries are near each other."""
    rng = np.random.default_rng(axis)
    x = rng.permutation(60.0 * np.arange(60)).reshape(3, 4, 5)  # exact in float32
    weights = rng.normal(size=np.max(x, axis=axis).shape)
    found = jax.jit(largest, static_argnums=1)(jnp.asarray(x, jnp.float32), axis)
    np.testing.assert_array_equal(found, np.max(x, axis=axis).astype(np.float32))
    slope = jax.jit(jax.grad(lambda x: jnp.sum(largest(x, axis) * weights)))(jnp.asarray(x, jnp.float32))
    expected = np.zeros_like(x)
    for place in np.ndindex(*x.shape):
        step = np.zeros_like(x)
        step[place] = 1.0
        expected[place] = np.sum((np.max(x + step, axis=axis) - np.max(x - step, axis=axis)) * weights) / 2.0
    np.testing.assert_allclose(slope, expected, atol=1e-6)


def test_one_of_equals_takes_the_slope():
    """Oracle: by hand; and entries that are minus infinity, as masked ones are, do no harm."""
    x = jnp.array([[2.0, 2.0, -jnp.inf], [-jnp.inf, 1.0, 0.0]])
    np.testing.assert_array_equal(jax.grad(lambda x: jnp.sum(largest(x, 1)))(x), [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def test_vmapped():
    """Oracle: one by one."""
    x = jnp.asarray(np.random.default_rng(0).normal(size=(4, 3, 5)), jnp.float32)
    np.testing.assert_array_equal(jax.vmap(lambda one: largest(one, 0))(x), jnp.stack([largest(one, 0) for one in x]))
