"""Graphs along a known drive, with noise of known covariance."""

import numpy as np

from delo_jax.geometry import se3
from delo_jax.refine import plan as plans

SIGMAS = np.repeat([2e-3, 2e-2], 3)


def drive(num_poses: int) -> np.ndarray:
    """A bending drive of a metre a frame."""
    number = np.arange(num_poses - 1)
    zeros = np.zeros(num_poses - 1)
    twists = np.stack([0.002 * np.cos(number), 0.01 * np.sin(number / 3), 0.05 * np.sin(number / 9), zeros + 1.0, zeros, 0.02 * zeros], 1)
    Ts = [np.eye(4)]
    for T in se3.exp(twists):
        Ts.append(Ts[-1] @ T)
    return np.stack(Ts)


def measured(Ts: np.ndarray, pairs: np.ndarray, kind: int, rng: np.random.Generator, *, noise: float = 1.0) -> plans.Factors:
    """Factors with correlated noise; each has its own covariance."""
    halves = SIGMAS[:, None] * (np.eye(6) + 0.3 * rng.normal(size=(len(pairs), 6, 6)))
    errors = (halves @ rng.normal(size=(len(pairs), 6, 1)))[..., 0]
    between = se3.inverse(Ts[pairs[:, 0]]) @ Ts[pairs[:, 1]]
    return plans.factors(pairs[:, 0], pairs[:, 1], between @ se3.exp(noise * errors), halves @ halves.transpose(0, 2, 1), kind)


def chained(odometry: plans.Factors) -> np.ndarray:
    """Poses that the odometry alone leads to."""
    Ts = [np.eye(4)]
    for T in odometry.Ts_source_target:
        Ts.append(Ts[-1] @ T)
    return np.stack(Ts)


def multi_frame_pairs(num_poses: int) -> np.ndarray:
    """(k, 2) frames two apart, and every fourth with the fourth next, as the paper has it."""
    return np.array([(f, f + 2) for f in range(num_poses - 2)] + [(f, f + 4) for f in range(0, num_poses - 4, 4)])


def noisy_plan(num_poses: int, seed: int) -> plans.Plan:
    """Odometry and multi-frame factors of a drive."""
    rng, Ts, number = np.random.default_rng(seed), drive(num_poses), np.arange(num_poses - 1)
    odometry = measured(Ts, np.stack([number, number + 1], 1), plans.ODOMETRY, rng)
    multi = measured(Ts, multi_frame_pairs(num_poses), plans.MULTI_FRAME, rng)
    return plans.Plan(chained(odometry), plans.joined([odometry, multi]))
