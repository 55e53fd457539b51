"""ICP between two scans: point to point and point to plane; matches by a tree on the host, the steps jitted."""

from typing import NamedTuple

import jax
import numpy as np
from scipy.spatial import cKDTree

from delo_jax.baselines.protocols import Aligned, PairMethod
from delo_jax.geometry import se3
from delo_jax.geometry.neighbors import nearest_in, tree_of
from delo_jax.geometry.normals import plane_fit
from delo_jax.geometry.point_to_plane import point_to_plane_step
from delo_jax.geometry.procrustes import weighted_procrustes
from delo_jax.preprocess import voxel_mean

VOXEL_M = 0.25
GATES_M = (2.0, 0.5)  # a match farther apart is none; the second holds once steps with the first have settled
NUM_MOVED = 4096  # points of the source, at even distances in the cloud, that are matched; the rows of every step
MAX_ITERS = 50  # a gate
SETTLED_RAD, SETTLED_M = (1e-3, 1e-4), (1e-2, 1e-3)  # a step below both is the last of a gate
NUM_NEIGHBORS, PLANE_RADIUS_M, MIN_NEIGHBORS, PLANAR = 12, 1.5, 5, 0.1  # of plane fits; variances across and along
DAMPING = 1e-6


class Cloud(NamedTuple):
    """A scan thinned by voxels."""

    points: np.ndarray  # (n, 3) float32 [m]
    tree: cKDTree
    normals: np.ndarray  # (n, 3) float32, unit; zeros where no plane is
    planar: np.ndarray  # (n,) bool


@jax.jit
def _towards_points(moved, targets, normals, weights):
    return weighted_procrustes(moved, targets, weights)


@jax.jit
def _towards_planes(moved, targets, normals, weights):
    return point_to_plane_step(moved, targets, normals, weights, jax.numpy.zeros_like(weights), damping=DAMPING).T_delta


class Icp(PairMethod):
    """Point-to-point ICP (Besl and McKay 1992): matches within a gate, then the closed form, until it settles."""

    step = staticmethod(_towards_points)

    def compile(self) -> None:
        """Compiles the step."""
        nothing = np.zeros((NUM_MOVED, 3), np.float32)
        jax.block_until_ready(self.step(nothing, nothing, nothing, nothing[:, 0]))

    def prepare(self, points: np.ndarray) -> Cloud:
        """Means of voxels, and a tree of them."""
        thin = voxel_mean(points.astype(np.float32), VOXEL_M)
        tree = tree_of(thin)
        return Cloud(thin, tree, *self._planes(thin, tree))

    def align(self, source: Cloud, target: Cloud, T_target_source_init: np.ndarray) -> Aligned:
        """T_target_source from a start; without a single match the start."""
        T, settled = np.array(T_target_source_init, np.float64), False
        points = source.points
        if len(points) > NUM_MOVED:
            points = points[np.linspace(0, len(points), NUM_MOVED, endpoint=False).astype(np.int64)]
        for gate_m, least_rad, least_m in zip(GATES_M, SETTLED_RAD, SETTLED_M, strict=True):
            for _ in range(MAX_ITERS):
                delta = self._delta(points, target, T, gate_m)
                if not np.isfinite(delta).all():
                    return Aligned.of(T_target_source_init, f"no match within {gate_m:g} m", status="rejected")
                T = se3.orthonormal(delta @ T)
                settled = bool(se3.rotation_angle(delta[:3, :3]) < least_rad and np.linalg.norm(se3.log(delta)[3:]) < least_m)
                if settled:
                    break
        return Aligned.of(T, "" if settled else f"not converged after {MAX_ITERS} iterations")

    def _delta(self, points: np.ndarray, target: Cloud, T: np.ndarray, gate_m: float) -> np.ndarray:
        """One step, a correction in the target frame; NaN without a match."""
        moved = points @ T[:3, :3].T + T[:3, 3]
        distances, index = nearest_in(target.tree, moved, 1, gate_m)
        index = np.minimum(index, len(target.points) - 1)  # where nothing is within reach it is one too many
        weights = (distances < gate_m) & target.planar[index]
        if not weights.any():
            return np.full((4, 4), np.nan)
        matched = (moved, target.points[index], target.normals[index], weights)
        return np.asarray(self.step(*map(_padded, matched)), np.float64)

    def _planes(self, points: np.ndarray, tree: cKDTree) -> tuple[np.ndarray, np.ndarray]:
        """Normals of the points, and which of them count; points need none."""
        return np.zeros_like(points), np.ones(len(points), bool)


class PointToPlane(Icp):
    """Point-to-plane ICP (Chen and Medioni 1991): matches within a gate whose target lies on a plane, then one Gauss-Newton step."""

    step = staticmethod(_towards_planes)

    def _planes(self, points: np.ndarray, tree: cKDTree) -> tuple[np.ndarray, np.ndarray]:
        distances, index = nearest_in(tree, points, NUM_NEIGHBORS, PLANE_RADIUS_M)
        near = np.isfinite(distances)
        fit = plane_fit(points[np.where(near, index, 0)], near)
        flat = fit.eigenvalues[:, 0] < PLANAR * fit.eigenvalues[:, 1]
        return fit.normal, flat & (near.sum(axis=1) >= MIN_NEIGHBORS)


def _padded(array: np.ndarray) -> np.ndarray:
    padded = np.zeros((NUM_MOVED, *array.shape[1:]), np.float32)
    padded[: len(array)] = array
    return padded
