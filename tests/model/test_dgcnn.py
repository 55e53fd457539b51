"""The published encoder: a chain of per-edge layers on a static neighbour graph."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from delo_jax.model.dgcnn import DGCNN
from tests.oracles.agreement import assert_gradient_is_the_slope, assert_transforms_agree
from tests.oracles.weights import num_weights, random_variables

K, NEIGHBORS, VALID = 24, 5, 19
SMALL = {"width": 4, "embedding_dim": 12}
RELATIVE = {"edges": "relative", "edge_scale_m": 4.0, "position_scale_m": 30.0}
MASK = jnp.arange(K) < VALID


def cloud(seed, *, num_valid=VALID):
    """Points within tens of metres, the neighbours of the valid ones among themselves, a mask; padding refers to itself."""
    points = np.random.default_rng(seed).normal(scale=15.0, size=(K, 3)).astype(np.float32)
    index = np.tile(np.arange(K)[:, None], (1, NEIGHBORS))
    if num_valid:
        index[:num_valid] = cKDTree(points[:num_valid]).query(points[:num_valid], k=NEIGHBORS)[1]
    return jnp.asarray(points), jnp.asarray(index.astype(np.int32)), jnp.arange(K) < num_valid


def module(*, train=False, **options):
    return DGCNN(train=train, **SMALL, **options)


def variables_for(**options):
    return random_variables(module(**options), *cloud(0))


VARIABLES = variables_for()


def normalized(entries, statistics, params, stats):
    """Rows (edges or points) through a batch normalisation and a ReLU, with their own statistics or the running ones."""
    mean, var = (entries.mean(0), entries.var(0)) if statistics == "batch" else (stats["mean"], stats["var"])
    return np.maximum((entries - mean) / np.sqrt(var + 1e-5) * params["scale"] + params["bias"], 0.0)


def formula(variables, clouds, *, statistics, first=lambda x_j, x_i: x_j, position_scale_m=1.0):
    """Features of the valid points of all clouds in one list: edge by edge, in float64."""
    params, stats = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), (variables["params"], variables["batch_stats"]))
    rows: list[np.ndarray] = []
    for points, index, mask in clouds:
        x = np.asarray(points, np.float64)
        for i in np.flatnonzero(mask):
            rows += [np.concatenate([first(x[j], x[i]), x[i]]) / position_scale_m for j in np.asarray(index)[i]]
    edges, levels = np.stack(rows), []
    for level in range(4):
        edges = normalized(edges @ params[f"conv_{level}"]["kernel"], statistics, params[f"norm_{level}"], stats[f"norm_{level}"])
        levels.append(edges.reshape(-1, NEIGHBORS, edges.shape[1]).max(axis=1))
    out = np.concatenate(levels, axis=1) @ params["conv_out"]["kernel"]
    return normalized(out, statistics, params["norm_out"], stats["norm_out"])


@pytest.mark.parametrize("edges", ["absolute", "relative"])
def test_features_are_the_published_formula(edges):
    """Oracle: NumPy in float64, edge by edge, with the running statistics; padding is zero."""
    points, index, mask = cloud(1)
    options = RELATIVE if edges == "relative" else {}
    first = (lambda x_j, x_i: (x_j - x_i) * (30.0 / 4.0)) if edges == "relative" else (lambda x_j, x_i: x_j)
    expected = formula(
        VARIABLES, [(points, index, mask)], statistics="running", first=first, position_scale_m=options.get("position_scale_m", 1.0)
    )
    features = module(**options).apply(VARIABLES, points, index, mask)
    np.testing.assert_allclose(features[:VALID], expected, atol=1e-5 * np.abs(expected).max())
    assert not np.any(features[VALID:])


@jax.jit
def train_step(variables, points, index, mask):
    """Features and new running statistics of a batch, as training calls it."""

    def apply(*item):
        return module(train=True).apply(variables, *item, mutable=["batch_stats"])

    return jax.vmap(apply, out_axes=(0, None), axis_name="batch")(points, index, mask)


def test_training_normalises_over_the_edges_of_the_batch():
    """Oracle: NumPy in float64 with the mean and variance of all valid edges of clouds of different size."""
    clouds = [cloud(2), cloud(3, num_valid=9), cloud(4, num_valid=0)]
    features, _ = train_step(VARIABLES, *map(jnp.stack, zip(*clouds, strict=True)))
    expected = formula(VARIABLES, clouds, statistics="batch")
    got = np.concatenate([features[0, :VALID], features[1, :9]])
    np.testing.assert_allclose(got, expected, atol=1e-4)  # 15 m over a spread of some metres, five normalisations deep
    assert not np.any(features[2])


def test_published_weight_count():
    """Oracle: the count of the authors' model."""
    points, index, mask = jnp.zeros((4, 3)), jnp.zeros((4, 20), jnp.int32), jnp.ones(4, bool)
    assert num_weights(DGCNN(train=False), points, index, mask) == 309_632


@pytest.mark.parametrize("garbage", [1e6, np.inf, np.nan])
def test_padding_is_inert(garbage):
    """Oracle: the same cloud with other padding, in inference and in training."""
    points, index, mask = cloud(5)
    dirty = jnp.where(mask[:, None], points, garbage)
    np.testing.assert_allclose(module().apply(VARIABLES, dirty, index, mask), module().apply(VARIABLES, points, index, mask), atol=1e-6)
    trained, expected = (train_step(VARIABLES, cloud[None], index[None], mask[None]) for cloud in (dirty, points))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), trained, expected)


def test_points_are_a_set():
    """Oracle: permutation equivariance; the order of the neighbours is free as well."""
    points, index, mask = cloud(6)
    rng = np.random.default_rng(6)
    order, columns = rng.permutation(K), rng.permutation(NEIGHBORS)
    new_place = np.argsort(order).astype(np.int32)
    expected = module().apply(VARIABLES, points, index, mask)[order]
    got = module().apply(VARIABLES, points[order], jnp.asarray(new_place)[index[order]][:, columns], mask[order])
    np.testing.assert_allclose(got, expected, atol=1e-4)


def test_relative_edges_see_a_shift_only_through_the_centre():
    """Oracle: symmetry: without the weights of the centre, a shifted cloud has the same features."""
    points, index, mask = cloud(7)
    kernel = VARIABLES["params"]["conv_0"]["kernel"].at[3:].set(0.0)
    variables = {**VARIABLES, "params": {**VARIABLES["params"], "conv_0": {"kernel": kernel}}}
    moved, still = (module(**RELATIVE).apply(variables, cloud, index, mask) for cloud in (points + 8.0, points))
    np.testing.assert_allclose(moved, still, atol=1e-4)


def test_an_unknown_kind_of_edge_is_refused():
    """Oracle: the two kinds that are documented."""
    with pytest.raises(ValueError, match="edges: expected 'absolute' or 'relative', got 'both'"):
        module(edges="both").init(jax.random.key(0), *cloud(0))


def test_transforms_agree():
    """Oracle: jit(vmap) against a Python loop."""
    batch = map(jnp.stack, zip(*[cloud(seed) for seed in range(3)], strict=True))
    assert_transforms_agree(lambda *item: module().apply(VARIABLES, *item), *batch, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("sizes", [(VALID, 9), (VALID, 0), (0, 0), (1, 0)])
def test_training_gradients_are_finite(sizes):
    """Oracle: finiteness, with clouds of padding alone and a single point."""
    batch = [jnp.stack(leaves) for leaves in zip(*[cloud(8, num_valid=size) for size in sizes], strict=True)]

    def loss(params, points):
        features, _ = train_step({**VARIABLES, "params": params}, points, *batch[1:])
        return jnp.sum(features**2)

    gradients = jax.jit(jax.grad(loss, argnums=(0, 1)))(VARIABLES["params"], batch[0])
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradients))


def test_gradient_is_the_slope():
    """Oracle: central differences in x64, through the points and a layer's weights, padding included."""
    with jax.enable_x64(True):
        points, index, mask = cloud(3)
        variables = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), VARIABLES)
        probe = jnp.asarray(np.random.default_rng(1).normal(size=(K, SMALL["embedding_dim"])))

        def loss(points, kernel):
            params = {**variables["params"], "conv_1": {"kernel": kernel}}
            return jnp.sum(probe * module().apply({**variables, "params": params}, points, index, mask))

        assert_gradient_is_the_slope(loss, [np.asarray(points, float), variables["params"]["conv_1"]["kernel"]], rtol=1e-5)
