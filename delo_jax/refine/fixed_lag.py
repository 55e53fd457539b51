"""Smooths a stream with GTSAM's incremental fixed-lag smoother: the newest poses are estimated anew with every factor, older ones stand."""

from typing import Any

import gtsam
import numpy as np

from delo_jax.errors import DeloError
from delo_jax.geometry import se3
from delo_jax.refine.gtsam_backend import by_qr, gauge, graph_of
from delo_jax.refine.plan import ODOMETRY, Factors, check_factors, factors, joined

LAG = 20  # frames


class FixedLagSmoother:
    """Poses of a stream; not thread-safe.

    Args:
        T_world_first: (4, 4) pose of frame 0.
        lag: frames whose poses may still change.
    """

    def __init__(self, T_world_first: np.ndarray, *, lag: int = LAG):
        options = by_qr()
        options.relinearizeSkip = 1
        options.setRelinearizeThreshold(0.001)
        self._lag, self._smoother = lag, gtsam.IncrementalFixedLagSmoother(float(lag), options)
        self.Ts_world_lidar = [T_world_first.copy()]
        """Pose of every frame so far, as it was last estimated."""
        graph = gtsam.NonlinearFactorGraph()
        graph.add(gauge(T_world_first))
        self._update(graph, 0, T_world_first)

    def add(self, motion: Factors, others: Factors | None = None) -> None:
        """The next frame: its motion since an earlier one, and other factors that end there or earlier.

        A motion that starts at a frame which has left the lag is hung on the last frame instead; other factors from there are left out.

        Raises:
            DeloError: a factor that no graph could hold; nothing is added.
        """
        number = len(self.Ts_world_lidar)
        if motion.targets.tolist() != [number]:
            raise DeloError(f"motion: expected one factor to frame {number}, got factors to {motion.targets.tolist()}; add frames in order")
        check_factors(motion, number + 1)
        source, T = int(motion.sources[0]), motion.Ts_source_target[0]
        T_world_lidar = self.Ts_world_lidar[source] @ T
        oldest = number - self._lag
        if source < oldest:
            T_last = se3.inverse(self.Ts_world_lidar[-1]) @ T_world_lidar
            motion = factors([number - 1], [number], T_last[None], motion.covariances, ODOMETRY)
        if others is not None:
            others = others.rows(np.minimum(others.sources, others.targets) >= oldest)
            check_factors(others, number + 1)
            motion = joined([motion, others])
        self._update(graph_of(motion), number, T_world_lidar)

    def iterate(self) -> None:
        """One more step towards the best fit of what is known."""
        self._step(gtsam.NonlinearFactorGraph(), gtsam.Values(), {})
        self._take()

    def _update(self, graph: gtsam.NonlinearFactorGraph, number: int, T_world_lidar: np.ndarray) -> None:
        values = gtsam.Values()
        values.insert(number, gtsam.Pose3(T_world_lidar))
        self._step(graph, values, {number: float(number)})
        if number == len(self.Ts_world_lidar):
            self.Ts_world_lidar.append(T_world_lidar)
        self._take()

    def _step(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, times: Any) -> None:
        try:
            self._smoother.update(graph, values, times)
        except RuntimeError as error:  # an indeterminate system; the smoother is of no use any more
            raise DeloError(f"smoother: expected a graph that determines all poses, got {str(error).strip().splitlines()[0]}") from error

    def _take(self) -> None:
        found = self._smoother.calculateEstimate()
        for number in found.keys():  # noqa: SIM118 - GTSAM's, no dictionary
            self.Ts_world_lidar[number] = found.atPose3(number).matrix()
