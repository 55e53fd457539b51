"""Searches for nearest points by a tree on several cores."""

import multiprocessing
import os
import sys
import threading

import numpy as np
import pytest

from delo_jax.geometry import neighbors
from delo_jax.geometry.neighbors import Nearest, meanwhile, nearest_in, tree_of


def cloud(num, seed):
    return np.random.default_rng(seed).uniform(-5.0, 5.0, (num, 3)).astype(np.float32)


@pytest.mark.parametrize("cores", [1, 2, 16])
@pytest.mark.parametrize("num", [0, 1, 900, 4001])
def test_search_is_exact_on_any_number_of_cores(monkeypatch, cores, num):
    """Oracle: all distances; with a reach that leaves some points without a neighbour."""
    monkeypatch.setattr(neighbors, "_num_cores", lambda: cores)
    targets, points = cloud(300, 0), cloud(num, 1)
    distances, index = nearest_in(tree_of(targets), points, 3, 1.0)
    full = np.linalg.norm(points[:, None].astype(np.float64) - targets[None], axis=2)
    order = np.argsort(full, axis=1)[:, :3]
    expected = np.take_along_axis(full, order, axis=1)
    missing = expected >= 1.0
    np.testing.assert_array_equal(index, np.where(missing, 300, order))
    np.testing.assert_allclose(distances, np.where(missing, np.inf, expected), rtol=1e-12)
    assert num < 900 or 0.05 < missing.mean() < 0.95


def test_one_neighbour_is_one_column_less():
    """Oracle: the first of two."""
    tree, points = tree_of(cloud(300, 0)), cloud(2000, 1)
    one, two = (nearest_in(tree, points, k, 1.0) for k in (1, 2))
    np.testing.assert_array_equal(one[0], two[0][:, 0])
    np.testing.assert_array_equal(one[1], two[1][:, 0])


@pytest.mark.parametrize("cores", [1, 2])
def test_tree_is_built_meanwhile(monkeypatch, cores):
    """Oracle: the tree that is built at once."""
    monkeypatch.setattr(neighbors, "_num_cores", lambda: cores)
    ready, points = meanwhile(tree_of, cloud(5000, 0)), cloud(50, 1)
    np.testing.assert_array_equal(ready().query(points)[1], tree_of(cloud(5000, 0)).query(points)[1])


@pytest.mark.skipif(sys.platform != "linux", reason="threads are placed on Linux alone")
def test_threads_keep_clear_of_the_core_that_asks(monkeypatch):
    """Oracle: what the operating system says of a thread, for two cores that ask in turn."""
    allowed, helpers = os.sched_getaffinity(0), neighbors.Helpers()
    together = threading.Barrier(neighbors.MAX_PARTS - 1, timeout=60.0)
    for waiting in [helpers.submit(together.wait) for _ in range(neighbors.MAX_PARTS - 1)]:  # all threads have started then
        waiting.result()
    for core in sorted(allowed)[:2]:
        monkeypatch.setattr(neighbors, "_core", lambda core=core: core)
        assert helpers.submit(os.sched_getaffinity, 0).result() == (allowed - {core} or allowed)


@pytest.mark.parametrize("step_m", [0.0, 0.01, 0.2, 5.0])
def test_nearest_of_moving_points(step_m):
    """Oracle: all distances; points that move again and again, of which now and then some are asked for, at first too."""
    rng = np.random.default_rng(0)
    targets = rng.uniform(-4.0, 4.0, (400, 3)).astype(np.float32)
    search, points = Nearest(tree_of(targets), 700), rng.uniform(-5.0, 5.0, (700, 3)).astype(np.float32)
    for k in range(12):
        points = points + rng.normal(0.0, step_m, points.shape).astype(np.float32)
        rows = slice(None) if k % 3 else slice(100, 300)
        distances = np.linalg.norm(points[rows, None].astype(np.float64) - targets[None], axis=2)
        np.testing.assert_array_equal(search(points[rows], rows), distances.argmin(axis=1))


def _in_child(queue):
    queue.put(nearest_in(tree_of(cloud(300, 0)), cloud(2000, 1), 1, 1.0)[1])


@pytest.mark.skipif(sys.platform == "win32", reason="there is no fork")
@pytest.mark.filterwarnings("ignore:os.fork", "ignore:This process")
def test_forked_process_searches_too(monkeypatch):
    """Oracle: the same search here: threads do not survive a fork, and a pool that counts on them would wait forever."""
    monkeypatch.setattr(neighbors, "_num_cores", lambda: 2)
    here = nearest_in(tree_of(cloud(300, 0)), cloud(2000, 1), 1, 1.0)[1]
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_in_child, args=(queue,))
    child.start()
    try:
        np.testing.assert_array_equal(queue.get(timeout=60.0), here)
    finally:
        child.kill()
        child.join()
