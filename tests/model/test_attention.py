"""The transformer that puts each cloud's features in the context of the other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.special import softmax

from delo_jax.model.attention import CoContext
from tests.oracles.agreement import assert_gradient_is_the_slope, assert_transforms_agree
from tests.oracles.weights import num_weights, random_variables

MODULE = CoContext(num_heads=2, hidden=12)
N, M, D = 7, 9, 8


def clouds(seed, *, n=N, m=M, dtype=np.float32):
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.normal(size=(n, D)).astype(dtype)), jnp.asarray(rng.normal(size=(m, D)).astype(dtype))


SOURCE_MASK, TARGET_MASK = jnp.arange(N) < 5, jnp.arange(M) < 6
VARIABLES = random_variables(MODULE, *clouds(0), SOURCE_MASK, TARGET_MASK)


def apply(source, target, source_mask=SOURCE_MASK, target_mask=TARGET_MASK):
    return MODULE.apply(VARIABLES, source, target, source_mask, target_mask)


def affine(x, layer):
    return x @ layer["kernel"] + layer["bias"]


def layer_norm(x, layer):
    return (x - x.mean(-1, keepdims=True)) / (x.std(-1, ddof=1, keepdims=True) + 1e-6) * layer["scale"] + layer["bias"]


def attention(query, memory, layer):
    """One head at a time, without masks: the rows given are the valid ones."""
    q, k, v = affine(query, layer["query"]), affine(memory, layer["key"]), affine(memory, layer["value"])
    heads = []
    for columns in np.split(np.arange(D), MODULE.num_heads):
        weights = softmax(q[:, columns] @ k[:, columns].T / np.sqrt(len(columns)), axis=1)
        heads.append(weights @ v[:, columns])
    return affine(np.concatenate(heads, axis=1), layer["out"])


def feed_forward(x, layer):
    return affine(np.maximum(affine(x, layer["hidden"]), 0.0), layer["out"])


def pointer(y, x):
    """The published transformer: the decoder reads y, the encoder x."""
    weights = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), VARIABLES["params"])
    encoder, decoder = weights["encoder"], weights["decoder"]
    normal = layer_norm(x, encoder["attention_norm"])
    memory = x + attention(normal, normal, encoder["attention"])
    memory = memory + feed_forward(layer_norm(memory, encoder["feed_forward_norm"]), encoder["feed_forward"])
    memory = layer_norm(memory, encoder["norm"])
    normal = layer_norm(y, decoder["self_norm"])
    state = y + attention(normal, normal, decoder["self_attention"])
    state = state + attention(layer_norm(state, decoder["cross_norm"]), memory, decoder["cross_attention"])
    state = state + feed_forward(layer_norm(state, decoder["feed_forward_norm"]), decoder["feed_forward"])
    return layer_norm(state, decoder["norm"])


def test_embeddings_are_the_published_formula():
    """Oracle: the transformer in float64 NumPy, head by head, on the valid rows alone; masked rows are zero."""
    source, target = clouds(1)
    got_source, got_target = apply(source, target)
    y, x = np.asarray(source, np.float64)[:5], np.asarray(target, np.float64)[:6]
    np.testing.assert_allclose(got_source[:5], y + pointer(y, x), atol=2e-5)
    np.testing.assert_allclose(got_target[:6], x + pointer(x, y), atol=2e-5)
    assert not np.any(got_source[5:])
    assert not np.any(got_target[6:])


def test_published_weight_count():
    """Oracle: the count of the authors' model."""
    rows, mask = jnp.zeros((4, 512)), jnp.ones(4, bool)
    assert num_weights(CoContext(num_heads=4, hidden=1024), rows, rows, mask, mask) == 5_259_264


@pytest.mark.parametrize("garbage", [1e4, np.inf, np.nan])
def test_padding_is_inert(garbage):
    """Oracle: the same clouds with zeros in the padded rows."""
    source, target = clouds(2)
    dirty = jnp.where(SOURCE_MASK[:, None], source, garbage), jnp.where(TARGET_MASK[:, None], target, garbage)
    clean = jnp.where(SOURCE_MASK[:, None], source, 0.0), jnp.where(TARGET_MASK[:, None], target, 0.0)
    for a, b in zip(apply(*dirty), apply(*clean), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_clouds_are_sets():
    """Oracle: permutation equivariance of both clouds."""
    source, target = clouds(3)
    rng = np.random.default_rng(3)
    rows, columns = rng.permutation(N), rng.permutation(M)
    expected_source, expected_target = apply(source, target)
    got_source, got_target = apply(source[rows], target[columns], SOURCE_MASK[rows], TARGET_MASK[columns])
    np.testing.assert_allclose(got_source, expected_source[rows], atol=1e-5)
    np.testing.assert_allclose(got_target, expected_target[columns], atol=1e-5)


def test_both_directions_share_their_weights():
    """Oracle: symmetry: exchanging the clouds exchanges the answers."""
    source, target = clouds(4)
    there, back = apply(source, target), apply(target, source, TARGET_MASK, SOURCE_MASK)
    for a, b in zip(there, back[::-1], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_a_stream_keeps_one_context_per_cloud():
    """Oracle: the pairs one by one; each cloud is prepared once, apart from its neighbours."""
    first, second = clouds(5)
    third, _ = clouds(6)
    masks = [SOURCE_MASK, TARGET_MASK, SOURCE_MASK]
    prepare = jax.jit(lambda x, mask: MODULE.apply(VARIABLES, x, mask, method="prepare"))
    attend = jax.jit(lambda own, other: MODULE.apply(VARIABLES, own, other, method="attend"))
    contexts = [prepare(x, mask) for x, mask in zip((first, second, third), masks, strict=True)]
    for own, other, expected in [(0, 1, apply(first, second)), (2, 1, apply(third, second))]:
        np.testing.assert_allclose(attend(contexts[own], contexts[other]), expected[0], atol=1e-5)
        np.testing.assert_allclose(attend(contexts[other], contexts[own]), expected[1], atol=1e-5)


def test_transforms_agree():
    """Oracle: jit(vmap) against a Python loop."""
    rng = np.random.default_rng(7)
    batch = [jnp.asarray(rng.normal(size=(3, rows, D)), jnp.float32) for rows in (N, M)]
    assert_transforms_agree(apply, *batch, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("num_source", "num_target"), [(N, 0), (0, M), (0, 0)])
def test_a_cloud_of_padding_is_finite(num_source, num_target):
    """Oracle: finiteness, and zeros where masked; value and gradient."""
    masks = jnp.arange(N) < num_source, jnp.arange(M) < num_target

    @jax.jit
    def value_and_gradients(*pair):
        embeddings, vjp = jax.vjp(lambda source, target: apply(source, target, *masks), *pair)
        return embeddings, vjp(embeddings)

    embeddings, gradients = value_and_gradients(*clouds(8))
    assert all(np.all(np.isfinite(leaf)) for leaf in (*embeddings, *gradients))
    assert not np.any(embeddings[0][num_source:])
    assert not np.any(embeddings[1][num_target:])


def test_gradient_is_the_slope():
    """Oracle: central differences in x64, for clouds and weights."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(9)
        probes = [jnp.asarray(rng.normal(size=(rows, D))) for rows in (N, M)]
        weights, rebuild = ravel_pytree(jax.tree.map(lambda leaf: leaf.astype(jnp.float64), VARIABLES))

        def loss(source, target, weights):
            embeddings = MODULE.apply(rebuild(weights), source, target, SOURCE_MASK, TARGET_MASK)
            return sum(jnp.sum(probe * embedding) for probe, embedding in zip(probes, embeddings, strict=True))

        assert_gradient_is_the_slope(loss, [*clouds(9, dtype=np.float64), weights], rtol=1e-5)
