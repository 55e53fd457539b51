"""Nearest points by a tree on the host, searched for on several cores at a time."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

LEAF_SIZE = 24
MAX_PARTS = 4
MIN_PART = 768  # points: fewer are not worth another thread
_helpers: ThreadPoolExecutor


def _new_helpers() -> None:
    """Threads start when they are first needed; a forked process has none of its parent's."""
    global _helpers
    _helpers = ThreadPoolExecutor(MAX_PARTS - 1, thread_name_prefix="neighbors")


_new_helpers()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_new_helpers)


def tree_of(points: Float[np.ndarray, "m 3"]) -> cKDTree:
    """Tree that is asked a few times only: quickly built."""
    return cKDTree(points, leafsize=LEAF_SIZE, balanced_tree=False, compact_nodes=False)


def tree_meanwhile(points: Float[np.ndarray, "m 3"]) -> Callable[[], cKDTree]:
    """The same, built on another core while this thread goes on; call what is returned to have it."""
    if _num_cores() > 1:
        return _helpers.submit(tree_of, points).result
    tree = tree_of(points)
    return lambda: tree


def nearest_in(
    tree: cKDTree, points: Float[np.ndarray, "n 3"], k: int, reach_m: float
) -> tuple[Float[np.ndarray, "n ..."], Int[np.ndarray, "n ..."]]:
    """Distances [m] and numbers of the k nearest of a tree's points, ascending, (n, k), or (n,) where k is 1.

    Where there are no more within reach they are infinity and the number of the tree's points. The tree lets go of the interpreter's
    lock: parts of the points are searched for by threads that are kept, one a core, which is steadier than `workers` of scipy, whose
    threads are started at every call.

    Args:
        tree: of the points to find.
        points: to search for.
        k: how many.
        reach_m: farther away, nothing is found.
    """
    num = max(1, min(_num_cores(), MAX_PARTS, len(points) // MIN_PART))
    parts = np.array_split(points, num)
    others = [_helpers.submit(tree.query, part, k=k, distance_upper_bound=reach_m) for part in parts[1:]]
    found = [tree.query(parts[0], k=k, distance_upper_bound=reach_m), *(other.result() for other in others)]
    if num == 1:
        return found[0]
    distances, index = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    return distances, index


def _num_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
