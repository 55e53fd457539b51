"""The train step: it learns, leaves alone what is switched off, and survives scans without points."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delo_jax.config import TrainConfig
from delo_jax.model import delo
from delo_jax.train import step as module
from delo_jax.train.loop import phases
from delo_jax.train.pairs import random_pair
from delo_jax.train.presets import PRESETS
from delo_jax.train.step import PairBatch, make_optimizer, make_schedule, make_train_step
from tests.fixtures import QUICKLY, TINY_TRAINING, narrow, narrow_model, street_world, tiny_model

CFG = dataclasses.replace(TINY_TRAINING, num_steps=60, num_evidence_steps=60, learning_rate=5e-3)
POSE = {"encoder", "matcher", "point_embedding", "edge_network"}


@functools.cache
def compiled(phase):
    """Config, optimiser and step of learning poses (0) or evidence (1)."""
    cfg, num_steps = phases(CFG, CFG.num_steps)[phase]
    tx = make_optimizer(cfg, num_steps)
    return cfg, tx, make_train_step(cfg, tx)


def start(tx):
    """A state of its own: the step donates its buffers."""
    return module.start(jax.tree.map(jnp.array, tiny_model().variables), tx)


def batch(*pairs):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *pairs)


@functools.cache
def pairs():
    return tuple(random_pair(street_world(CFG.model.preprocess), CFG, np.random.default_rng(seed)) for seed in range(2))


def without_points(scan):
    return scan._replace(mask=np.zeros_like(scan.mask), keypoint_mask=np.zeros_like(scan.keypoint_mask))


@pytest.mark.parametrize(("phase", "learned", "names"), [(0, POSE, {"matching", "fine"}), (1, {"evidence_head"}, {"evidence"})])
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
    weights = {"matching": cfg.matching_weight, "fine": cfg.fine_weight, "evidence": cfg.evidence_weight}
    np.testing.assert_allclose(metrics["loss"], sum(weights[name] * metrics[name] for name in names), rtol=1e-5)
    before, after = tiny_model().variables["params"], state.variables["params"]
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
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.variables))
    assert int(state.num_nonfinite) == 0


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


JOINT = dataclasses.replace(narrow("paper"), learning_rate=3e-3)


@functools.cache
def paper(**changes):
    """Config and step of the narrow paper preset; `apart` is the second phase of a run that learns evidence apart."""
    cfg = JOINT
    if changes.get("apart"):
        _, (cfg, num_steps) = phases(dataclasses.replace(cfg, num_evidence_steps=100), 100)
        assert num_steps == 100
    tx = make_optimizer(cfg, 100)
    return cfg, tx, make_train_step(cfg, tx)


def paper_start(tx):
    return module.start(jax.tree.map(jnp.array, narrow_model("paper").variables), tx)


@functools.cache
def paper_batch():
    world = street_world(JOINT.model.preprocess)
    return batch(*(random_pair(world, JOINT, np.random.default_rng(seed)) for seed in range(4)))


def changed(before, after):
    """Names of the blocks that are not what they were, by collection."""
    assert str(jax.tree.structure(before)) == str(jax.tree.structure(after))
    same = {
        (collection, block): all(jax.tree.leaves(jax.tree.map(np.array_equal, leaves, after[collection][block])))
        for collection, blocks in before.items()
        for block, leaves in blocks.items()
    }
    return {key for key, equal in same.items() if not equal}


def test_paper_preset_learns_everything_together():
    """Oracle: gradient descent on a fixed batch must descend, by parts that sum to the whole; running statistics follow."""
    cfg, tx, train_step = paper()
    state, losses, before = paper_start(tx), [], jax.device_get(narrow_model("paper").variables)
    for _ in range(60):
        state, metrics = train_step(state, paper_batch())
        losses.append(float(metrics["loss"]))
    assert metrics.keys() == {"loss", "grad_norm", "pose", "aux", "evidence"}
    expected = cfg.odometry_weight * (metrics["pose"] + cfg.aux_weight * metrics["aux"]) + cfg.evidence_weight * metrics["evidence"]
    np.testing.assert_allclose(metrics["loss"], expected, rtol=1e-5)
    assert np.mean(losses[-5:]) < np.mean(losses[:5]) - 0.5
    params = {("params", block) for block in ("encoder", "co_context", "matcher", "evidence_head")}
    assert changed(before, state.variables) == params | {("batch_stats", "encoder"), ("batch_stats", "evidence_head")}
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.variables))
    assert all(np.all(leaf >= 0) for path, leaf in jax.tree.leaves_with_path(state.variables["batch_stats"]) if path[-1].key == "var")
    assert int(state.num_nonfinite) == 0


def test_evidence_learned_apart_moves_its_head_alone():
    """Oracle: the bytes of all other weights and running statistics."""
    _, tx, train_step = paper(apart=True)
    state = paper_start(tx)
    train_step = train_step.lower(state, paper_batch()).compile(QUICKLY)
    for _ in range(3):
        state, metrics = train_step(state, paper_batch())
    assert metrics.keys() == {"loss", "grad_norm", "evidence"}
    moved = changed(jax.device_get(narrow_model("paper").variables), state.variables)
    assert moved == {("params", "evidence_head"), ("batch_stats", "evidence_head")}


@pytest.mark.parametrize("apart", [False, True])
def test_evidence_has_a_slope_in_the_encoder_only_when_joint(apart):
    """Oracle: the documented flow of gradients; of the evidence term alone, by block; compiled with other roundings."""
    cfg, _, _ = paper(apart=apart)
    variables = narrow_model("paper").variables

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    @jax.grad
    def slope(params):
        model = delo.Model({**variables, "params": params}, cfg.model)

        def one(pair):
            bound = functools.partial(module.pair_loss, cfg=cfg, frozen=jax.lax.stop_gradient(model))
            return delo.apply_in_training(model, lambda network, pair: bound(network, pair)[1]["evidence"], pair)[0]

        return jnp.mean(jax.vmap(one, axis_name="batch")(paper_batch()))

    norms = {
        block: sum(float(jnp.abs(leaf).sum()) for leaf in jax.tree.leaves(leaves)) for block, leaves in slope(variables["params"]).items()
    }
    assert np.isfinite(list(norms.values())).all()
    assert {block for block, norm in norms.items() if norm > 0} == (set(norms) if not apart else {"evidence_head"})


@pytest.mark.parametrize("where", ["a point of the source", "a point of the target", "the truth"])
def test_batch_that_is_no_number_changes_nothing_but_its_count(where):
    """Oracle: the bytes of weights, running statistics and optimiser; one good step before, one after."""
    _, tx, train_step = paper()
    bad = jax.tree.map(np.array, paper_batch())
    if where == "the truth":
        bad.T_target_source[1, 0, 3] = np.nan
    else:
        getattr(bad, where.split()[-1]).points[1, 5] = np.nan
    state, _ = train_step(paper_start(tx), paper_batch())
    before = jax.device_get(state)
    state, metrics = train_step(state, bad)
    after = jax.device_get(state)
    assert not np.isfinite(metrics["loss"]) or not np.isfinite(metrics["grad_norm"])
    for mine, theirs in ((before.variables, after.variables), (before.opt_state, after.opt_state)):
        pairs = zip(jax.tree.leaves(mine), jax.tree.leaves(theirs), strict=True)
        assert all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in pairs)
    assert (int(after.step), int(after.num_nonfinite)) == (2, 1)
    state, metrics = train_step(state, paper_batch())
    assert np.isfinite(metrics["loss"])
    assert (int(state.step), int(state.num_nonfinite)) == (3, 1)


@pytest.mark.parametrize(("preset", "pose_loss"), [("official", "matrix"), ("dcp", "l1")])
def test_other_presets_take_a_step(preset, pose_loss):
    """Oracle: finite numbers; the parts are those of the config."""
    cfg = dataclasses.replace(narrow(preset), pose_loss=pose_loss)
    tx = make_optimizer(cfg, 100)
    state = module.start(jax.tree.map(jnp.array, narrow_model(preset).variables), tx)
    train_step = make_train_step(cfg, tx).lower(state, paper_batch()).compile(QUICKLY)
    state, metrics = train_step(state, paper_batch())
    assert metrics.keys() == {"loss", "grad_norm", "pose", "aux"} | ({"evidence"} if preset == "official" else set())
    assert all(np.isfinite(value) for value in metrics.values())
    assert int(state.num_nonfinite) == 0


def test_plan_can_be_trained_in_place_of_scores():
    """Oracle: gradient descent on a fixed batch must descend; the first phase of the tiny network with the loss of its plan."""
    cfg = dataclasses.replace(phases(CFG, 60)[0][0], matching_loss="plan", matching_weight=1.0, fine_weight=0.0)
    tx = make_optimizer(cfg, 60)
    state, losses = start(tx), []
    train_step = make_train_step(cfg, tx).lower(state, batch(*pairs())).compile(QUICKLY)
    for _ in range(20):
        state, metrics = train_step(state, batch(*pairs()))
        losses.append(float(metrics["loss"]))
    assert losses[-1] < losses[0] - 0.1
    assert metrics.keys() == {"loss", "grad_norm", "matching"}


def test_schedule_in_steps():
    """Oracle: by hand; 200 epochs of 7 steps: a tenth from the first step after epochs 15, 30 and 45."""
    schedule = make_schedule(PRESETS["official"], 1400)
    expected = {0: 1e-3, 104: 1e-3, 105: 1e-4, 209: 1e-4, 210: 1e-5, 314: 1e-5, 315: 1e-6, 1399: 1e-6}
    np.testing.assert_allclose([schedule(step) for step in expected], list(expected.values()), rtol=1e-5)
    short = make_schedule(dataclasses.replace(PRESETS["official"], num_epochs=20), 140)
    np.testing.assert_allclose([short(step) for step in (104, 105, 139)], [1e-3, 1e-4, 1e-4], rtol=1e-5)


def test_schedules_without_steps():
    """Oracle: by hand; constant as in the paper, or a linear rise to the peak and half a cosine down to a hundredth."""
    constant = make_schedule(PRESETS["paper"], 1000)
    np.testing.assert_allclose([constant(step) for step in (0, 500, 999)], [1e-4] * 3, rtol=1e-6)
    cosine = make_schedule(TrainConfig(learning_rate=2e-3, warmup_steps=100), 1100)
    expected = {0: 0.0, 50: 1e-3, 100: 2e-3, 600: 2e-3 * 0.505, 1100: 2e-5}
    np.testing.assert_allclose([cosine(step) for step in expected], list(expected.values()), rtol=1e-4, atol=1e-9)
    brief = make_schedule(TrainConfig(learning_rate=2e-3, warmup_steps=100), 100)  # a tenth of a short run is warm-up
    np.testing.assert_allclose(brief(10), 2e-3, rtol=1e-5)
