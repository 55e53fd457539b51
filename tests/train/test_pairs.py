"""Training pairs: truth, augmentation, starts, determinism."""

import functools

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from delo_jax.config import PreprocessConfig
from delo_jax.train.pairs import make_batch, random_pair, unrelated_pair
from tests.fixtures import TINY_TRAINING, simulated_world, street_world

CFG = PreprocessConfig(max_points=1500)


@functools.cache
def world(name):
    return street_world(CFG) if name == "street" else simulated_world(CFG)


def assert_rigid(T):
    T = np.asarray(T, np.float64)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-5)
    assert np.linalg.det(T[:3, :3]) > 0
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


def plane_errors(pair, T):
    """Distances of moved source points from the planes of their nearest target points, where the normals agree."""
    rows, columns = pair.source.mask, pair.target.mask
    points = pair.source.points[rows] @ T[:3, :3].T + T[:3, 3]
    normals = pair.source.normals[rows] @ T[:3, :3].T
    distance, index = cKDTree(pair.target.points[columns]).query(points)
    targets, target_normals = pair.target.points[columns][index], pair.target.normals[columns][index]
    agree = (np.sum(normals * target_normals, axis=1) > 0.8) & (distance < 2.0)
    return np.abs(np.sum((points - targets) * target_normals, axis=1))[agree], agree.mean()


@pytest.mark.parametrize(("name", "median_m", "share"), [("street", 0.01, 0.7), ("simulated", 0.05, 0.5)])
def test_truth_lays_the_source_on_the_surfaces_of_the_target(name, median_m, share):
    """Oracle: simulator truth. 1 cm of noise on the analytic street; noise, foliage and traffic in the simulated one.

    Over 20 draws, with mirrors, swaps, turns and lost points; the other direction of T fits worse.
    """
    sharper = 0
    for seed in range(20):
        pair = random_pair(world(name), np.random.default_rng(seed))
        assert_rigid(pair.T_target_source)
        errors, agreement = plane_errors(pair, pair.T_target_source)
        assert np.median(errors) < median_m
        assert agreement > share
        wrong, _ = plane_errors(pair, np.linalg.inv(pair.T_target_source))
        sharper += np.median(wrong) > 1.5 * np.median(errors)
    assert sharper >= 10  # frames next to each other look alike either way round


def test_augmented_scan_is_still_a_scan():
    """Oracle: the documented form; features are the rows' own, key points are the same places as before."""
    originals = world("street").scans
    features = {row.tobytes() for frame in range(len(originals.mask)) for row in originals.features[frame][originals.mask[frame]]}
    num_dropped = 0
    for seed in range(12):
        pair = random_pair(world("street"), np.random.default_rng(seed))
        for scan in (pair.source, pair.target):
            count = scan.mask.sum()
            num_dropped += count < 0.9 * originals.mask.sum(axis=1).min()
            np.testing.assert_array_equal(scan.mask, np.arange(len(scan.mask)) < count)
            points, normals = scan.points[scan.mask], scan.normals[scan.mask]
            np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
            assert np.all(np.sum(points * normals, axis=1) < 1e-2)  # still towards the sensor
            assert {row.tobytes() for row in scan.features[scan.mask]} <= features
            assert np.all(scan.mask[scan.keypoint_index[scan.keypoint_mask]])
            assert [array.dtype for array in scan] == [array.dtype for array in originals]
    assert 0 < num_dropped < 24


def test_key_points_follow_their_rows():
    """Oracle: features, which no augmentation changes, name the places."""
    originals = world("street").scans
    for seed in range(6):
        pair = random_pair(world("street"), np.random.default_rng(seed))
        rows = {*map(bytes, pair.source.features[pair.source.mask])}
        frame = next(k for k in range(len(originals.mask)) if rows <= {*map(bytes, originals.features[k])})
        before = originals.features[frame][originals.keypoint_index[frame][originals.keypoint_mask[frame]]]
        after = pair.source.features[pair.source.keypoint_index[pair.source.keypoint_mask]]
        assert {*map(bytes, after)} <= {*map(bytes, before)}
        if pair.source.mask.sum() == originals.mask[frame].sum():
            assert len(after) == len(before)


def test_starts_are_the_identity_or_near_the_truth():
    """Oracle: the documented starts. The identity of the scans as they were is a pure yaw after the augmentation."""
    kinds = {"identity": 0, "disturbed": 0}
    for seed in range(60):
        pair = random_pair(world("street"), np.random.default_rng(seed))
        assert_rigid(pair.T_init)
        error = np.linalg.inv(pair.T_init.astype(np.float64)) @ pair.T_target_source
        if not np.any(pair.T_init[:3, 3]):
            kinds["identity"] += 1
            assert pair.T_init[2, 2] == pytest.approx(1.0, abs=1e-6)
            assert np.linalg.norm(pair.T_target_source[:3, 3]) < 2.5
        else:
            kinds["disturbed"] += 1
            assert np.linalg.norm(error[:3, 3]) < 4 * 1.2 + 0.1
            assert np.degrees(np.linalg.norm(Rotation.from_matrix(error[:3, :3]).as_rotvec())) < 4 * 1.2 * 3.0
    assert min(kinds.values()) > 8


def test_a_third_starts_from_the_coarse_stage():
    """Oracle: a binomial of 1/3; five standard deviations."""
    draws = [bool(random_pair(world("street"), np.random.default_rng(seed)).from_coarse) for seed in range(90)]
    assert abs(np.mean(draws) - 1 / 3) < 5 * np.sqrt(2 / 9 / 90)


@pytest.mark.parametrize("evidence", [False, True])
def test_same_generator_same_batch(evidence):
    """Oracle: repetition; another seed gives another batch."""
    worlds = [street_world(TINY_TRAINING.model.preprocess), street_world(TINY_TRAINING.model.preprocess, 3)]

    def batch(seed):
        pairs = make_batch(worlds, 3, np.random.default_rng((0, seed)), evidence=evidence)
        arrays = [*pairs.source, *pairs.target, *pairs[2:]]
        assert {len(array) for array in arrays} == {3}
        assert pairs.T_target_source.dtype == pairs.T_init.dtype == np.float32
        return b"".join(array.tobytes() for array in arrays)

    assert batch(4) == batch(4)
    assert batch(4) != batch(5)


def test_unrelated_pair_is_lost_whatever_the_answer():
    """Oracle: the drawn truth; metres or tens of degrees from the start, and no reason to prefer it."""
    first, second = world("street"), world("simulated")
    lengths = []
    for seed in range(10):
        pair = unrelated_pair(first, second, np.random.default_rng(seed))
        assert_rigid(pair.T_target_source)
        error = np.linalg.inv(pair.T_init.astype(np.float64)) @ pair.T_target_source
        lengths.append(np.linalg.norm(error[:3, 3]))
    assert np.median(lengths) > 3.0
