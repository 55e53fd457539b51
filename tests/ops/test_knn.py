"""Nearest neighbours."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from delo_jax.ops.knn import knn, nearest
from tests.oracles.agreement import assert_gradient_is_the_slope, assert_transforms_agree


def cloud(seed, n):
    return jnp.asarray(np.random.default_rng(seed).uniform(-60, 60, size=(n, 3)), jnp.float32)


@pytest.mark.parametrize("num_points", [1, 257, 1500])
def test_nearest_by_distance(num_points):
    """Oracle: cKDTree on the valid points, by distance; the packed key may tie within a factor 1 + m / 2^22."""
    queries, points = cloud(0, 100), cloud(1, num_points)
    mask = np.random.default_rng(2).uniform(size=num_points) < 0.7
    mask[-1] = True
    index, squared = nearest(queries, points, jnp.asarray(mask))
    assert mask[np.asarray(index)].all()
    distance = cKDTree(np.asarray(points, np.float64)[mask]).query(np.asarray(queries, np.float64))[0]
    chosen = np.linalg.norm(np.asarray(queries, np.float64) - np.asarray(points, np.float64)[np.asarray(index)], axis=1)
    np.testing.assert_allclose(squared, chosen**2, rtol=1e-5)
    assert np.all(chosen**2 <= distance**2 * (1 + num_points / 2**22 + 1e-6))


def test_nearest_finds_the_point_itself():
    """Oracle: every query is one of the points, far from the origin: distance exactly zero."""
    points = cloud(0, 300) + 1000.0
    index, squared = nearest(points, points, jnp.ones(300, bool))
    np.testing.assert_array_equal(index, np.arange(300))
    np.testing.assert_array_equal(squared, np.zeros(300))


def test_ties_go_to_the_lowest_index_and_nothing_valid_is_infinitely_far():
    """Oracle: the documented answers."""
    points = jnp.ones((5, 3), jnp.float32)
    index, squared = nearest(points[:1] - 1.0, points, jnp.array([False, True, True, False, True]))
    assert (int(index[0]), float(squared[0])) == (1, 3.0)
    index, squared = nearest(points[:1], points, jnp.zeros(5, bool))
    assert (int(index[0]), float(squared[0])) == (0, np.inf)


def test_nearest_gradient_is_the_slope():
    """Oracle: central differences in x64; the choice is constant, the distance moves."""
    with jax.enable_x64(True):
        mask = jnp.ones(30, bool)
        assert_gradient_is_the_slope(lambda q, p: jnp.sum(nearest(q, p, mask)[1]), [cloud(0, 10), cloud(1, 30)])


def test_neighbours_under_jit_and_vmap():
    """Oracle: the same function, one cloud at a time, not compiled."""
    points = jnp.stack([cloud(seed, 40) for seed in range(3)])
    mask = jnp.asarray(np.random.default_rng(0).uniform(size=(3, 40)) < 0.8)
    assert_transforms_agree(lambda p, m: (nearest(p[:9] + 1.0, p, m), knn(p, m, 4)), points, mask)


def test_nearest_stores_no_coordinate_differences():
    """Oracle: XLA's own count of temporary memory, one n x m plane and some vectors; n x m x 3 would be three."""
    n, m = 512, 1024
    shapes = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in (((n, 3), "float32"), ((m, 3), "float32"), ((m,), "bool"))]
    memory = jax.jit(nearest).lower(*shapes).compile().memory_analysis()
    assert memory.temp_size_in_bytes < 1.5 * n * m * 4


def assert_knn_is_right(points, mask, k):
    """Neighbours of every row at the distances that cKDTree finds among the valid points; the own index where it finds none."""
    index = np.asarray(knn(jnp.asarray(points), jnp.asarray(mask), k))
    host, num = np.asarray(points, np.float64), min(k, mask.sum())
    assert mask[index[:, :num]].all()
    assert all(len({*row}) == num for row in index[:, :num])
    if num:
        distance = cKDTree(host[mask]).query(host, num)[0].reshape(len(host), num)
        found = np.linalg.norm(host[index[:, :num]] - host[:, None], axis=2)
        np.testing.assert_allclose(found, distance, rtol=1e-5)
        assert np.all(np.diff(found, axis=1) >= -1e-5 * found[:, 1:])
    np.testing.assert_array_equal(index[:, num:], np.broadcast_to(np.arange(len(host))[:, None], (len(host), k - num)))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("slack", [-2, 0, 1, 30])
def test_knn_by_distance(seed, slack):
    """Oracle: cKDTree, by distance, for random sizes and masks; k = valid points - slack, from too many to a few."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(5, 80))
    mask = rng.uniform(size=n) < 0.7
    assert_knn_is_right(np.asarray(cloud(seed, n)), mask, int(np.clip(mask.sum() - slack, 1, n)))


def test_knn_at_the_size_of_the_paper():
    """Oracle: cKDTree, by distance; 1024 points up to 70 m away, k = 20, where expanded squares would be wrong by 3e-3 m^2."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, size=(1024, 3)) * [70, 70, 3]
    points[:512] = [68, -69, 1] + rng.uniform(-0.3, 0.3, size=(512, 3))  # half of them within centimetres, far out
    assert_knn_is_right(points.astype(np.float32), np.ones(1024, bool), 20)
    assert_knn_is_right(points.astype(np.float32), rng.uniform(size=1024) < 0.9, 20)


@pytest.mark.parametrize("copies", [2, 7, 40])
def test_knn_of_coincident_points(copies):
    """Oracle: cKDTree, by distance; copies of a point are at distance zero, every one of them a neighbour of its own."""
    points = np.repeat(np.asarray(cloud(0, 6)), copies, axis=0)
    assert_knn_is_right(points, np.ones(len(points), bool), min(10, len(points)))
    index = np.asarray(knn(jnp.asarray(points), jnp.ones(len(points), bool), copies))
    np.testing.assert_array_equal(index // copies, np.broadcast_to(np.arange(len(points))[:, None] // copies, index.shape))


def test_first_neighbour_is_the_point_itself():
    """Oracle: distance zero."""
    np.testing.assert_array_equal(knn(cloud(0, 200), jnp.ones(200, bool), 3)[:, 0], np.arange(200))


def test_knn_permutes_with_its_points():
    """Oracle: symmetry in the order of the points."""
    points, order = cloud(0, 50), np.random.default_rng(0).permutation(50)
    mask = np.random.default_rng(1).uniform(size=50) < 0.8
    moved = np.asarray(knn(points[order], jnp.asarray(mask[order]), 8))
    np.testing.assert_array_equal(order[moved], np.asarray(knn(points, jnp.asarray(mask), 8))[order])


def test_knn_of_too_few_valid_points_repeats_the_own_index():
    """Oracle: the documented answer."""
    mask = jnp.array([True, False, True, False, False])
    index = np.asarray(knn(cloud(0, 5), mask, 4))
    for row in range(5):
        assert {*index[row, :2]} == {0, 2}
        assert {*index[row, 2:]} == {row}
