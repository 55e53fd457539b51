"""The local map, against voxels kept in a dictionary, one observation at a time."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from delo_jax.config import PreprocessConfig
from delo_jax.model.delo import Surfaces
from delo_jax.pipeline.local_map import LocalMap
from delo_jax.preprocess import NUM_FEATURES, preprocess
from tests.oracles import street

MAX_COUNT, PADDING = 3, 7


def observed(seed, num=400):
    """Random surfaces around a sensor somewhere, several in a voxel, and its pose."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(num, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = rng.uniform(-1, 1, 3)
    points = rng.uniform(-4, 4, (num, 3))
    features = rng.normal(size=(num, NUM_FEATURES))
    mask = np.arange(num) < num - PADDING
    return Surfaces(points.astype(np.float32), normals.astype(np.float32), features.astype(np.float32), mask), T


def insert(voxels, seen, T):
    """The specification: the nearest of a scan's points in a voxel; mean where normals agree, replaced from much nearer."""
    nearest: dict[tuple, tuple] = {}
    for point, normal, features in zip(*(array[seen.mask].astype(np.float64) for array in seen[:3]), strict=True):
        world = T[:3, :3] @ point + T[:3, 3]
        key, distance = tuple(np.floor(world).astype(int)), np.linalg.norm(point)
        if key not in nearest or distance < nearest[key][3]:
            nearest[key] = world, T[:3, :3] @ normal, features, distance
    for key, (world, normal, features, distance) in nearest.items():
        if key not in voxels:
            voxels[key] = [world, normal, features, distance, 1]
            continue
        held = voxels[key]
        if normal @ held[1] > 0.5:
            held[4] = min(held[4] + 1, MAX_COUNT)
            for column, new in enumerate((world, normal, features)):
                held[column] = held[column] + (new - held[column]) / held[4]
            held[1] = held[1] / np.linalg.norm(held[1])
            held[3] = min(held[3], distance)
        elif distance < 0.5 * held[3]:
            voxels[key] = [world, normal, features, distance, 1]


def test_voxels_hold_running_means():
    """Oracle: the dictionary; ten scans, seen from one pose in the end. The order of the voxels is free."""
    local_map = LocalMap(max_count=MAX_COUNT)
    voxels: dict[tuple, list] = {}
    for seed in range(10):
        seen, T = observed(seed)
        local_map.insert(seen, T)
        insert(voxels, seen, T)
    _, T = observed(99)
    found = local_map.crop(T, 100.0)
    assert len(local_map) == len(found.points) == len(voxels)
    points = np.array([(held[0] - T[:3, 3]) @ T[:3, :3] for held in voxels.values()])
    normals = np.array([held[1] @ T[:3, :3] for held in voxels.values()])
    normals *= np.where(np.sum(points * normals, axis=1) > 0, -1, 1)[:, None]
    features = np.array([held[2] for held in voxels.values()])
    ours, theirs = np.lexsort(found.points.round(3).T), np.lexsort(points.astype(np.float32).round(3).T)
    np.testing.assert_allclose(found.points[ours], points[theirs], atol=2e-5)
    np.testing.assert_allclose(found.normals[ours], normals[theirs], atol=2e-5)
    np.testing.assert_allclose(found.features[ours][:, :5], features[theirs][:, :5], atol=2e-5)
    np.testing.assert_allclose(found.features[ours][:, 5], np.log(np.linalg.norm(points[theirs], axis=1)) - 2.7, atol=1e-4)
    np.testing.assert_allclose(found.features[ours][:, 6], points[theirs][:, 2] / 3.0, atol=1e-4)
    np.testing.assert_allclose(found.features[ours][:, 7], np.abs(normals[theirs][:, 2]), atol=1e-4)


@pytest.mark.parametrize("reach", [2.0, 5.0])
def test_crop_is_what_is_near(reach):
    """Oracle: distances in the frame of the whole map."""
    local_map = LocalMap()
    seen, T = observed(3)
    local_map.insert(seen, T)
    _, T_there = observed(4)
    everything, found = local_map.crop(T_there, 100.0), local_map.crop(T_there, reach)
    inside = everything.points[np.linalg.norm(everything.points, axis=1) < reach]
    assert 0 < len(inside) < len(everything.points)
    np.testing.assert_array_equal(found.points, inside)
    assert np.all(np.sum(found.points * found.normals, axis=1) <= 0)


def test_a_scan_comes_back_as_its_sensor_saw_it():
    """Oracle: the scan itself: with small voxels a map of one scan, cropped where it was taken, is that scan."""
    T = street.pose(3.0, 1.0, 1.7, yaw_deg=20.0, roll_deg=2.0)
    scan = preprocess(street.scan(T).points, PreprocessConfig())
    num = int(scan.mask.sum())
    local_map = LocalMap(voxel_m=0.01)
    local_map.insert(Surfaces(scan.points, scan.normals, scan.features, scan.mask), T)
    found = local_map.crop(T, 100.0)
    ours, theirs = np.lexsort(found.points.round(2).T), np.lexsort(scan.points[:num].round(2).T)
    assert len(found.points) == num
    np.testing.assert_allclose(np.sort(found.points[:, 0]), np.sort(scan.points[:num, 0]), atol=1e-4)
    same = np.linalg.norm(found.points[ours] - scan.points[:num][theirs], axis=1) < 1e-3
    assert same.mean() > 0.9  # points that share rounded coordinates may come in another order
    # A scan's ranges are those before its points were moved onto their planes.
    np.testing.assert_allclose(found.features[ours][same], scan.features[:num][theirs][same], atol=0.02)


def test_memory_is_bounded_and_far_places_stay_exact():
    """Oracle: a map that was started there; 20 km from the origin of the world the points are as good as at home."""
    seen, _ = observed(0)
    local_map, T, largest = LocalMap(reach_m=30.0), np.eye(4), 0
    for step in range(200):
        T[0, 3] = 100.0 * step + 0.5 * step
        local_map.insert(seen, T)
        local_map.prune(T)
        largest = max(largest, len(local_map))
    assert largest < 2 * len(seen.points)
    there = LocalMap()
    there.insert(seen, T)
    np.testing.assert_allclose(local_map.crop(T, 20.0).points, there.crop(T, 20.0).points, atol=1e-5)


def test_nothing_seen():
    """Oracle: by hand."""
    local_map, nothing = (
        LocalMap(),
        Surfaces(np.zeros((5, 3), np.float32), np.zeros((5, 3), np.float32), np.zeros((5, NUM_FEATURES), np.float32), np.zeros(5, bool)),
    )
    assert len(local_map.crop(np.eye(4), 10.0).points) == len(local_map) == 0
    local_map.insert(nothing, np.eye(4))
    local_map.prune(np.eye(4))
    seen, T = observed(1)
    local_map.insert(seen, T)
    before = len(local_map)
    local_map.insert(nothing, T)
    assert len(local_map) == before > 0
