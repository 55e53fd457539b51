"""The train step: it learns, leaves alone what is switched off, and survives scans without points."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delo_jax.train.loop import phases
from delo_jax.train.pairs import random_pair
from delo_jax.train.step import PairBatch, TrainState, make_optimizer, make_train_step
from tests.fixtures import TINY_TRAINING, street_world, tiny_model

CFG = dataclasses.replace(TINY_TRAINING, num_steps=60, num_evidence_steps=60, learning_rate=5e-3)
POSE = {"encoder", "matcher", "point_embedding", "edge_network"}


@functools.cache
def compiled(phase):
    """Config, optimiser and step of learning poses (0) or evidence (1)."""
    cfg, num_steps = phases(CFG)[phase]
    tx = make_optimizer(cfg, num_steps)
    return cfg, tx, make_train_step(cfg, tx)


def start(tx):
    """A state of its own: the step donates its buffers."""
    params = jax.tree.map(jnp.array, tiny_model().variables)
    return TrainState(params, tx.init(params), jnp.zeros((), jnp.int32))


def batch(*pairs):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *pairs)


@functools.cache
def pairs():
    return tuple(random_pair(street_world(CFG.model.preprocess), np.random.default_rng(seed)) for seed in range(2))


def without_points(scan):
    return scan._replace(mask=np.zeros_like(scan.mask), keypoint_mask=np.zeros_like(scan.keypoint_mask))


@pytest.mark.parametrize(("phase", "learned", "names"), [(0, POSE, {"coarse", "fine"}), (1, {"evidence_head"}, {"evidence"})])
def test_loss_of_one_batch_falls_and_the_other_parts_stay(phase, learned, names):
    """Oracle: gradient descent on a fixed batch must descend; parts of weight 0 keep their bytes."""
    cfg, tx, train_step = compiled(phase)
    state, losses = start(tx), []
    for _ in range(40):
        state, metrics = train_step(state, batch(*pairs()))
        losses.append(float(metrics["loss"]))
    assert metrics.keys() == {"loss", "grad_norm"} | names
    assert int(state.step) == 40
    assert np.isfinite(losses).all()
    assert losses[-1] < losses[0] - 0.1
    weights = {"coarse": cfg.coarse_weight, "fine": cfg.fine_weight, "evidence": cfg.evidence_weight}
    np.testing.assert_allclose(metrics["loss"], sum(weights[name] * metrics[name] for name in names), rtol=1e-5)
    before, after = tiny_model().variables["params"], state.params["params"]
    same = {name: jax.tree.map(np.array_equal, before[name], after[name]) for name in before}
    assert {name for name in same if not all(jax.tree.leaves(same[name]))} == learned


@pytest.mark.parametrize("phase", [0, 1])
@pytest.mark.parametrize("empty", ["source", "target", "both"])
def test_scans_without_points_do_not_poison_the_weights(phase, empty):
    """Oracle: finite numbers; steps on a batch that holds one good pair and one without points."""
    _, tx, train_step = compiled(phase)
    good, bad = pairs()
    fields = ("source", "target") if empty == "both" else (empty,)
    bad = bad._replace(**{name: without_points(getattr(bad, name)) for name in fields})
    state = start(tx)
    for _ in range(3):
        state, metrics = train_step(state, batch(good, bad))
    assert all(np.isfinite(value) for value in metrics.values())
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.params))


def test_order_of_the_pairs_does_not_matter():
    """Oracle: symmetry; a mean over the batch, up to the order of float32 sums."""
    _, tx, train_step = compiled(0)
    results = [train_step(start(tx), batch(*order))[1] for order in (pairs(), pairs()[::-1])]
    for name in results[0]:
        np.testing.assert_allclose(results[0][name], results[1][name], rtol=1e-4)


def test_same_batch_same_bytes():
    """Oracle: repetition."""
    _, tx, train_step = compiled(0)
    runs = []
    for _ in range(2):
        state = start(tx)
        for _ in range(2):
            state, _ = train_step(state, batch(*pairs()))
        runs.append(b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(state)))
    assert runs[0] == runs[1]


def test_batch_is_what_the_step_takes():
    """Oracle: the annotations of PairBatch; a leading batch axis everywhere."""
    stacked = batch(*pairs())
    assert isinstance(stacked, PairBatch)
    assert {len(leaf) for leaf in jax.tree.leaves(stacked)} == {2}
