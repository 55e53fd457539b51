"""Loop closures: where the trajectory may have come back to, and whether the scans say so too."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import chi2

from delo_jax.geometry import se3
from delo_jax.inference import Estimate
from delo_jax.refine.plan import LOOP, Factors, Plan, between_frames, carried

REACH_M = 8.0  # within which two scans are aligned without a prior
MAX_SEARCH_M = 30.0  # however little is known of where the sensor is
SPACING_M, MIN_WAY_M = 3.0, 40.0  # between places that are looked at; between the two ends of a loop
MAX_PER_PLACE = 2
CONSISTENT = float(chi2(6).ppf(0.999))  # of a squared Mahalanobis distance


class Chain(NamedTuple):
    """Poses, and what is known of the motion between two of them that lie on one path: rejected frames lie on none."""

    Ts_world_lidar: np.ndarray  # (n, 4, 4)
    covariances: np.ndarray  # (n, 6, 6) left perturbation, in the world, grown since frame 0

    @classmethod
    def of(cls, plan: Plan) -> "Chain":
        """From the odometry's factors of a plan."""
        Ts, rows = plan.Ts_world_lidar, plan.factors.rows(~plan.factors.robust)
        grown = np.zeros((len(Ts), 6, 6))
        in_world = carried(rows.covariances, se3.inverse(Ts[rows.targets]))
        for source, target, C in zip(rows.sources, rows.targets, in_world, strict=True):
            grown[target] = grown[source] + C
        return cls(Ts, grown)

    def between(self, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Motions (k, 4, 4) of pairs of frames, and their covariances (k, 6, 6), right perturbation."""
        sources, targets = pairs.T
        T_target_world = se3.inverse(self.Ts_world_lidar[targets])
        Ad = se3.adjoint(T_target_world)
        between = se3.inverse(self.Ts_world_lidar[sources]) @ self.Ts_world_lidar[targets]
        return between, Ad @ (self.covariances[targets] - self.covariances[sources]) @ Ad.transpose(0, 2, 1)


def propose(chain: Chain, usable: np.ndarray) -> np.ndarray:
    """(k, 2) earlier and later frame of places that the sensor may have come back to.

    Two frames are proposed where their distance, less twice what is not known of it, is within the reach of an alignment without a prior.

    Args:
        chain: the odometry.
        usable: (n,) frames with a scan that was registered.
    """
    positions = chain.Ts_world_lidar[:, :3, 3]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    numbers = np.flatnonzero(usable)
    _, first = np.unique(way[numbers] // SPACING_M, return_index=True)
    places = numbers[first]
    tree, found = cKDTree(positions[places]), []
    for later in places:
        near = places[tree.query_ball_point(positions[later], MAX_SEARCH_M)]
        near = near[way[later] - way[near] > MIN_WAY_M]
        if len(near) == 0:
            continue
        pairs = np.stack([near, np.full(len(near), later)], 1)
        Ts, Cs = chain.between(pairs)
        unknown = 2.0 * np.sqrt(np.linalg.eigvalsh(Cs[:, 3:, 3:])[:, -1].clip(min=0.0))
        distance = np.linalg.norm(Ts[:, :3, 3], axis=1)
        order = np.argsort(distance)
        found += [pairs[i] for i in order[:MAX_PER_PLACE] if distance[i] < REACH_M + unknown[i]]
    return np.array(found, np.int64).reshape(-1, 2)


def verify(chain: Chain, pairs: np.ndarray, there: list[Estimate], back: list[Estimate], local: np.ndarray) -> Factors:
    """Factors of the proposed pairs that the scans agree to.

    A loop counts when both alignments, earlier to later and later to earlier and each without a prior, are `ok`, undo each other, and agree
    with the chain, within what they and the chain do not know.

    Args:
        chain: the odometry.
        pairs: (k, 2) from `propose`.
        there: of the k pairs, T_later_earlier.
        back: of the k pairs, T_earlier_later.
        local: (n, 6, 6) of the frames, as in `plan.odometry_factors`.
    """
    kept, Ts, Cs = [], [], []
    for pair, forth, home in zip(pairs, there, back, strict=True):
        if forth.status != "ok" or home.status != "ok":
            continue
        motion = forth.inverted()
        T_expected, C_expected = (one[0] for one in chain.between(pair[None]))
        C_ends = carried(local[pair[:1]], motion.T_target_source[None])[0] + local[pair[1]]
        apart = se3.log(se3.inverse(motion.T_target_source) @ home.T_target_source)
        off = se3.log(se3.inverse(T_expected) @ motion.T_target_source)
        both = motion.covariance + home.covariance
        if _distance(apart, both) < CONSISTENT and _distance(off, C_expected + motion.covariance + C_ends) < CONSISTENT:
            kept.append(pair)
            Ts.append(motion.T_target_source)
            Cs.append(motion.covariance)
    return between_frames(np.array(kept, np.int64).reshape(-1, 2), np.array(Ts), np.array(Cs), local, LOOP)


def _distance(twist: np.ndarray, covariance: np.ndarray) -> float:
    """Squared Mahalanobis length."""
    return float(twist @ np.linalg.solve(covariance, twist))
