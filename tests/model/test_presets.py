"""Presets: one network, many configs. Sizes at full width; form, padding, order and compilation when narrow."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delo_jax import inference
from delo_jax.config import PLANS, SOLVERS, EvidenceConfig, FineConfig, MatchingConfig, PoseConfig, PreprocessConfig
from delo_jax.model import delo
from delo_jax.model.coarse import coarse_pose
from delo_jax.model.matching import Matcher
from delo_jax.preprocess import preprocess
from delo_jax.train.losses import matrix_loss
from delo_jax.train.presets import PRESETS
from tests.fixtures import QUICKLY, TINY_TRAINING, T_street, dirty, narrow, narrow_model, street_points, thinned

RAW = ("paper", "official", "dcp")
NARROW = ("tiny", *RAW)  # as narrow as here, `base` is `tiny`


def num_weights(cfg):
    """Trained weights by block, of the full network; nothing is computed."""
    params = jax.eval_shape(functools.partial(delo.init, cfg), jax.random.key(0)).variables["params"]
    return {block: sum(leaf.size for leaf in jax.tree.leaves(leaves)) for block, leaves in params.items()}


DELO = {"encoder": 309_632, "co_context": 5_259_264, "matcher": 1}


@pytest.mark.parametrize(
    ("preset", "head", "expected", "total"),
    [
        ("paper", "embedding", DELO | {"evidence_head": 330_632}, 5_899_529),
        ("official", "embedding", DELO | {"evidence_head": 330_632}, 5_899_529),
        ("paper", "none", DELO, 5_568_897),
        ("dcp", "none", {"encoder": 309_632, "co_context": 5_259_264}, 5_568_896),
    ],
)
def test_weights_of_the_published_networks(preset, head, expected, total):
    """Oracle: the parameters of the authors' models, counted in PyTorch."""
    cfg = PRESETS[preset].model
    assert preset != "dcp" or cfg.evidence.head == head
    found = num_weights(dataclasses.replace(cfg, evidence=dataclasses.replace(cfg.evidence, head=head)))
    assert found == expected
    assert sum(found.values()) == total


@functools.cache
def scan(preset, frame):
    return preprocess(street_points(frame), narrow(preset).model.preprocess)


def some(preset, frame):
    """A scan with padding: 50 rows, of which all (raw) or 20 are key points."""
    if preset not in RAW:
        return thinned(scan(preset, frame), 50, 20)
    mask = np.arange(64) < 50
    whole = scan(preset, frame)
    return whole._replace(points=np.where(mask[:, None], whole.points, 0).astype(np.float32), mask=mask, keypoint_mask=mask)


def reordered(preset, scan, seed, bounds=()):
    """The scan with its rows in another order; none crosses one of the bounds: the fine stage solves for the first ones."""
    num, rng = len(scan.mask), np.random.default_rng(seed)
    order = np.concatenate([rng.permutation(part) for part in np.split(np.arange(num), bounds)])
    rank = np.argsort(order)
    points, normals, features = (array[order] if len(array) else array for array in scan[:3])
    if preset in RAW:
        return scan._replace(points=points, mask=scan.mask[order], keypoint_mask=scan.keypoint_mask[order])
    index = rank[scan.keypoint_index].astype(np.int32)
    keys = rng.permutation(len(index))
    return type(scan)(points, normals, features, scan.mask[order], index[keys], scan.keypoint_mask[keys])


def register(preset, source, target):
    model = narrow_model(preset)
    encoded = [inference.encode(model, scan) for scan in (source, target)]
    return jax.device_get(inference.solve(model, *encoded, jnp.eye(4)))


def test_base_is_tiny_when_narrow():
    """Oracle: the configs; what holds for the one network here holds for the other."""
    assert dataclasses.replace(narrow("base").model, name="tiny") == narrow("tiny").model


@pytest.mark.parametrize("preset", NARROW)
def test_answer_has_its_form(preset):
    """Oracle: SE(3), the symmetry of a Gauss-Newton matrix, and what each head says it fills."""
    model, found = narrow_model(preset), register(preset, scan(preset, 0), scan(preset, 1))
    T = found.T_target_source.astype(np.float64)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-5)
    assert np.linalg.det(T[:3, :3]) > 0
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
    assert found.finite
    np.testing.assert_allclose(found.information, found.information.T, rtol=1e-3, atol=1e-3 * np.abs(found.information).max())
    assert np.linalg.eigvalsh(found.information.astype(np.float64)).min() > -1e-4 * np.abs(found.information).max()
    nothing_said = model.cfg.evidence.head == "none"
    assert all(np.isnan(value).all() if nothing_said else np.isfinite(value).all() for value in found.nig)
    assert np.isnan(found.confidence) if nothing_said else 0 <= found.confidence <= 1
    assert not found.statistics.size or model.cfg.evidence.head == "statistics"
    assert ("batch_stats" in model.variables) == (preset in RAW)


@pytest.mark.parametrize("preset", RAW)
def test_information_is_that_of_the_matched_points(preset):
    """Oracle: the closed form in float64; [-p]x and I, weighted by the row sums of the plan."""
    model = narrow_model(preset)
    source, target = (inference.encode(model, scan(preset, frame)) for frame in (0, 1))
    found = inference.solve(model, source, target, jnp.eye(4)).information
    weights = np.asarray(delo.match(model, source, target).plan, np.float64).sum(axis=1)
    expected = np.zeros((6, 6))
    for weight, (x, y, z) in zip(weights / weights.sum(), np.asarray(source.keypoints, np.float64), strict=True):
        jacobian = np.hstack([-np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.eye(3)])
        expected += weight * jacobian.T @ jacobian
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("preset", NARROW)
def test_padding_changes_nothing(preset):
    """Oracle: symmetry; the same pose and evidence whatever the padded rows hold."""
    scans = [some(preset, frame) for frame in (0, 1)]
    clean, filled = register(preset, *scans), register(preset, *(dirty(scan) for scan in scans))
    for name in ("T_target_source", "information", "nig", "confidence", "statistics"):
        for a, b in zip(jax.tree.leaves(getattr(clean, name)), jax.tree.leaves(getattr(filled, name)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)
    assert clean.finite == filled.finite


@pytest.mark.parametrize("side", ["source", "target", "both"])
@pytest.mark.parametrize("preset", NARROW)
def test_order_of_the_points_does_not_matter(preset, side):
    """Oracle: symmetry, up to the order of float32 sums; padding may stand anywhere."""
    source, target = (some(preset, frame) for frame in (0, 1))
    num_solved = narrow(preset).model.fine.num_points
    bounds = () if preset in RAW else (num_solved // 2, num_solved)
    here = register(preset, source, target)
    source = source if side == "target" else reordered(preset, source, 1, bounds)
    target = target if side == "source" else reordered(preset, target, 2)
    there = register(preset, source, target)
    np.testing.assert_allclose(there.T_target_source, here.T_target_source, atol=1e-4)
    np.testing.assert_allclose(there.confidence, here.confidence, atol=1e-3)


@pytest.mark.parametrize("preset", [pytest.param(name, marks=() if name in RAW else pytest.mark.slow) for name in NARROW])
def test_one_at_a_time_several_or_not_compiled(preset):
    """Oracle: the same function in a loop, compiled and not; float32 sums in another order."""
    model = narrow_model(preset)
    scans = [jax.tree.map(jnp.asarray, some(preset, frame)) for frame in (0, 1)]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *scans)
    encoded = [inference.encode(model, scan) for scan in scans]
    batch = jax.jit(jax.vmap(delo.encode, in_axes=(None, 0)))(model, stacked)
    eager = delo.encode(model, scans[0])
    for k, one in enumerate(encoded):
        jax.tree.map(lambda a, b, k=k: np.testing.assert_allclose(a[k], b, rtol=1e-4, atol=1e-4), batch, one)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), eager, encoded[0])
    pairs = [(0, 1), (1, 0)]
    ones = [inference.solve(model, encoded[i], encoded[j], jnp.eye(4)) for i, j in pairs]
    eager = delo.solve(model, encoded[0], encoded[1], jnp.eye(4))
    np.testing.assert_allclose(eager.T_target_source, ones[0].T_target_source, atol=1e-3)
    np.testing.assert_allclose(eager.confidence, ones[0].confidence, atol=1e-3)
    if preset not in RAW:
        return  # several pairs of the network with a fine stage: `test_solve.py`
    sources, targets = (jax.tree.map(lambda *leaves: jnp.stack(leaves), *(encoded[pair[i]] for pair in pairs)) for i in (0, 1))
    together = jax.jit(jax.vmap(delo.solve, in_axes=(None, 0, 0, None)))(model, sources, targets, jnp.eye(4))
    for k, one in enumerate(ones):
        np.testing.assert_allclose(together.T_target_source[k], one.T_target_source, atol=1e-3)
        np.testing.assert_allclose(together.confidence[k], one.confidence, atol=1e-3)


@pytest.mark.parametrize("empty", [(True, False), (False, True), (True, True)])
@pytest.mark.parametrize("preset", NARROW)
def test_scans_without_points_are_told_apart(preset, empty):
    """Oracle: nothing determines a pose; a rigid one comes back all the same, and without a fine stage it is said to be none."""
    nothing = preprocess(np.zeros((0, 3), np.float32), narrow(preset).model.preprocess)
    found = register(preset, *(nothing if gone else scan(preset, frame) for frame, gone in enumerate(empty)))
    T = found.T_target_source.astype(np.float64)
    assert np.isfinite(T).all()
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-5)
    assert np.isfinite(found.information).all()
    if preset in RAW:
        assert not found.finite


TINY = dataclasses.replace(TINY_TRAINING.model, fine=FineConfig(num_iters=0), evidence=EvidenceConfig(head="none"))


@functools.cache
def encoder_stage():
    """The encodings, which no plan enters into, and the slopes of what follows the descriptors carried back to the weights."""
    weights = jax.jit(delo.init, static_argnums=0, compiler_options=QUICKLY)(TINY, jax.random.key(0)).variables["params"]["encoder"]
    scans = [jax.tree.map(jnp.asarray, preprocess(street_points(frame), TINY.preprocess)) for frame in (0, 1)]

    def forward(weights):
        encodings = [delo.encode(delo.Model({"params": {"encoder": weights}}, TINY), scan) for scan in scans]
        return [encoding.descriptors for encoding in encodings], encodings

    @jax.jit
    def back(slopes):
        _, pull, _ = jax.vjp(forward, weights, has_aux=True)
        return pull(slopes)[0]

    return jax.jit(forward)(weights)[1], back


@functools.cache
def plan_stage(plan):
    """Weights of the plan and the plan; the slope of what follows it, carried back to them and to the descriptors."""
    matching = MatchingConfig(plan=plan, learn_epsilon=True, num_iters=3, num_candidates=8, predict_mass=plan == "partial_transport")
    cfg = dataclasses.replace(TINY, matching=matching)
    (source, target), _ = encoder_stage()
    arrays = source.descriptors, target.descriptors, source.keypoint_mask, target.keypoint_mask
    weights = jax.jit(Matcher(matching).init)(jax.random.key(0), *arrays).get("params", {})

    def forward(weights, descriptors):
        ours, theirs = (cloud._replace(descriptors=rows) for cloud, rows in zip((source, target), descriptors, strict=True))
        return delo.match(delo.Model({"params": {"matcher": weights}}, cfg), ours, theirs).plan

    @jax.jit
    def back(slope):
        _, pull = jax.vjp(forward, weights, list(arrays[:2]))
        return pull(slope)

    return jax.jit(forward)(weights, arrays[:2]), (source.keypoints, target.keypoints, source.keypoint_mask), back


@functools.cache
def pose_stage(solver):
    """Value and slope by the plan of a loss of the pose, and the pose."""

    def loss(plan, source, target, mask):
        T = coarse_pose(plan, source, target, mask, cfg=PoseConfig(solver=solver)).T_target_source
        return matrix_loss(T, jnp.asarray(T_street(), jnp.float32)), T

    return jax.jit(jax.value_and_grad(loss, has_aux=True))


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("plan", PLANS)
def test_every_plan_goes_with_every_solver(plan, solver):
    """Oracle: SE(3); the loss of the pose is a number, and so is its slope in every weight, which reaches the descriptors."""
    found, points, back = plan_stage(plan)
    (value, T), slope = pose_stage(solver)(found, *points)
    np.testing.assert_allclose(np.asarray(T[:3, :3]) @ np.asarray(T[:3, :3]).T, np.eye(3), atol=1e-4)
    assert np.isfinite(value)
    of_matcher, of_descriptors = back(slope)
    of_encoder = encoder_stage()[1](of_descriptors)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((of_matcher, of_encoder)))
    assert any(np.any(leaf) for leaf in jax.tree.leaves(of_encoder))


def cache_sizes():
    """Compilations so far of `encode` and of `solve`."""
    functions: list[Any] = [inference.encode, inference.solve]  # jax does not declare the method
    return [function._cache_size() for function in functions]


@pytest.mark.parametrize("preset", ["tiny", "paper"])
def test_stream_of_odd_sizes_compiles_once(preset):
    """Oracle: the size of the caches; 200 scans of 0 to 20000 points, one compilation of each function per padded size.

    That of the first size is the other tests', or happens here before the stream begins.
    """
    cfg, rng = narrow(preset).model, np.random.default_rng(0)
    register(preset, scan(preset, 0), scan(preset, 1))
    small = {"max_points": 32, "num_keypoints": 32 if preset == "paper" else 16}
    other = dataclasses.replace(cfg, name="a stream", preprocess=dataclasses.replace(cfg.preprocess, **small))
    for streamed, num_scans, num_compiled in ((cfg, 200, 0), (other, 10, 1)):
        model = delo.Model(narrow_model(preset).variables, streamed)  # no weight depends on the number of points
        before = cache_sizes()
        last = None
        for size in [0, 1, 4, 5, 31, 20_000, *rng.integers(0, 20_000, num_scans - 6)]:
            points = (rng.normal(size=(size, 3)) * [15.0, 15.0, 2.0]).astype(np.float32)
            encoded = inference.prepare(model, points)
            if last is not None:
                assert np.isfinite(inference.align(model, last, encoded, np.eye(4)).T_target_source).all()
            last = encoded
        assert cache_sizes() == [size + num_compiled for size in before]


def test_padded_size_is_the_configs():
    """Oracle: the config; a raw input of many points is not larger than one of few."""
    cfg = PreprocessConfig(sampling="raw", max_points=64, num_keypoints=64)
    shapes = [[array.shape for array in preprocess(np.ones((num, 3)), cfg)] for num in (0, 63, 64, 65, 5000)]
    assert all(shape == shapes[0] for shape in shapes)
