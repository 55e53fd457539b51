"""The published evidence head: raw parameters from both clouds' embeddings and the pose."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from delo_jax.model.evidential import PoseEvidenceHead
from tests.oracles.agreement import assert_gradient_is_the_slope, assert_transforms_agree
from tests.oracles.weights import num_weights, random_variables

N, M, D = 6, 8, 10
NUM_SOURCE, NUM_TARGET = 4, 5


def pair(seed, *, num_source=NUM_SOURCE, num_target=NUM_TARGET, dtype=np.float32):
    """Arguments of the head; the padded rows hold large numbers, which a maximum would take."""
    rng = np.random.default_rng(seed)
    masks = np.arange(N) < num_source, np.arange(M) < num_target
    embeddings = [np.where(mask[:, None], rng.normal(size=(len(mask), D)), 1e3).astype(dtype) for mask in masks]
    return *map(jnp.asarray, embeddings), *map(jnp.asarray, masks), jnp.asarray(rng.normal(size=6).astype(dtype))


VARIABLES = random_variables(PoseEvidenceHead(train=False), *pair(0))


def apply(*arguments, variables=VARIABLES):
    return PoseEvidenceHead(train=False).apply(variables, *arguments)


@jax.jit
def train_step(variables, *batch):
    """Raw evidence and new running statistics of a batch, as training calls it."""

    def apply(*item):
        return PoseEvidenceHead(train=True).apply(variables, *item, mutable=["batch_stats"])

    return jax.vmap(apply, out_axes=(0, None), axis_name="batch")(*batch)


def batch_of(size, **options):
    return [jnp.stack(leaves) for leaves in zip(*[pair(seed, **options) for seed in range(size)], strict=True)]


def formula(variables, pairs, *, statistics):
    """All pairs as rows of matrices, in float64; pooled over the valid rows."""
    params, stats = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), (variables["params"], variables["batch_stats"]))

    def dense(x, name):
        return x @ params[name]["kernel"] + params[name]["bias"]

    def layer(x, name, level):
        x, norm = dense(x, f"{name}_{level}"), f"{name}_norm_{level}"
        mean, var = (x.mean(0), x.var(0)) if statistics == "batch" else (stats[norm]["mean"], stats[norm]["var"])
        return np.maximum((x - mean) / np.sqrt(var + 1e-5) * params[norm]["scale"] + params[norm]["bias"], 0.0)

    x = np.array(
        [np.concatenate([np.asarray(rows)[np.asarray(mask)].max(0) for rows, mask in zip(p[:2], p[2:4], strict=True)]) for p in pairs]
    )
    for level in range(3):
        x = layer(x, "pair", level)
    x = np.concatenate([dense(x, "pair_out"), [p[4] for p in pairs]], axis=1)
    for level in range(2):
        x = layer(x, "fusion", level)
    return dense(dense(x, "fusion_out"), "evidence")


def test_evidence_is_the_published_formula():
    """Oracle: NumPy in float64 with the running statistics."""
    np.testing.assert_allclose(apply(*pair(1)), formula(VARIABLES, [pair(1)], statistics="running")[0], atol=1e-5)


def test_training_normalises_over_the_pairs_of_the_batch():
    """Oracle: NumPy in float64 with the mean and variance of the batch."""
    expected = formula(VARIABLES, [pair(seed) for seed in range(5)], statistics="batch")
    np.testing.assert_allclose(train_step(VARIABLES, *batch_of(5))[0], expected, atol=1e-4)


def test_published_weight_count():
    """Oracle: the count of the authors' model."""
    rows, mask = jnp.zeros((4, 512)), jnp.ones(4, bool)
    assert num_weights(PoseEvidenceHead(train=False), rows, rows, mask, mask, jnp.zeros(6)) == 330_632


@pytest.mark.parametrize("garbage", [-1e6, np.inf, np.nan])
def test_padding_is_inert(garbage):
    """Oracle: the same pair with other padding."""
    source, target, source_mask, target_mask, pose6 = pair(2)
    dirty = jnp.where(source_mask[:, None], source, garbage), jnp.where(target_mask[:, None], target, garbage)
    np.testing.assert_allclose(apply(*dirty, source_mask, target_mask, pose6), apply(*pair(2)), atol=1e-6)


def test_points_are_a_set():
    """Oracle: invariance to the order of the points of either cloud."""
    source, target, source_mask, target_mask, pose6 = pair(3)
    rng = np.random.default_rng(3)
    rows, columns = rng.permutation(N), rng.permutation(M)
    got = apply(source[rows], target[columns], source_mask[rows], target_mask[columns], pose6)
    np.testing.assert_allclose(got, apply(*pair(3)), atol=1e-6)


def test_nothing_valid_counts_as_zero_features():
    """Oracle: a cloud whose one valid point has zero features."""
    source, target, _, target_mask, pose6 = pair(4)
    got = apply(source, target, jnp.zeros(N, bool), target_mask, pose6)
    expected = apply(jnp.zeros_like(source), target, jnp.arange(N) < 1, target_mask, pose6)
    np.testing.assert_allclose(got, expected, atol=1e-6)


def test_transforms_agree():
    """Oracle: jit(vmap) against a Python loop."""
    assert_transforms_agree(apply, *batch_of(3), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("size", "num_source"), [(1, NUM_SOURCE), (3, NUM_SOURCE), (3, 0), (1, 0)])
def test_training_is_finite(size, num_source):
    """Oracle: finiteness of value, statistics and gradient, for a batch of one and clouds of padding alone."""
    batch = batch_of(size, num_source=num_source)

    def loss(params, source, target, pose6):
        raw, new = train_step({**VARIABLES, "params": params}, source, target, *batch[2:4], pose6)
        return jnp.sum(raw**2), (raw, new)

    gradients, outputs = jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3), has_aux=True))(VARIABLES["params"], *batch[:2], batch[4])
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves((gradients, outputs)))


def test_gradient_is_the_slope():
    """Oracle: central differences in x64, through the statistics of the batch."""
    with jax.enable_x64(True):
        batch = batch_of(4, dtype=np.float64)
        weights, rebuild = ravel_pytree(jax.tree.map(lambda leaf: leaf.astype(jnp.float64), VARIABLES["params"]))
        probe = jnp.asarray(np.random.default_rng(9).normal(size=(4, 24)))

        def loss(source, target, pose6, weights):
            variables = {**VARIABLES, "params": rebuild(weights)}
            return jnp.sum(probe * train_step(variables, source, target, *batch[2:4], pose6)[0])

        assert_gradient_is_the_slope(loss, [*batch[:2], batch[4], weights], rtol=1e-5)
