"""Training pairs: truth, augmentation, starts, determinism."""

import dataclasses
import functools
from collections import Counter

import jax
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from delo_jax.config import PreprocessConfig, TrainConfig
from delo_jax.preprocess import Scan, preprocess
from delo_jax.train.pairs import make_batch, random_frames, random_pair, unrelated_pair
from delo_jax.train.presets import PRESETS
from delo_jax.train.worlds import World, scan_of, stored_config
from tests.fixtures import TINY_TRAINING, simulated_world, street_world
from tests.oracles import street

CFG = PreprocessConfig(max_points=1500)
TRAINING = TrainConfig()


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
        pair = random_pair(world(name), TRAINING, np.random.default_rng(seed))
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
        pair = random_pair(world("street"), TRAINING, np.random.default_rng(seed))
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
        pair = random_pair(world("street"), TRAINING, np.random.default_rng(seed))
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
        pair = random_pair(world("street"), TRAINING, np.random.default_rng(seed))
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
    draws = [bool(random_pair(world("street"), TRAINING, np.random.default_rng(seed)).from_coarse) for seed in range(90)]
    assert abs(np.mean(draws) - 1 / 3) < 5 * np.sqrt(2 / 9 / 90)


def on_a_map(name, seed):
    """A pair whose fine stage gets a local map."""
    cfg = dataclasses.replace(TRAINING, map_share=1.0)
    return random_pair(world(name), cfg, np.random.default_rng(seed))


@pytest.mark.parametrize(("name", "median_m", "share"), [("street", 0.02, 0.7), ("simulated", 0.06, 0.5)])
def test_truth_lays_the_source_on_the_surfaces_of_a_map(name, median_m, share):
    """Oracle: simulator truth, as for pairs; frames of the map are a centimetre off. The start is where the source was expected."""
    apart = []
    for seed in range(12):
        pair = on_a_map(name, seed)
        assert_rigid(pair.T_surfaces_source)
        errors, agreement = plane_errors(pair._replace(target=pair.surfaces), pair.T_surfaces_source)
        assert np.median(errors) < median_m
        assert agreement > share
        np.testing.assert_array_equal(pair.T_surfaces_init, np.eye(4))
        assert not pair.from_coarse
        apart.append(np.linalg.norm(pair.T_surfaces_source[:3, 3]))
    assert min(apart) < 0.5 < 1.5 < max(apart) < 5.0


def test_map_shows_what_a_sensor_there_would_see():
    """Oracle: the form of a scan; range, height and steepness by hand; more surfaces than one scan has."""
    larger = 0
    for seed in range(8):
        pair = on_a_map("street", seed)
        near = pair.surfaces
        count = int(near.mask.sum())
        np.testing.assert_array_equal(near.mask, np.arange(TRAINING.num_map_points) < count)
        points, normals = near.points[:count], near.normals[:count]
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-4)
        assert np.all(np.sum(points * normals, axis=1) < 1e-2)
        np.testing.assert_allclose(near.features[:count, 5], np.log(np.linalg.norm(points, axis=1)) - 2.7, atol=1e-3)
        np.testing.assert_allclose(near.features[:count, 6], points[:, 2] / 3.0, atol=1e-3)
        np.testing.assert_allclose(near.features[:count, 7], np.abs(normals[:, 2]), atol=1e-3)
        assert not near.points[count:].any()
        larger += count > pair.source.mask.sum()
    assert larger > 0


def test_share_of_pairs_on_a_map():
    """Oracle: the config; without a map the fine stage gets the target, and where it is not trained nothing."""
    cfg = dataclasses.replace(TRAINING, map_share=0.0)
    pair = random_pair(world("street"), cfg, np.random.default_rng(0))
    np.testing.assert_array_equal(pair.surfaces.points[: len(pair.target.points)], pair.target.points)
    np.testing.assert_array_equal(pair.T_surfaces_source, pair.T_target_source)
    np.testing.assert_array_equal(pair.T_surfaces_init, pair.T_init)
    draws = [np.array_equal(random_pair(world("street"), TRAINING, np.random.default_rng(k)).T_surfaces_init, np.eye(4)) for k in range(80)]
    assert abs(np.mean(draws) - TRAINING.map_share) < 5 * np.sqrt(0.25 / 80)
    assert len(random_pair(world("street"), TRAINING, np.random.default_rng(0), evidence=True).surfaces.points) == 0


@pytest.mark.parametrize("evidence", [False, True])
def test_same_generator_same_batch(evidence):
    """Oracle: repetition; another seed gives another batch."""
    worlds = [street_world(TINY_TRAINING.model.preprocess), street_world(TINY_TRAINING.model.preprocess, 3)]

    def batch(seed):
        pairs = make_batch(worlds, dataclasses.replace(TINY_TRAINING, batch_size=3), np.random.default_rng((0, seed)), evidence=evidence)
        arrays = jax.tree.leaves(pairs)
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
        pair = unrelated_pair(first, second, TRAINING, np.random.default_rng(seed))
        assert_rigid(pair.T_target_source)
        error = np.linalg.inv(pair.T_init.astype(np.float64)) @ pair.T_target_source
        lengths.append(np.linalg.norm(error[:3, 3]))
    assert np.median(lengths) > 3.0


@pytest.mark.parametrize("augment", [False, True])
@pytest.mark.parametrize(("num_frames", "max_gap"), [(6, 3), (6, 5), (4, 9), (2, 1)])
def test_frames_are_any_two_that_are_near(num_frames, max_gap, augment):
    """Oracle: the list of allowed pairs, each equally likely: a chi-squared of 4000 draws within five standard deviations."""
    cfg = dataclasses.replace(TRAINING, max_gap=max_gap, augment=augment)
    rng = np.random.default_rng(0)
    counts = Counter(random_frames(num_frames, cfg, rng) for _ in range(4000))
    allowed = [(a, b) for a in range(num_frames) for b in range(a + 1, num_frames) if b - a <= max_gap]
    allowed += [(b, a) for a, b in allowed] if augment else []
    assert counts.keys() == set(allowed)
    expected = 4000 / len(allowed)
    chi_squared = sum((count - expected) ** 2 / expected for count in counts.values())
    degrees = len(allowed) - 1
    assert chi_squared < degrees + 5 * np.sqrt(2 * degrees) + 1e-9


RAW = dataclasses.replace(PRESETS["paper"].model, preprocess=PreprocessConfig(sampling="raw", max_points=96, num_keypoints=96))
RAW_TRAINING = dataclasses.replace(PRESETS["paper"], model=RAW, batch_size=2, max_gap=2)


@functools.cache
def raw_world(num_frames=5):
    """A world of exact points, four times as many as one input takes; the third scan has fewer than one input takes."""
    poses = [street.pose(0.9 * k - 6.0, 0.1 * k, yaw_deg=2.0 * k) for k in range(num_frames)]
    clouds = [street.scan(T, num_rings=8, num_columns=180).points for T in poses]
    clouds[2] = clouds[2][:70]
    scans = [preprocess(points, stored_config(RAW.preprocess)) for points in clouds]
    return World(Scan(*(np.stack(arrays) for arrays in zip(*scans, strict=True))), np.array(poses)), clouds


def rows_of(points):
    return [row.tobytes() for row in points]


def test_raw_scans_are_drawn_anew_without_replacement():
    """Oracle: sets of rows; every draw is of the scan's own points, none of them twice, and no two draws are the same."""
    world, clouds = raw_world()
    known = [set(rows_of(points)) for points in clouds]
    draws = set()
    for seed in range(20):
        pair = random_pair(world, RAW_TRAINING, np.random.default_rng(seed))
        for scan in (pair.source, pair.target):
            assert [array.shape for array in scan] == [(96, 3), (0, 3), (0, 8), (96,), (96,), (96,)]
            count = int(scan.mask.sum())
            rows = rows_of(scan.points[:count])
            assert count in (70, 96)
            assert len(set(rows)) == count
            assert any(set(rows) <= points for points in known)
            np.testing.assert_array_equal(scan.mask, np.arange(96) < count)
            np.testing.assert_array_equal(scan.keypoint_mask, scan.mask)
            np.testing.assert_array_equal(scan.keypoint_index, np.arange(96))
            assert not scan.points[count:].any()
            draws.add(b"".join(rows))
    assert len(draws) == 40


def test_draws_reach_every_stored_point():
    """Oracle: counting; 200 draws of a quarter each leave no point out."""
    world, _ = raw_world()
    stored = set(rows_of(world.scans.points[0][world.scans.mask[0]]))
    seen = set()
    for seed in range(200):
        pair = random_pair(world._replace(Ts_world_lidar=world.Ts_world_lidar[:2]), RAW_TRAINING, np.random.default_rng(seed))
        seen |= set(rows_of(pair.source.points[pair.source.mask]))
    assert len(stored) == 4 * 96
    assert seen == stored


def test_pair_without_augmentation_is_as_it_was_driven():
    """Oracle: simulator truth; the source is the earlier scan, T maps it into the later one's frame, nothing is turned or dropped."""
    world, clouds = raw_world()
    known = [set(rows_of(points)) for points in clouds]
    seen = set()
    for seed in range(60):
        pair = random_pair(world, RAW_TRAINING, np.random.default_rng(seed))
        source, target = (
            next(k for k, points in enumerate(known) if set(rows_of(scan.points[scan.mask])) <= points)
            for scan in (pair.source, pair.target)
        )
        assert 0 < target - source <= 2
        T = np.linalg.inv(world.Ts_world_lidar[target]) @ world.Ts_world_lidar[source]
        np.testing.assert_allclose(pair.T_target_source, T, atol=1e-5)
        np.testing.assert_array_equal(pair.T_init, np.eye(4))
        assert pair.from_coarse
        seen.add((source, target))
    assert len(seen) == 7  # gaps 1 and 2 of five frames


def test_augmented_raw_scan_is_turned_alone():
    """Oracle: symmetry; distances between the sensor and its points stay, rows stay in the front, nothing but points moves."""
    world, clouds = raw_world()
    ranges = np.sort(np.linalg.norm(np.concatenate(clouds), axis=1))
    for seed in range(8):
        pair = random_pair(world, dataclasses.replace(RAW_TRAINING, augment=True), np.random.default_rng(seed))
        assert_rigid(pair.T_target_source)
        for scan in (pair.source, pair.target):
            count = int(scan.mask.sum())
            np.testing.assert_array_equal(scan.mask, np.arange(96) < count)
            np.testing.assert_array_equal(scan.keypoint_mask, scan.mask)
            found = np.linalg.norm(scan.points[:count], axis=1)
            nearest = np.clip(np.searchsorted(ranges, found), 1, len(ranges) - 1)
            assert np.all(np.minimum(abs(ranges[nearest] - found), abs(ranges[nearest - 1] - found)) < 1e-3)
            assert scan.normals.shape == (0, 3)


def test_inference_sees_the_first_points_of_a_stored_scan():
    """Oracle: the stored rows by hand; a scan of a surface world stays as it is."""
    world, _ = raw_world()
    scan = scan_of(world, 1, RAW.preprocess)
    np.testing.assert_array_equal(scan.points, world.scans.points[1][:96])
    assert scan.mask.all()
    assert len(scan.keypoint_index) == len(scan.keypoint_mask) == 96
    surface = street_world(CFG)
    assert all(np.array_equal(a, b[2]) for a, b in zip(scan_of(surface, 2, CFG), surface.scans, strict=True))
