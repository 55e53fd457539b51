"""A network that is never wrong: scans that carry their own correspondences, aligned in closed form."""

import dataclasses

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from delo_jax.config import DeloConfig, StatusConfig
from delo_jax.inference import Estimate
from delo_jax.model.delo import Model
from delo_jax.pipeline.lidar_odometry import LidarOdometry
from tests.oracles.registration import hat

PARAMS = Model({}, DeloConfig(status=StatusConfig(min_points=20)))
SIGMA2 = np.array([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])  # variances of every estimate, order [omega, v]
TWIST = np.array([0.02, -0.04, 0.3, 9.0, 0.4, -0.1])  # body velocity per second
FEW = np.ones((3, 3), np.float32)
LANDMARKS = np.random.default_rng(7).uniform([-30, -30, -2], [30, 30, 8], size=(60, 3))
UNKNOWN = np.repeat([np.radians(30.0) ** 2, 25.0], 3)  # variances of a pose nobody measured, by default


def see(T_world_lidar, landmarks=LANDMARKS):
    """Landmarks in the sensor frame, float32; row i is landmark i."""
    T = np.linalg.inv(T_world_lidar)
    return (landmarks @ T[:3, :3].T + T[:3, 3]).astype(np.float32)


def noise(seed):
    """A scan that shows nothing: as many points as there are landmarks, anywhere."""
    return np.random.default_rng(seed).uniform(-30, 30, LANDMARKS.shape).astype(np.float32)


def kabsch(source, target):
    """T_target_source in float64, by scipy's solution of Wahba's problem."""
    source, target = source.astype(np.float64), target.astype(np.float64)
    rotation, _ = Rotation.align_vectors(target - target.mean(axis=0), source - source.mean(axis=0))
    T = np.eye(4)
    T[:3, :3] = rotation.as_matrix()
    T[:3, 3] = target.mean(axis=0) - T[:3, :3] @ source.mean(axis=0)
    return T


@dataclasses.dataclass(frozen=True, eq=False)
class ExactScan:
    """Landmarks as prepared; de-skewed by scipy's expm."""

    points: np.ndarray
    measured: np.ndarray
    times_s: np.ndarray | None = None

    @property
    def num_points(self):
        return len(self.points)

    def still(self, velocity):
        if self.times_s is None or velocity is None:
            return self
        Ts = expm(np.array([hat(t * velocity) for t in self.times_s]))
        points = np.einsum("nij,nj->ni", Ts[:, :3, :3], self.measured) + Ts[:, :3, 3]
        return dataclasses.replace(self, points=points.astype(np.float32))


class ExactNetwork:
    """`prepare` and `align` for LidarOdometry; remembers what it was asked.

    Scans of too few points are rejected, and those that no pose within reach brings within 2 m.
    """

    def __init__(self, reach_m=np.inf, *, copy=False):
        self.prepared, self.starts, self.pairs = [], [], []
        self._reach_m, self._copy = reach_m, copy

    def prepare(self, params, points, times_s):
        points, times_s = (None if array is None else array.copy() if self._copy else array for array in (points, times_s))
        self.prepared.append(points)
        return ExactScan(points, points, times_s)

    def _fits(self, T, source, target):
        apart = np.abs(source @ T[:3, :3].T + T[:3, 3] - target).max()
        return apart < 2.0 and np.linalg.norm(T[:3, 3]) < self._reach_m

    def align(self, params, source, target, T_target_source_init):
        self.starts.append(T_target_source_init)
        self.pairs.append((source.points, target.points))
        bad = min(source.num_points, target.num_points) < params.cfg.status.min_points
        T = T_target_source_init if bad else kabsch(source.points, target.points)
        if not bad and not self._fits(T, source.points, target.points):
            bad, T = True, T_target_source_init
        variances = UNKNOWN if bad else SIGMA2
        return Estimate(
            T_target_source=T,
            covariance=np.diag(variances),
            aleatoric=np.zeros(6),
            epistemic=variances,
            status="rejected" if bad else "ok",
            confidence=0.0 if bad else 0.9,
            reason="nothing to go by" if bad else "",
        )


def make(network=None, **options):
    """An odometry and its network."""
    network = ExactNetwork() if network is None else network
    return LidarOdometry(PARAMS, use_map=False, prepare=network.prepare, align=network.align, **options), network


def winding_road(num):
    """Poses whose rotations do not commute; the first is the identity."""
    steps = [expm(hat([0.05 * np.sin(k), 0.04, 0.3 * np.cos(k), 1.0 + 0.2 * k, 0.3 * np.sin(2 * k), 0.1])) for k in range(num - 1)]
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ step)
    return poses


def screw(seconds):
    """Pose at a time of the drive at constant velocity."""
    return expm(hat(np.asarray(TWIST) * seconds))
