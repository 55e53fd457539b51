"""Random variables for tests of layers: nothing left at zero or one, where a missing bias or a swapped scale would not show."""

import jax
import jax.numpy as jnp
import numpy as np

RANDOM = {
    "kernel": lambda rng, shape: rng.normal(size=shape) * shape[0] ** -0.5,
    "scale": lambda rng, shape: rng.uniform(0.5, 1.5, size=shape),
    "bias": lambda rng, shape: rng.normal(scale=0.3, size=shape),
    "mean": lambda rng, shape: rng.normal(scale=0.3, size=shape),
    "var": lambda rng, shape: rng.uniform(0.5, 2.0, size=shape),
}


def shapes(module, *arguments):
    """The variables of a module by `jax.eval_shape`: nothing is computed."""
    return jax.eval_shape(module.init, jax.random.key(0), *arguments)


def random_variables(module, *arguments, seed=0, dtype=np.float32):
    """Parameters and running statistics of the right shapes with random values."""
    rng = np.random.default_rng(seed)
    return jax.tree_util.tree_map_with_path(
        lambda path, leaf: jnp.asarray(RANDOM[path[-1].key](rng, leaf.shape).astype(dtype)), shapes(module, *arguments)
    )


def num_weights(module, *arguments):
    """Number of trained weights."""
    return sum(leaf.size for leaf in jax.tree.leaves(shapes(module, *arguments)["params"]))
