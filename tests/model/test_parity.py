"""The published network at full size against its PyTorch twin with the same random weights."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delo_jax.model.attention import CoContext, MultiHeadAttention
from delo_jax.model.dgcnn import DGCNN
from delo_jax.model.evidential import PoseEvidenceHead
from delo_jax.model.normalization import BatchNorm
from delo_jax.ops.knn import knn
from tests.oracles.weights import random_variables

N, D = 1024, 512
WITHOUT_TORCH = "needs PyTorch: run `pip install '.[parity]'`, a CPU build suffices"


@pytest.fixture(scope="module")
def published():
    """The oracle's module; imported here, so that only this file needs torch."""
    pytest.importorskip("torch", reason=WITHOUT_TORCH)
    from tests.oracles import published

    return published


def assert_close(got, expected, rtol=1e-4):
    """Largest difference over the largest value: rounding of a deep float32 network goes with the scale of its layers."""
    error = np.abs(np.asarray(got, np.float64) - expected).max() / np.abs(expected).max()
    assert error < rtol, f"relative error {error:.1e}"


MASK = jnp.ones(N, bool)
POSE6 = jnp.array([0.01, -0.02, 0.05, 1.3, -0.2, 0.03])
ENCODER, CONTEXT, EVIDENCE = DGCNN(train=False), CoContext(num_heads=4, hidden=1024), PoseEvidenceHead(train=False)


@pytest.fixture(scope="module")
def variables():
    """Random weights and running statistics of the three blocks; scores of a few units, so that the plan is soft."""
    rows, index = jnp.zeros((N, D)), jnp.zeros((N, 20), jnp.int32)
    encoder = random_variables(ENCODER, jnp.zeros((N, 3)), index, MASK, seed=1)
    encoder["params"]["norm_out"] = jax.tree.map(lambda leaf: 0.1 * leaf, encoder["params"]["norm_out"])
    return {
        "encoder": encoder,
        "co_context": random_variables(CONTEXT, rows, rows, MASK, MASK, seed=2),
        "evidence_head": random_variables(EVIDENCE, rows, rows, MASK, MASK, POSE6, seed=3),
    }


@pytest.fixture(scope="module")
def twin(published, variables):
    """The PyTorch network with our weights."""
    network = published.PublishedDelo()
    collections = ("params", "batch_stats")
    published.load(network, {name: {block: leaves[name] for block, leaves in variables.items() if name in leaves} for name in collections})
    return network


@pytest.fixture(scope="module")
def pair(published):
    """Source and target points."""
    from tests.oracles import parity

    return parity.street_pair(0)


@pytest.fixture(scope="module")
def answer(twin, pair):
    """All of the twin's intermediate results."""
    return twin(*pair)


def test_the_twin_has_the_published_size(twin, published):
    """Oracle: the counts of the authors' model."""
    counts = [published.num_weights(module) for module in (twin.encoder, twin.context, twin.evidence)]
    assert counts == [309_632, 5_259_264, 330_632]


def test_features_and_embeddings_at_full_size(variables, pair, answer):
    """Oracle: the PyTorch twin in float64, on neighbours that it finds itself; ours chained in float32."""

    @jax.jit
    def features(points):
        return ENCODER.apply(variables["encoder"], points, knn(points, MASK, 20), MASK)

    source, target = (features(jnp.asarray(points)) for points in pair)
    assert_close(source, answer.source_features)
    assert_close(target, answer.target_features)
    embeddings = jax.jit(CONTEXT.apply)(variables["co_context"], source, target, MASK, MASK)
    assert_close(embeddings[0], answer.source_embeddings)
    assert_close(embeddings[1], answer.target_embeddings)


def test_pointer_alone_at_full_size(published, variables, twin):
    """Oracle: the PyTorch twin's transformer without the residual, on features of unit variance, where it shows undiluted."""
    torch = pytest.importorskip("torch", reason=WITHOUT_TORCH)
    phi = [np.random.default_rng(seed).normal(size=(N, D)).astype(np.float32) for seed in (4, 5)]
    with torch.no_grad():
        expected = twin.context(*(torch.as_tensor(rows).double() for rows in phi)).numpy()
    embedding, _ = jax.jit(CONTEXT.apply)(variables["co_context"], *phi, MASK, MASK)
    assert_close(np.asarray(embedding) - phi[0], expected)


def test_raw_evidence_at_full_size(variables, answer):
    """Oracle: the PyTorch twin in float64, embeddings and pose its own."""
    embeddings = [jnp.asarray(rows, jnp.float32) for rows in (answer.source_embeddings, answer.target_embeddings)]
    raw = jax.jit(EVIDENCE.apply)(variables["evidence_head"], *embeddings, MASK, MASK, jnp.asarray(answer.pose6, jnp.float32))
    assert_close(raw, answer.raw)


@pytest.mark.parametrize(("shape", "layer"), [((6, 5), "BatchNorm1d"), ((3, 5, 7, 4), "BatchNorm2d")])
def test_batch_norm_trains_as_torch_does(published, shape, layer):
    """Oracle: torch's layer in training mode: outputs and new running statistics, two steps in a row."""
    torch = pytest.importorskip("torch", reason=WITHOUT_TORCH)
    module = BatchNorm(train=True)
    batches = np.random.default_rng(6).normal(loc=2.0, scale=3.0, size=(2, *shape)).astype(np.float32)  # channels second, as in torch
    ours = [jnp.asarray(np.moveaxis(x, 1, -1)) for x in batches]
    mask = jnp.ones(ours[0].shape[:-1], bool)
    variables = random_variables(module, ours[0][0], mask[0])
    norm = getattr(torch.nn, layer)(5).double().train()
    published.load_norm(norm, variables["params"], variables["batch_stats"])

    @functools.partial(jax.vmap, in_axes=(None, 0, 0), out_axes=(0, None), axis_name="batch")
    def step(variables, x, mask):
        return module.apply(variables, x, mask, mutable=["batch_stats"])

    for x, x_torch in zip(ours, batches, strict=True):
        y, new = step(variables, x, mask)
        variables = {**variables, **new}
        np.testing.assert_allclose(y, np.moveaxis(norm(torch.as_tensor(x_torch).double()).detach().numpy(), 1, -1), atol=1e-5)
        np.testing.assert_allclose(new["batch_stats"]["mean"], norm.running_mean, rtol=1e-5)
        np.testing.assert_allclose(new["batch_stats"]["var"], norm.running_var, rtol=1e-5)


@pytest.mark.parametrize("num_valid", [9, 5])
def test_attention_is_torch_attention(published, num_valid):
    """Oracle: torch.nn.MultiheadAttention with a key padding mask."""
    torch = pytest.importorskip("torch", reason=WITHOUT_TORCH)
    x = np.random.default_rng(7).normal(size=(9, 8)).astype(np.float32)
    mask = np.arange(9) < num_valid
    module = MultiHeadAttention(num_heads=4)
    variables = random_variables(module, jnp.asarray(x), jnp.asarray(mask))
    attention = torch.nn.MultiheadAttention(8, 4, batch_first=True).eval()
    published.load_attention(attention, variables["params"])
    rows = torch.as_tensor(x)[None]
    with torch.no_grad():
        expected, _ = attention(rows, rows, rows, key_padding_mask=torch.as_tensor(~mask)[None], need_weights=False)
    np.testing.assert_allclose(module.apply(variables, jnp.asarray(x), jnp.asarray(mask)), expected[0].numpy(), atol=1e-5)


def test_the_twins_heads_agree_where_they_must(answer, twin, pair, published):
    """Oracle: POT's entropic partial transport for Dykstra's plan; at mass 1 and no round, the start is DCP's pointer."""
    ot = pytest.importorskip("ot", reason="needs POT: run `pip install '.[test]'`")
    torch = pytest.importorskip("torch", reason=WITHOUT_TORCH)
    cost = np.random.default_rng(8).uniform(size=(9, 12))
    expected = ot.partial.entropic_partial_wasserstein(
        np.full(9, 1 / 9), np.full(12, 1 / 12), cost, reg=0.1, m=0.4, numItermax=7, stopThr=0.0
    )
    np.testing.assert_allclose(published.dykstra_transport(torch.as_tensor(cost), 0.1, 0.4, 7), expected, atol=1e-13)
    start, pointer = twin(*pair, num_iters=0), twin(*pair, head="pointer")
    np.testing.assert_allclose(start.plan, pointer.plan, atol=1e-15)
    np.testing.assert_allclose(start.T_target_source, pointer.T_target_source, atol=1e-9)


@pytest.mark.parametrize("preset", ["official", "dcp", "paper"])
def test_preset_agrees_from_points_to_pose(published, preset):
    """Oracle: the PyTorch twin in float64 with the same random weights; rounding of a deep float32 network, 1e-4 of the scale.

    The plan is soft and the scores are not small, so that neither hides an error of the other.
    """
    from tests.oracles import parity

    differences = parity.compare(preset)
    names = ["features", "embeddings"]
    assert {f"{cloud} {name}" for cloud in ("source", "target") for name in names} | {"scores", "plan", "T_target_source"} <= set(
        differences
    )
    assert ("beta" in differences) == (preset != "dcp")
    assert {name: value for name, value in differences.items() if not value < 1e-4} == {}
