"""The pose graph of a run: solved, and its files."""

import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from delo_jax.data.poses import lidar_to_camera, write_kitti_poses, write_tum
from delo_jax.refine import gtsam_backend, jax_backend
from delo_jax.refine.plan import KINDS, Factors, Refined
from delo_jax.refine.refiner import Record

BACKENDS = {"gtsam": gtsam_backend.solve, "jax": jax_backend.solve}
FILES = ("refined.tum", "refined_kitti.txt", "refined_covariances.npy")


class Refinement(NamedTuple):
    """Refined poses of a run, and how they came about."""

    refined: Refined
    """Covariances with the part that no other pose inherits."""
    num_factors: dict[str, int]
    counts: Counter
    """Verdicts of the gate, and pairs without a factor."""
    Ts_online: np.ndarray
    """(n, 4, 4) as the fixed-lag smoother left them."""
    solve_s: float
    pass_s: np.ndarray
    """(n,) of the network's passes."""
    smooth_s: np.ndarray
    """(n,) of the smoother."""


def refine(record: Record, Ts_online: np.ndarray, *, loops: Factors | None = None, backend: str = "gtsam") -> Refinement:
    """Solves the graph of a finished run."""
    begin = time.perf_counter()
    plan = record.plan(loops)
    refined = BACKENDS[backend](plan)
    refined = refined._replace(covariances=refined.covariances + record.local)
    kinds = Counter(KINDS[kind] for kind in plan.factors.kinds.tolist())
    times = time.perf_counter() - begin, np.array(record.pass_s), np.array(record.smooth_s)
    return Refinement(refined, dict(kinds), record.counts, Ts_online, *times)


def write(folder: Path, found: Refinement, stamps_ns: np.ndarray, T_cam_lidar: np.ndarray | None) -> None:
    """refined.tum, refined_kitti.txt (in the frame of poses_kitti.txt) and refined_covariances.npy, of the poses."""
    Ts = found.refined.Ts_world_lidar
    write_tum(folder / FILES[0], stamps_ns, Ts)
    write_kitti_poses(folder / FILES[1], Ts if T_cam_lidar is None else lidar_to_camera(Ts, T_cam_lidar))
    np.save(folder / FILES[2], found.refined.covariances)
