"""Raw points to a `Scan`."""

import dataclasses
from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.linalg import expm
from scipy.spatial import cKDTree
from scipy.stats import ks_2samp

from delo_jax.config import PreprocessConfig
from delo_jax.errors import ScanError
from delo_jax.preprocess import HORIZONTAL, NUM_FEATURES, one_per_voxel, preprocess, preprocess_timed, still, sweep_of_scan, voxel_mean
from tests.fixtures import simulated_clip
from tests.oracles import street
from tests.oracles.registration import hat

CFG = PreprocessConfig()


def rotation_z(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def valid_rows(scan):
    return scan.points[scan.mask], scan.normals[scan.mask], scan.features[scan.mask]


def assert_well_formed(scan, cfg):
    """Documented shapes and dtypes, valid rows first, unit normals towards the sensor, nothing that is not finite."""
    m, k = cfg.max_points, cfg.num_keypoints
    shapes = [(m, 3), (m, 3), (m, NUM_FEATURES), (m,), (k,), (k,)]
    assert [array.shape for array in scan] == shapes
    assert [array.dtype for array in scan] == [np.float32] * 3 + [bool, np.int32, bool]
    for mask in (scan.mask, scan.keypoint_mask):
        np.testing.assert_array_equal(mask, np.arange(len(mask)) < mask.sum())
    points, normals, _ = valid_rows(scan)
    assert all(np.isfinite(array).all() for array in scan)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
    assert np.all(np.sum(points * normals, axis=1) <= 1e-3)
    assert np.all(scan.mask[scan.keypoint_index[scan.keypoint_mask]])
    assert len(np.unique(scan.keypoint_index[scan.keypoint_mask])) == scan.keypoint_mask.sum()
    for array in scan[:3]:
        assert not np.any(array[~scan.mask])


BLOB = (np.random.default_rng(0).normal(size=(4000, 3)) * [8, 8, 0.3]).astype(np.float32)
USELESS = {
    "empty": np.zeros((0, 3), np.float32),
    "one point": np.array([[5.0, 0.0, 0.0]]),
    "ten points": np.random.default_rng(0).uniform(5, 6, (10, 3)),
    "all at the sensor": np.zeros((1000, 3)),
    "all equal": np.full((1000, 3), 7.0),
    "all NaN": np.full((1000, 3), np.nan),
    "all infinite": np.full((1000, 3), np.inf),
    "too far": np.full((1000, 3), 1e4) + np.arange(1000)[:, None],
    "beyond float32": np.full((1000, 3), 1e300),
    "beyond its square": np.full((1000, 3), 3e38, np.float32),
}
USABLE = {
    "some NaN": np.where(np.arange(4000)[:, None] % 3 == 0, np.nan, BLOB),
    "some infinite": np.where(np.arange(4000)[:, None] % 3 == 0, -np.inf, BLOB),
    "some huge": np.where(np.arange(4000)[:, None] % 3 == 0, 1e38, BLOB),
    "float64": np.asarray(BLOB, np.float64),
    "integers": np.round(BLOB).astype(np.int16),
    "a line": np.linspace(3, 60, 3000)[:, None] * [1.0, 0.0, 0.0],
    "a wall": np.stack([np.full(3000, 9.0), *np.random.default_rng(1).uniform(-9, 9, (2, 3000))], axis=1),
}


@pytest.mark.parametrize("name", USELESS)
def test_useless_input_gives_an_empty_scan(name):
    """Oracle: the geometry; no five neighbours span a plane there. Warnings are errors in every test."""
    scan = preprocess(USELESS[name], CFG)
    assert_well_formed(scan, CFG)
    assert scan.mask.sum() == 0 or name == "ten points"


@pytest.mark.parametrize("name", USABLE)
def test_odd_input_gives_a_well_formed_scan(name):
    """Oracle: the documented form of a scan."""
    scan = preprocess(USABLE[name], CFG)
    assert_well_formed(scan, CFG)
    assert scan.mask.any() or name == "a line"


@given(npst.arrays(np.float32, st.tuples(st.integers(0, 60), st.just(3)), elements=st.floats(width=32)))
def test_any_floats_give_a_well_formed_scan(points):
    """Oracle: the documented form of a scan."""
    assert_well_formed(preprocess(points, CFG), CFG)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((5, 4)), r"points: expected an array of shape \(n, 3\) in metres, got shape \(5, 4\); pass points\[:, :3\]"),
        (np.zeros(3), r"got shape \(3,\)$"),
        (np.zeros((5, 2)), r"got shape \(5, 2\)$"),
        (np.zeros((1, 5, 3)), r"got shape \(1, 5, 3\)$"),
        (np.array([]), r"got shape \(0,\)$"),
        (np.zeros((5, 3), complex), "points: expected numbers, got dtype complex128; convert to float32"),
        (np.zeros((5, 3), bool), "got dtype bool"),
        (np.full((5, 3), "a"), "got dtype <U1"),
        (np.full((5, 3), None), "got dtype object"),
    ],
)
def test_wrong_shape_or_dtype_is_one_sentence(points, message):
    """Oracle: the sentence, written by hand."""
    with pytest.raises(ScanError, match=message):
        preprocess(points, CFG)


def test_same_scan_same_bytes():
    """Oracle: repetition, on a copy; the input is left as it was."""
    points = street.scan(street.pose(), noise_m=0.02).points
    before = points.tobytes()
    first, second = (preprocess(array, CFG) for array in (points, points.copy()))
    assert points.tobytes() == before
    assert all(a.tobytes() == b.tobytes() for a, b in zip(first, second, strict=True))
    np.testing.assert_array_equal(preprocess(points.astype(np.float64), CFG).points, first.points)


def test_points_lie_on_their_planes_and_normals_look_at_the_sensor():
    """Oracle: the analytic planes of the street. With 2 cm of noise, the fit over neighbours at least halves it."""
    truth = street.scan(street.pose(yaw_deg=20.0))
    noisy = street.scan(street.pose(yaw_deg=20.0), noise_m=0.02).points
    scan = preprocess(noisy, CFG)
    assert_well_formed(scan, CFG)
    points, normals, features = valid_rows(scan)
    _, index = cKDTree(truth.points).query(points)
    plane_error = np.abs(np.sum(truth.normals[index] * points, axis=1) - truth.offsets[index])
    raw = np.abs(np.sum(truth.normals * noisy, axis=1) - truth.offsets)
    smooth = features[:, 2] < np.log10(0.03) + 1.5  # thinner than 3 cm: neither an edge nor a pole
    assert smooth.mean() > 0.7
    assert np.median(plane_error[smooth]) < 0.5 * np.median(raw)
    cosine = np.sum(truth.normals[index] * normals, axis=1)
    assert np.degrees(np.arccos(np.clip(np.median(cosine[smooth]), -1, 1))) < 3.0
    assert np.mean(cosine[smooth] > np.cos(np.radians(15))) > 0.95


def test_normals_of_a_simulated_scan():
    """Oracle: simulator truth, normals of the nearest measured point; edges, foliage and noise take their share."""
    truth = simulated_clip()[0]
    points, normals, features = valid_rows(preprocess(truth.points, CFG))
    flat = features[:, 0] < 0.1  # sqrt(smallest / largest eigenvalue)
    _, index = cKDTree(truth.points).query(points[flat])
    cosine = np.sum(truth.normals[index] * normals[flat], axis=1)
    assert flat.sum() > 500
    assert np.median(cosine) > np.cos(np.radians(8))


@pytest.mark.parametrize("yaw", [0.4, np.pi / 2, 2.5])
def test_features_do_not_change_when_the_sensor_yaws(yaw):
    """Oracle: symmetry. Points 0.36 m apart are alone in their 0.2 m voxel at any yaw, so that the scans match one to one.

    So sparse a cloud wants more neighbours than a scan does: of eight, ties decide too often.
    """
    points = street.scan(street.pose(), noise_m=0.01).points
    points = points[one_per_voxel(points, 0.25, np.random.default_rng(0))]
    crowded = cKDTree(points).query_pairs(0.36, output_type="ndarray")
    points = np.delete(points, np.unique(crowded[:, 1]), axis=0)
    cfg = PreprocessConfig(voxel_m=0.2, point_voxel_m=0.2, num_neighbors=16, max_points=len(points), ground_share=1.0)
    here, there = (valid_rows(preprocess(cloud, cfg)) for cloud in (points, points @ rotation_z(yaw).T))
    assert len(here[0]) > 2000
    gap, match = cKDTree(there[0]).query(here[0] @ rotation_z(yaw).T)
    same = gap < 1e-3  # float32 flips a neighbour at the rim, a voxel or a verdict now and then
    assert same.mean() > 0.99
    change = np.abs(here[2][same] - there[2][match[same]]).max(axis=1)
    assert np.mean(change < 0.02) > 0.98
    turned = np.abs(np.sum((here[1][same] @ rotation_z(yaw).T) * there[1][match[same]], axis=1))
    assert np.mean(turned > 0.999) > 0.98


def test_key_points_are_upright_near_and_thinned():
    """Oracle: the config, counted voxel by voxel."""
    scan = preprocess(street.scan(street.pose()).points, CFG)
    rows = scan.keypoint_index[scan.keypoint_mask]
    assert len(rows) > 100
    assert np.all(np.abs(scan.normals[rows, 2]) < HORIZONTAL)
    assert np.all(np.linalg.norm(scan.points[rows], axis=1) < CFG.keypoint_range_m)
    voxels = {tuple(np.floor(point.astype(np.float64) / CFG.keypoint_voxel_m)) for point in scan.points[rows]}
    assert len(voxels) == len(rows)


def test_ground_keeps_to_its_share():
    """Oracle: the config, on a street that fills a small scan with ground and walls."""
    cfg = PreprocessConfig(max_points=500, num_keypoints=64, ground_share=0.3, point_voxel_m=0.5)
    scan = preprocess(street.scan(street.pose()).points, cfg)
    assert scan.mask.all()
    assert np.sum(np.abs(scan.normals[:, 2]) > HORIZONTAL) == int(0.3 * 500)
    flat = preprocess(street.scan(street.pose(), boxes=[]).points, cfg)
    assert flat.mask.sum() == int(0.3 * 500)  # nothing but ground
    assert not flat.keypoint_mask.any()


def test_range_is_cropped():
    """Oracle: the config; a mean of voxels and a projection move a point by centimetres."""
    cfg = PreprocessConfig(min_range_m=8.0, max_range_m=30.0)
    points, _, _ = valid_rows(preprocess(street.scan(street.pose()).points, cfg))
    ranges = np.linalg.norm(points, axis=1)
    assert ranges.min() > 7.9
    assert ranges.max() < 30.1


def test_first_rows_are_an_even_subset():
    """Oracle: a two-sample Kolmogorov-Smirnov test of azimuth, range and height of the first rows against the others."""
    points, _, _ = valid_rows(preprocess(street.scan(street.pose()).points, CFG))
    for values in (np.arctan2(points[:, 1], points[:, 0]), np.linalg.norm(points, axis=1), points[:, 2]):
        assert ks_2samp(values[:512], values[512:]).pvalue > 1e-3


def test_points_keep_their_times():
    """Oracle: a time that is a linear function of the place, which a mean over a voxel keeps; projection moves a point by centimetres."""
    points = street.scan(street.pose(), noise_m=0.01).points
    gradient = np.array([1e-3, -5e-4, 2e-4])
    scan, times_s = preprocess_timed(points, points @ gradient, CFG)
    untimed, none = preprocess_timed(points, None, CFG)
    assert none is None
    assert times_s.dtype == np.float32
    assert all(np.array_equal(a, b) for a, b in zip(scan, untimed, strict=True))
    assert np.quantile(np.abs(times_s[scan.mask] - scan.points[scan.mask] @ gradient), 0.99) < 1e-4
    assert not times_s[~scan.mask].any()
    lost, times_s = preprocess_timed(points, np.full(len(points), np.nan), CFG)
    assert not times_s.any()
    assert all(np.array_equal(a, b) for a, b in zip(scan, lost, strict=True))


def test_still_scan_is_the_scan_of_a_sensor_at_rest():
    """Oracle: scipy's expm, point by point, within half a step between the 128 instants; padding stays zero."""
    points = street.scan(street.pose(), noise_m=0.01).points
    scan, times_s = preprocess_timed(points, 0.05 * np.sin(np.arange(len(points))), CFG)
    velocity = np.array([0.1, -0.2, 0.5, 12.0, 0.3, -0.1])
    found = still(scan, sweep_of_scan(scan, times_s), velocity)
    for row in range(0, int(scan.mask.sum()), 37):
        T = expm(hat(velocity * times_s[row]))
        np.testing.assert_allclose(found.points[row], T[:3, :3] @ scan.points[row] + T[:3, 3], atol=0.03)
        np.testing.assert_allclose(found.normals[row], T[:3, :3] @ scan.normals[row], atol=2e-3)
    assert not found.points[~scan.mask].any()
    np.testing.assert_array_equal(found.features, scan.features)


def test_padding_does_not_widen_a_sweep():
    """Oracle: scipy's expm; times about a second before the stamp, a scan that is not full, 40 m/s: 2 cm between two instants."""
    points = street.scan(street.pose(), noise_m=0.01).points
    scan, times_s = preprocess_timed(points, -0.9 + 0.05 * np.sin(np.arange(len(points))), CFG)
    assert not scan.mask.all()
    velocity = np.array([0.0, 0.0, 0.0, 40.0, 0.0, 0.0])
    found = still(scan, sweep_of_scan(scan, times_s), velocity)
    moved = scan.points[scan.mask] + times_s[scan.mask, None] * velocity[None, 3:]
    assert np.abs(found.points[scan.mask] - moved).max() < 0.02


def test_thinning_keeps_all_rings_whatever_the_order_of_the_rows():
    """Oracle: the rings of the scan. Rows run along each ring, or, as a sensor fires, from ring to ring; a step of two would leave out
    every other ring of the latter. The ground is seen as a ring each, which voxels of 10 cm keep apart."""
    points = street.scan(street.pose(), boxes=[]).points
    by_firing = points[np.argsort(np.round(np.arctan2(points[:, 1], points[:, 0]), 4), kind="stable")]
    cfg = dataclasses.replace(CFG, max_raw_points=len(points) // 2, voxel_m=0.1, point_voxel_m=0.4)
    radii = np.unique(np.round(np.hypot(points[:, 0], points[:, 1]), 1))
    radii = radii[(radii > cfg.min_range_m) & (radii < 15)]
    for rows in (points, by_firing):
        scan = preprocess(rows, cfg)
        kept = np.hypot(*scan.points[scan.mask, :2].T)
        assert len(radii) > 5
        assert np.abs(kept[None] - radii[:, None]).min(axis=1).max() < 0.1


def test_thinning_keeps_the_times_of_the_points():
    """Oracle: the time of a point is its azimuth here, whichever of the points are kept."""
    points = street.scan(street.pose()).points
    times_s = 0.1 * np.arctan2(points[:, 1], points[:, 0]) / np.pi
    scan, kept_s = preprocess_timed(points, times_s, dataclasses.replace(CFG, max_raw_points=len(points) // 3))
    assert kept_s is not None
    x, y, _ = scan.points[scan.mask].T
    off = np.angle(np.exp(1j * (np.pi * kept_s[scan.mask] / 0.1 - np.arctan2(y, x))))
    assert np.abs(off[np.abs(np.arctan2(y, x)) < 3.0]).max() < 0.1  # two points of a voxel, on both sides of the cut, have no common time


def cluttered(seed, reach_m):
    """500 points, every one of them twice, and as far apart as that."""
    points = (np.random.default_rng(seed).normal(size=(250, 3)) * reach_m).astype(np.float32)
    return np.repeat(points, 2, axis=0)[np.random.default_rng(seed).permutation(500)]


REACHES = [3.0, 1e5]  # at 1e5 m the number of a voxel leaves no room for that of a row in 64 bits


@pytest.mark.parametrize("reach_m", REACHES)
@pytest.mark.parametrize("seed", range(2))
def test_voxel_mean_is_the_mean_of_each_voxel(seed, reach_m):
    """Oracle: a dictionary of lists, in float64."""
    points = cluttered(seed, reach_m)
    cells = defaultdict(list)
    for point in points:
        cells[tuple(np.floor(point * np.float32(1 / 0.7)))].append(point.astype(np.float64))
    expected = np.array(sorted(tuple(np.mean(cell, axis=0)) for cell in cells.values()))
    found = voxel_mean(points, 0.7)
    assert found.dtype == np.float32
    np.testing.assert_allclose(sorted(map(tuple, found)), expected, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("reach_m", REACHES)
@pytest.mark.parametrize("seed", range(2))
def test_one_point_is_kept_of_each_voxel(seed, reach_m):
    """Oracle: the set of occupied voxels, point by point; the choice within a voxel is random."""
    points = cluttered(seed, reach_m)
    cells = [tuple(np.floor(point * np.float32(1 / 0.7))) for point in points]
    rows = one_per_voxel(points, 0.7, np.random.default_rng(seed))
    assert len(rows) == len({cells[row] for row in rows}) == len(set(cells))
    assert not np.array_equal(rows, one_per_voxel(points, 0.7, np.random.default_rng(seed + 1)))


RAW = PreprocessConfig(sampling="raw", min_range_m=0.0, max_range_m=1e5, max_points=100, num_keypoints=100)


def numbered(num):
    """Points that say which row they are."""
    return np.stack([np.arange(num), np.full(num, 0.5), -np.arange(num)], axis=1).astype(np.float32)


def assert_raw(scan, num_valid):
    assert [array.shape for array in scan] == [(100, 3), (0, 3), (0, NUM_FEATURES), (100,), (100,), (100,)]
    assert [array.dtype for array in scan] == [np.float32] * 3 + [bool, np.int32, bool]
    np.testing.assert_array_equal(scan.mask, np.arange(100) < num_valid)
    np.testing.assert_array_equal(scan.keypoint_mask, scan.mask)
    np.testing.assert_array_equal(scan.keypoint_index, np.arange(100))
    assert not scan.points[num_valid:].any()


@pytest.mark.parametrize("num", [100, 101, 150, 999, 12_345])
def test_raw_points_are_evenly_spaced_rows(num):
    """Oracle: floor(k num / 100), by integers; the points are as they were, in an order that is not that of the sensor."""
    scan = preprocess(numbered(num), RAW)
    assert_raw(scan, 100)
    rows = scan.points[:, 0].astype(int)
    np.testing.assert_array_equal(np.sort(rows), [k * num // 100 for k in range(100)])
    np.testing.assert_array_equal(scan.points, numbered(num)[rows])
    assert abs(np.corrcoef(rows, np.arange(100))[0, 1]) < 0.5


@pytest.mark.parametrize("num", [0, 1, 7, 99])
def test_few_raw_points_are_all_kept(num):
    """Oracle: the input as a set; the rest is padding."""
    scan = preprocess(numbered(num), RAW)
    assert_raw(scan, num)
    np.testing.assert_array_equal(np.sort(scan.points[:num, 0]), np.arange(num))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_raw_points_that_are_no_numbers_are_dropped(bad):
    """Oracle: the same scan without them; points beside the sensor and far away stay, within limits as wide."""
    points = numbered(500)
    points[3] = [0.0, 0.0, 0.0]
    points[4] = [1e4, 0.0, 0.0]
    dirty = np.insert(points, [0, 17, 17, 400, 500], bad, axis=0)
    dirty[0, :2] = 1.0  # one bad coordinate is enough
    clean, found = preprocess(points[:90], RAW), preprocess(dirty[: 90 + 3], RAW)
    assert_raw(found, 90)
    np.testing.assert_array_equal(found.points, clean.points)
    assert {0.0, 1e4} <= set(np.abs(found.points[:90]).max(axis=1).tolist())
    assert_raw(preprocess(np.full((1000, 3), bad), RAW), 0)


def test_raw_points_out_of_range_are_dropped():
    """Oracle: the same scan without them, by their row numbers."""
    points, cfg = numbered(500), dataclasses.replace(RAW, min_range_m=20.0, max_range_m=300.0)
    ranges = np.linalg.norm(points.astype(np.float64), axis=1)
    inside = points[(ranges >= 20.0) & (ranges < 300.0)]
    assert 0 < len(inside) < 500
    np.testing.assert_array_equal(preprocess(points, cfg).points, preprocess(inside, RAW).points)


def test_same_raw_scan_same_bytes():
    """Oracle: repetition, on a copy in another dtype; the input is left as it was."""
    points = street.scan(street.pose(), noise_m=0.02).points
    before = points.tobytes()
    first, second = preprocess(points, RAW), preprocess(points.astype(np.float64), RAW)
    assert points.tobytes() == before
    assert all(a.tobytes() == b.tobytes() for a, b in zip(first, second, strict=True))


def test_first_raw_rows_are_an_even_subset():
    """Oracle: a two-sample Kolmogorov-Smirnov test of azimuth, range and height of the first rows against the others."""
    cfg = PreprocessConfig(sampling="raw", max_points=1024, num_keypoints=1024)
    points = preprocess(street.scan(street.pose()).points, cfg).points
    for values in (np.arctan2(points[:, 1], points[:, 0]), np.linalg.norm(points, axis=1), points[:, 2]):
        assert ks_2samp(values[:512], values[512:]).pvalue > 1e-3
