"""Batch and layer normalisation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delo_jax.model.normalization import BatchNorm, LayerNorm
from tests.oracles.agreement import assert_gradient_is_the_slope, assert_transforms_agree
from tests.oracles.weights import random_variables

CHANNELS = 5


def random_batch(seed, *, dtype=np.float32, sizes=(7, 7, 7, 7), shape=(7, 3)):
    """Items off-centre by tens of metres, of which the first `sizes` rows are valid."""
    rng = np.random.default_rng(seed)
    x = rng.normal(loc=30.0, scale=rng.uniform(1, 9, size=CHANNELS), size=(len(sizes), *shape, CHANNELS))
    mask = (np.arange(shape[0]) < np.array(sizes)[:, None]).reshape(len(sizes), shape[0], *(1 for _ in shape[1:]))
    return jnp.asarray(x.astype(dtype)), jnp.asarray(np.broadcast_to(mask, x.shape[:-1]))


def train_step(variables, x, mask, **options):
    """Outputs and new running statistics of a batch, as training calls it."""

    def apply(x, mask):
        return BatchNorm(train=True, **options).apply(variables, x, mask, mutable=["batch_stats"])

    return jax.vmap(apply, out_axes=(0, None), axis_name="batch")(x, mask)


def variables_for(x, mask, **options):
    return random_variables(BatchNorm(train=True), x[0], mask[0], **options)


def formula(variables, x, mask):
    """The batch normalised as one list of valid entries, and the running statistics after it, in float64."""
    params, old = (jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), variables[name]) for name in ("params", "batch_stats"))
    entries = np.asarray(x, np.float64)[np.asarray(mask)]
    normal = (np.asarray(x, np.float64) - entries.mean(0)) / np.sqrt(entries.var(0) + 1e-5)
    new = {"mean": 0.9 * old["mean"] + 0.1 * entries.mean(0), "var": 0.9 * old["var"] + 0.1 * entries.var(0, ddof=1)}
    return normal * params["scale"] + params["bias"], new


@pytest.mark.parametrize("sizes", [(7, 7, 7, 7), (7, 2, 0, 5)])
def test_training_normalises_by_all_valid_points_of_the_batch(sizes):
    """Oracle: NumPy's mean, var and unbiased var of the valid entries in one list."""
    x, mask = random_batch(0, sizes=sizes)
    variables = variables_for(x, mask)
    y, new = train_step(variables, x, mask)
    expected, expected_new = formula(variables, x, mask)
    np.testing.assert_allclose(y[mask], expected[np.asarray(mask)], atol=2e-5)  # 30 m at float32's 6e-8, over 1 m
    for name in ("mean", "var"):
        np.testing.assert_allclose(new["batch_stats"][name], expected_new[name], rtol=1e-5)


def test_one_number_per_channel_is_normalised_over_the_items():
    """Oracle: NumPy's mean and var over the items."""
    x = jnp.asarray(np.random.default_rng(0).normal(size=(6, CHANNELS)).astype(np.float32))
    mask = jnp.ones(6, bool)
    variables = variables_for(x, mask)
    expected, _ = formula(variables, x, mask)
    np.testing.assert_allclose(train_step(variables, x, mask)[0], expected, atol=1e-5)


def test_an_item_on_its_own_needs_no_axis():
    """Oracle: NumPy's mean and var of the item."""
    x, mask = random_batch(1, sizes=(5,))
    variables = variables_for(x, mask)
    y, _ = BatchNorm(train=True, axis_name=None).apply(variables, x[0], mask[0], mutable=["batch_stats"])
    np.testing.assert_allclose(y[mask[0]], formula(variables, x, mask)[0][np.asarray(mask)], atol=2e-5)


def test_inference_uses_the_running_statistics_alone():
    """Oracle: the formula with the stored numbers; jit and vmap without any axis name."""
    x, mask = random_batch(2)
    variables = variables_for(x, mask)
    params, stats = jax.tree.map(np.asarray, (variables["params"], variables["batch_stats"]))

    def apply(x, mask):
        return BatchNorm(train=False).apply(variables, x, mask)

    expected = (np.asarray(x[0]) - stats["mean"]) / np.sqrt(stats["var"] + 1e-5)
    np.testing.assert_allclose(apply(x[0], mask[0]), expected * params["scale"] + params["bias"], rtol=1e-5, atol=1e-5)
    assert_transforms_agree(apply, x, mask, rtol=1e-5, atol=1e-5)


def test_training_is_the_same_under_jit():
    """Oracle: the same step without jit."""
    x, mask = random_batch(3, sizes=(7, 1, 0, 5))
    variables = variables_for(x, mask)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=2e-5),
        jax.jit(train_step)(variables, x, mask),
        train_step(variables, x, mask),
    )


def test_padding_is_inert():
    """Oracle: the same batch with garbage, up to infinity, where it is masked."""
    x, mask = random_batch(4, sizes=(7, 2, 0, 5))
    variables = variables_for(x, mask)
    for garbage in (1e6, jnp.inf, jnp.nan):
        y, new = train_step(variables, jnp.where(mask[..., None], x, garbage), mask)
        clean, clean_new = train_step(variables, x, mask)
        assert np.all(np.isfinite(y))
        np.testing.assert_array_equal(y[mask], clean[mask])
        jax.tree.map(np.testing.assert_array_equal, new, clean_new)


@pytest.mark.parametrize(("num_valid", "mean_moves"), [(0, False), (1, True)])
def test_a_batch_too_small_for_statistics_is_finite(num_valid, mean_moves):
    """Oracle: the definitions: no entry has no mean, one entry no unbiased variance, and torch refuses both."""
    x, mask = random_batch(5, sizes=(num_valid, 0), shape=(4,))
    variables = variables_for(x, mask)
    y, new = train_step(variables, x, mask)
    assert np.all(np.isfinite(y))
    assert np.all(np.isfinite(jax.grad(lambda x: jnp.sum(train_step(variables, x, mask)[0] ** 2))(x)))
    np.testing.assert_array_equal(new["batch_stats"]["var"], variables["batch_stats"]["var"])
    assert np.all((new["batch_stats"]["mean"] != variables["batch_stats"]["mean"]) == mean_moves)


def test_init_needs_no_axis_and_starts_neutral():
    """Oracle: torch's starting values: scale 1, bias 0, running mean 0, running variance 1."""
    x, mask = random_batch(6)
    variables = BatchNorm(train=True).init(jax.random.key(0), x[0], mask[0])
    starts = {"scale": 1.0, "bias": 0.0, "mean": 0.0, "var": 1.0}
    for name, value in {**variables["params"], **variables["batch_stats"]}.items():
        np.testing.assert_array_equal(value, np.full(CHANNELS, starts[name]))


def test_batch_norm_gradient_is_the_slope():
    """Oracle: central differences in x64, through the statistics of the batch."""
    with jax.enable_x64(True):
        x, mask = random_batch(7, dtype=np.float64, sizes=(7, 2, 0, 5))
        variables = variables_for(x, mask, dtype=np.float64)
        probe = jnp.asarray(np.random.default_rng(7).normal(size=x.shape)) * mask[..., None]

        def loss(x, scale, bias):
            return jnp.sum(probe * train_step({**variables, "params": {"scale": scale, "bias": bias}}, x, mask)[0])

        assert_gradient_is_the_slope(loss, [x, *(variables["params"][name] for name in ("scale", "bias"))])


def layer_norm(variables, x):
    return LayerNorm().apply(variables, x)


@pytest.mark.parametrize("shape", [(6,), (4, 6), (4, 3, 6)])
def test_layer_norm_is_its_formula(shape):
    """Oracle: (x - mean) / (std + 1e-6) * scale + bias with NumPy's unbiased std in float64."""
    x = np.random.default_rng(8).normal(loc=3.0, size=shape)
    variables = random_variables(LayerNorm(), jnp.zeros(6))
    params = jax.tree.map(np.asarray, variables["params"])
    expected = (x - x.mean(-1, keepdims=True)) / (x.std(-1, ddof=1, keepdims=True) + 1e-6) * params["scale"] + params["bias"]
    np.testing.assert_allclose(layer_norm(variables, jnp.asarray(x.astype(np.float32))), expected, atol=1e-5)


def test_layer_norm_of_a_constant_row_is_its_bias():
    """Oracle: the formula's limit; the gradient, where torch's is NaN, is finite."""
    variables = random_variables(LayerNorm(), jnp.zeros(6))
    x = jnp.full((2, 6), 0.5)
    np.testing.assert_allclose(layer_norm(variables, x), np.tile(variables["params"]["bias"], (2, 1)), atol=1e-6)
    assert np.all(np.isfinite(jax.grad(lambda x: jnp.sum(layer_norm(variables, x) ** 2))(x)))


def test_layer_norm_gradient_is_the_slope():
    """Oracle: central differences in x64."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(9)
        probe = jnp.asarray(rng.normal(size=(4, 6)))

        def loss(x, scale, bias):
            return jnp.sum(probe * layer_norm({"params": {"scale": scale, "bias": bias}}, x))

        assert_gradient_is_the_slope(loss, [rng.normal(size=(4, 6)), rng.normal(size=6), rng.normal(size=6)])


def test_layer_norm_transforms_agree():
    """Oracle: jit(vmap) against a Python loop."""
    variables = random_variables(LayerNorm(), jnp.zeros(6))
    assert_transforms_agree(lambda x: layer_norm(variables, x), jnp.asarray(np.random.default_rng(10).normal(size=(3, 4, 6)), jnp.float32))
