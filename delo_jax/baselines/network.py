"""The network as a pair method."""

import numpy as np

from delo_jax import inference
from delo_jax.baselines.protocols import Aligned, PairMethod
from delo_jax.inference import PreparedScan
from delo_jax.model.delo import Model


class Network(PairMethod):
    """`delo_jax.odometry` with some weights; without an evidence head, as DCP has none, without uncertainty.

    Args:
        params: weights.
    """

    def __init__(self, params: Model):
        self._params = params

    def prepare(self, points: np.ndarray) -> PreparedScan:
        """The scan, preprocessed; encoded when it is first aligned."""
        return inference.prepare(self._params, points.astype(np.float32))

    def align(self, source: PreparedScan, target: PreparedScan, T_target_source_init: np.ndarray) -> Aligned:
        """T_target_source from a start."""
        found = inference.align(self._params, source, target, T_target_source_init)
        covariance = np.full((6, 6), np.nan) if self._params.cfg.evidence.head == "none" else found.covariance
        return Aligned(found.T_target_source, covariance, found.status, found.reason)
