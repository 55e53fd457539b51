"""Scan to local map: learned steps for the wide basin, robust classical steps for the last millimetres."""

from collections import deque
from typing import NamedTuple

import jax
import numpy as np
from scipy.spatial import cKDTree

from delo_jax import inference
from delo_jax.errors import ConfigError
from delo_jax.geometry import se3
from delo_jax.inference import EncodedScan, Estimate
from delo_jax.model.delo import Model
from delo_jax.pipeline.local_map import LocalMap, Surfaces
from delo_jax.uncertainty import covariance, status
from delo_jax.uncertainty.observability import observability

CROP_M = 60.0  # of the map around the predicted pose
NUM_LEARNED_POINTS, NUM_ROBUST_POINTS = 512, 2048
NUM_ROBUST_ROUNDS, STEPS_PER_ROUND = 2, 2  # matches are found again once a round
SCALE_M, REACH_M = 0.1, 0.8
MIN_TARGETS = 100
RECOVERY_STEPS = 6
INSERT_M, INSERT_DEG = 1.0, 5.0  # motion since the last insertion
NUM_RECENT = 20  # scans whose scores say what is usual
MIN_USUAL_SCORE = 0.35
SIGMA_M, NUM_INDEPENDENT = 0.02, 100.0  # of a plane distance; as many of them as if they were independent; not calibrated


class MapFix(NamedTuple):
    """A scan registered to the map."""

    T_start_lidar: np.ndarray  # (4, 4) float64: where the sensor is, seen from the start
    score: float  # mean robust weight of the scan's points, in [0, 1]
    rms_m: float  # weighted distance to the surfaces
    information: np.ndarray  # (6, 6), right perturbation, per unit of weight


class MapTracker:
    """The local map of a drive, how well scans have fitted it lately, and what that says of the next one."""

    def __init__(self, params: Model):
        if params.cfg.fine.num_iters == 0:
            raise ConfigError(
                f"map: expected a network with a fine stage, got preset {params.cfg.name!r}, which has none; go without a map"
            )
        self._params, self._map = params, LocalMap()
        self._scores: deque[float] = deque(maxlen=NUM_RECENT)
        self._inserted_at: np.ndarray | None = None

    def restart(self, scan: EncodedScan, T_world_lidar: np.ndarray) -> None:
        """A new map that begins with this scan."""
        self._map, self._inserted_at = LocalMap(), None
        self._scores.clear()
        self.insert(scan, T_world_lidar)

    def insert(self, scan: EncodedScan, T_world_lidar: np.ndarray) -> None:
        """Take in a scan, once a metre or so."""
        if self._inserted_at is not None:
            moved = se3.inverse(self._inserted_at) @ T_world_lidar
            if np.linalg.norm(moved[:3, 3]) < INSERT_M and se3.rotation_angle(moved[:3, :3]) < np.radians(INSERT_DEG):
                return
        self._map.insert(surfaces_of(scan), T_world_lidar)
        self._map.prune(T_world_lidar)
        self._inserted_at = T_world_lidar

    def locate(self, scan: EncodedScan, T_world_since: np.ndarray, T_since_guess: np.ndarray, *, recovering: bool = False) -> Estimate:
        """Motion T_since_current of a scan, from a guess of it; the guess itself when the scan does not fit the map.

        Args:
            scan: the new scan.
            T_world_since: pose that the motion starts from.
            T_since_guess: where to look.
            recovering: the guess may be far off: more learned steps.
        """
        cfg = self._params.cfg.status
        fix = register(self._params, scan, self._map, T_world_since @ T_since_guess, num_learned=RECOVERY_STEPS if recovering else 2)
        usual = max(float(np.median(self._scores)) if self._scores else 0.0, MIN_USUAL_SCORE)
        confidence = float(np.clip(2.5 * fix.score / usual - 0.7, 0.0, 1.0))  # 0.8 at 0.6 of the usual score, 0.2 at 0.36
        seen = observability(fix.information)
        usable = (scan.num_points, max(len(self._map), cfg.min_points))
        health = status.judge(num_points=usable, finite=fix.score > 0.0, confidence=confidence, seen=seen, cfg=cfg)
        T, known = T_since_guess, covariance.unknown(cfg)
        if health.status != "rejected":
            T = T_since_guess @ fix.T_start_lidar
            known = covariance.from_information(fix.information, sigma_m=SIGMA_M + fix.rms_m, num_planes=fix.score * NUM_INDEPENDENT)
            self._scores.append(fix.score)
        if health.status == "degenerate":
            known = covariance.widen(known, seen, cfg)
        return Estimate(T_target_source=T, **known._asdict(), status=health.status, confidence=health.confidence, reason=health.reason)


def surfaces_of(scan: EncodedScan) -> Surfaces:
    """What a scan shows."""
    return Surfaces(*(np.asarray(array)[: scan.num_points] for array in scan.scan[:3]))


def register(params: Model, scan: EncodedScan, local_map: LocalMap, T_world_start: np.ndarray, *, num_learned: int) -> MapFix:
    """Pose of a scan on the map from a start; score 0 where there is no map.

    The map is cropped in the frame of the start, so that its features are those that a sensor there would see. Neighbours are
    found by a tree on the host between jitted steps: less than a millisecond a round, where XLA on a CPU needs several.
    """
    seen = local_map.crop(T_world_start, CROP_M)
    if len(seen.points) < MIN_TARGETS:
        return MapFix(np.eye(4), 0.0, np.inf, np.zeros((6, 6)))
    tree = cKDTree(seen.points, balanced_tree=False, compact_nodes=False)
    T = np.eye(4, dtype=np.float32)
    source = jax.tree.map(lambda array: array[:NUM_LEARNED_POINTS], scan.encoding.cloud)
    for _ in range(num_learned):
        index = _nearest(tree, np.asarray(source.points), T)
        T = np.asarray(inference.fine_step(params, source, *(array[index] for array in seen), T))
    points, normals, mask = (np.asarray(array)[:NUM_ROBUST_POINTS] for array in (scan.scan.points, scan.scan.normals, scan.scan.mask))
    for _ in range(NUM_ROBUST_ROUNDS):
        index = _nearest(tree, points, T)
        matched = seen.points[index], seen.normals[index]
        fit = jax.device_get(
            inference.robust_steps(points, normals, mask, *matched, T, scale_m=SCALE_M, reach_m=REACH_M, num_steps=STEPS_PER_ROUND)
        )
        T = fit.T_target_source
    if not (np.isfinite(T).all() and np.isfinite(fit.information).all()):
        return MapFix(np.eye(4), 0.0, np.inf, np.zeros((6, 6)))
    T_start_lidar = se3.exp(se3.log(T.astype(np.float64)))  # orthonormal to float64
    return MapFix(T_start_lidar, float(fit.score), float(fit.rms_m), np.asarray(fit.information, np.float64))


def _nearest(tree: cKDTree, points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Row of the nearest target of each point."""
    return tree.query(points @ T[:3, :3].T + T[:3, 3])[1]
