"""Nearest points by a tree on the host, searched for on several cores at a time."""

import contextlib
import ctypes
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

LEAF_SIZE = 24
MAX_PARTS = 4
MIN_PART = 768  # points: fewer are not worth another thread
ROUNDING_M = 1e-6
Result = TypeVar("Result")


class Helpers:
    """Threads that are kept, on other cores than the one that asks them.

    Linux takes the halted core of a virtual machine for one that is busy elsewhere, and would let a thread that wakes wait for its
    waker's own core. Threads start when they are first needed.
    """

    def __init__(self):
        self._ids: list[int] = []
        self._pool = ThreadPoolExecutor(MAX_PARTS - 1, "neighbors", lambda: self._ids.append(threading.get_native_id()))
        self._cores: set[int] = set()
        self._num_placed = 0  # on these cores

    def submit(self, call: Callable[..., Any], *args: Any, **options: Any) -> Future:
        """The call, under way on another core."""
        if _core is not None:
            self._place(os.sched_getaffinity(0) - {_core()})
        return self._pool.submit(call, *args, **options)

    def _place(self, cores: set[int]) -> None:
        num = len(self._ids)
        if cores and (cores != self._cores or num > self._num_placed):
            with contextlib.suppress(OSError):  # no such right
                for thread in self._ids[:num]:
                    os.sched_setaffinity(thread, cores)
            self._cores, self._num_placed = cores, num


def _new_helpers() -> None:
    """A forked process has no thread of its parent's."""
    global _helpers
    _helpers = Helpers()


_core: Callable[[], int] | None = None
if sys.platform == "linux":
    with contextlib.suppress(AttributeError, OSError):
        _core = ctypes.CDLL(None).sched_getcpu
_helpers: Helpers
_new_helpers()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_new_helpers)


def tree_of(points: Float[np.ndarray, "m 3"]) -> cKDTree:
    """Tree that is asked a few times only: quickly built."""
    return cKDTree(points, leafsize=LEAF_SIZE, balanced_tree=False, compact_nodes=False)


def meanwhile(call: Callable[..., Result], *args: Any) -> Callable[[], Result]:
    """A call that goes on another core while this thread goes on; call what is returned to have its result."""
    if _num_cores() > 1:
        return _helpers.submit(call, *args).result
    result = call(*args)
    return lambda: result


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


class Nearest:
    """The nearest of a tree's points, searched for anew only where it may have become another one.

    Where the nearest is d1 away and the next d2, the nearest stays while the point moves by less than (d2 - d1) / 2 (triangle inequality).

    Args:
        tree: of the points to find.
        num: of the points that may be asked for, now and then, some or all of them.
    """

    def __init__(self, tree: cKDTree, num: int):
        self._tree, self.num = tree, num
        self._points = np.zeros((num, 3), np.float32)  # where each was when it was searched for
        self._index, self._slack_m = np.zeros(num, np.int64), np.full(num, -np.inf)

    def __call__(self, points: np.ndarray, rows: slice = slice(None)) -> np.ndarray:
        """Index of the nearest to each of (n, 3) points, which are those rows of all."""
        searched, index, slack_m = self._points[rows], self._index[rows], self._slack_m[rows]
        anew = np.flatnonzero(np.linalg.norm(points - searched, axis=1) >= slack_m - ROUNDING_M)
        if len(anew):
            distances, found = nearest_in(self._tree, points[anew], 2, np.inf)
            searched[anew], index[anew], slack_m[anew] = points[anew], found[:, 0], 0.5 * (distances[:, 1] - distances[:, 0])
        return index


def _num_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
