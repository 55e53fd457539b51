"""The stages that are timed are those of the package."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delo_jax.bench import stages
from delo_jax.bench.pair import sized
from delo_jax.model import delo
from delo_jax.preprocess import preprocess
from delo_jax.train.presets import PRESETS
from tests.fixtures import QUICKLY, TINY, narrow_model, street_points, street_scan, tiny_model


def in_stages(model, source, target, T_init):
    """A pair, stage by stage."""
    matching = stages.plan(model, source, target)
    first = stages.coarse(model, source, target, matching)
    if not model.cfg.fine.num_iters:
        return stages.evidence_unrefined(model, source, target, matching, first)
    return stages.evidence(model, source, target, matching, first, stages.fine_solve(model, source, target, first, T_init))


@pytest.mark.parametrize("name", ["tiny", "paper"])
def test_stages_together_are_the_solution(name):
    """Oracle: `delo.solve` on the same pair; the same operations in the same order, up to how they are compiled."""
    model = tiny_model() if name == "tiny" else narrow_model("paper")
    scans = [street_scan(k) if name == "tiny" else preprocess(street_points(k), model.cfg.preprocess) for k in range(2)]

    @jax.jit
    def both(model, source, target):
        ends, start = (delo.encode(model, source), delo.encode(model, target)), jnp.eye(4)
        return in_stages(model, *ends, start), delo.solve(model, *ends, start)

    found, expected = both.lower(model, *scans).compile(QUICKLY)(model, *scans)
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-5)


def test_halves_together_are_the_preprocessing():
    """Oracle: `preprocess` of the same points, bit by bit."""
    scan, points = street_scan(0), street_points(0)
    kept, normals, features, keypoints = stages.normals_and_features(stages.crop_and_voxels(points, TINY.preprocess), TINY.preprocess)
    num, num_keypoints = int(scan.mask.sum()), int(scan.keypoint_mask.sum())
    assert (len(kept), len(keypoints)) == (num, num_keypoints)
    for ours, theirs in ((kept, scan.points), (normals, scan.normals), (features, scan.features)):
        np.testing.assert_array_equal(ours, theirs[:num])
    np.testing.assert_array_equal(keypoints, scan.keypoint_index[:num_keypoints])


@pytest.mark.parametrize(("preset", "num_points", "sizes"), [("base", 256, (3072, 384, 256)), ("base", 4096, (4096, 384, 4096))])
def test_sizes_of_a_network_with_a_fine_stage(preset, num_points, sizes):
    """Oracle: M = max(3072, N), K as it is, N."""
    cfg = sized(PRESETS[preset].model, num_points)
    assert (cfg.preprocess.max_points, cfg.preprocess.num_keypoints, cfg.fine.num_points) == sizes


def test_sizes_of_the_paper():
    """Oracle: M = K = N."""
    cfg = sized(PRESETS["paper"].model, 512)
    assert (cfg.preprocess.max_points, cfg.preprocess.num_keypoints) == (512, 512)
