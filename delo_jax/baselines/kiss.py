"""KISS-ICP and GenZ-ICP, whole odometries, and KISS-Matcher, a global registration; by their own packages."""

import numpy as np

from delo_jax.baselines.protocols import NUM_THREADS, Aligned, PairMethod, Sweep
from delo_jax.geometry import se3

FAR_M = 1e6  # beyond the range that KISS-ICP keeps
PERIOD_S = 0.1  # where no motion has been measured
MIN_INLIERS = 5  # below, KISS-Matcher's own example calls a registration failed


class KissIcp:
    """KISS-ICP, default settings.

    Its de-skew maps a point at time t by exp((s - 1) xi), s running from 0 to 1 over the times of the sweep and xi being the last
    motion: its pose is that at the sweep's end, and the stamp's is the same formula away. It takes the sweep to last from scan to
    scan. Where scans are left out, a point out of range, stamped one spacing before the end, tells it how long the motion took.
    """

    deskews = True

    def __init__(self):
        from kiss_icp.config import load_config
        from kiss_icp.kiss_icp import KissICP

        config = load_config(None)
        config.data.deskew = True  # of scans with times
        config.registration.max_num_threads = NUM_THREADS
        self._odometry, self._T_world_lidar = KissICP(config), np.eye(4)

    def track(self, sweep: Sweep, T_last_guess: np.ndarray) -> Aligned:
        """T_last_current; it predicts for itself."""
        T_world_lidar = self._pose(*sweep)
        motion, self._T_world_lidar = se3.inverse(self._T_world_lidar) @ T_world_lidar, T_world_lidar
        return Aligned.of(motion)

    def _pose(self, points: np.ndarray, times_s: np.ndarray | None, elapsed_s: float) -> np.ndarray:
        """T_world_lidar at the stamp."""
        kiss = self._odometry
        if times_s is None:
            kiss.register_frame(points, np.empty(0))
            return np.array(kiss.last_pose)
        begin_s, end_s = float(times_s.min()), float(times_s.max())
        if elapsed_s > 1.5 * (end_s - begin_s):
            begin_s = end_s - elapsed_s
            points, times_s = np.append(points, [[FAR_M, 0.0, 0.0]], axis=0), np.append(times_s, begin_s)
        motion = kiss.last_delta
        kiss.register_frame(points, times_s)
        return kiss.last_pose @ se3.exp(-end_s / max(end_s - begin_s, 1e-9) * se3.log(motion))


class GenzIcp:
    """GenZ-ICP with the numbers of its own set for outdoors.

    Its de-skew maps a point at s by exp((s - 0.5) xi), xi being the last motion; it takes s as it is given. An s of 0.5 + t / duration,
    t relative to the stamp and the duration that of the last motion, makes its pose that of the stamp. It uses as many threads as there
    are cores.
    """

    deskews = True

    def __init__(self):
        from genz_icp.config import load_config
        from genz_icp.genz_icp import GenZICP

        config = load_config(None)
        config.data.deskew, config.data.min_range = True, 0.5  # of scans with times; m
        config.mapping.voxel_size, config.mapping.max_points_per_voxel = 0.6, 3
        config.mapping.desired_num_voxelized_points, config.mapping.planarity_threshold = 3000, 0.2
        self._odometry, self._T_world_lidar = GenZICP(config), np.eye(4)
        self._duration_s = PERIOD_S  # of the last motion

    def track(self, sweep: Sweep, T_last_guess: np.ndarray) -> Aligned:
        """T_last_current; it predicts for itself."""
        shares = np.empty(0)
        if sweep.times_s is not None:
            shares = 0.5 + sweep.times_s / self._duration_s
        self._odometry.register_frame(sweep.points, shares)
        self._duration_s = sweep.elapsed_s or PERIOD_S
        T_world_lidar = np.array(self._odometry.last_pose)
        motion, self._T_world_lidar = se3.inverse(self._T_world_lidar) @ T_world_lidar, T_world_lidar
        return Aligned.of(motion)


class KissMatcher(PairMethod):
    """KISS-Matcher (Lim et al. 2025): features, outlier pruning and a robust solver; no start is needed, and none is used.

    Args:
        voxel_m: points are thinned to one per voxel, features are of 3 and 5 voxels [m].
    """

    def __init__(self, *, voxel_m: float = 0.3):
        import kiss_matcher

        self._config, self._new = kiss_matcher.KISSMatcherConfig(voxel_size=voxel_m), kiss_matcher.KISSMatcher

    def prepare(self, points: np.ndarray) -> np.ndarray:
        """Points in float32."""
        return points.astype(np.float32)

    def align(self, source: np.ndarray, target: np.ndarray, T_target_source_init: np.ndarray) -> Aligned:
        """T_target_source; the start where there is no solution."""
        matcher = self._new(self._config)
        solution, T = matcher.estimate(source, target), np.eye(4)
        T[:3, :3], T[:3, 3] = solution.rotation, np.ravel(solution.translation)
        if not solution.valid or not np.isfinite(T).all():
            return Aligned.of(T_target_source_init, "no solution", status="rejected")
        inliers = matcher.get_num_final_inliers()
        return Aligned.of(se3.orthonormal(T), "" if inliers >= MIN_INLIERS else f"{inliers} inliers, fewer than {MIN_INLIERS}")
