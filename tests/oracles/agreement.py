"""Checks that every pure function must pass: transformations of it agree, its derivative is the slope."""

import jax
import jax.numpy as jnp
import numpy as np


def assert_transforms_agree(function, *batches, rtol=2e-5, atol=2e-6):
    """jit(vmap(f)) over the leading axis of `batches` equals a Python loop of the eager f, and of jit(f) on one item."""
    items = list(zip(*batches, strict=True))
    looped = jax.tree.map(lambda *leaves: np.stack(leaves), *[function(*item) for item in items])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=rtol, atol=atol), jax.jit(jax.vmap(function))(*batches), looped)
    first = jax.tree.map(lambda leaf: leaf[0], looped)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=rtol, atol=atol), jax.jit(function)(*items[0]), first)


def assert_gradient_is_the_slope(loss, arguments, *, step=1e-6, rtol=1e-6, atol=1e-8, seed=0):
    """Directional derivatives of `loss` by autodiff equal central differences; call it under x64."""
    arguments = [jnp.asarray(argument, jnp.float64) for argument in arguments]
    rng = np.random.default_rng(seed)
    loss = jax.jit(loss)
    gradients = jax.jit(jax.grad(loss, argnums=tuple(range(len(arguments)))))(*arguments)
    for i, gradient in enumerate(gradients):
        assert np.all(np.isfinite(gradient))
        direction = jnp.asarray(rng.normal(size=gradient.shape))
        moved = [[*arguments[:i], arguments[i] + sign * step * direction, *arguments[i + 1 :]] for sign in (1, -1)]
        slope = (loss(*moved[0]) - loss(*moved[1])) / (2 * step)
        np.testing.assert_allclose(jnp.sum(gradient * direction), slope, rtol=rtol, atol=atol)
