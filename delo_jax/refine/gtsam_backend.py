"""Solves a plan with GTSAM: Levenberg-Marquardt on the whole graph, marginals from its factorisation."""

import gtsam
import numpy as np

from delo_jax.errors import DeloError
from delo_jax.refine.plan import CAUCHY_SCALE, GAUGE_SIGMA, Factors, Plan, Refined, check

MAX_ITERATIONS = 100
TOLERANCE = 1e-12  # of the error's change, relative and absolute


def gauge(T_world_lidar: np.ndarray, number: int = 0) -> gtsam.PriorFactorPose3:
    """Holds the pose that defines the world."""
    return gtsam.PriorFactorPose3(number, gtsam.Pose3(T_world_lidar), gtsam.noiseModel.Isotropic.Sigma(6, GAUGE_SIGMA))


def by_qr() -> gtsam.ISAM2Params:
    """Options of a Bayes tree: kilometres from the first pose, and where much was marginalised, Cholesky fails."""
    options = gtsam.ISAM2Params()
    options.setFactorization("QR")
    return options


def graph_of(factors: Factors) -> gtsam.NonlinearFactorGraph:
    """The factors as GTSAM's; twists and perturbations are the same there: right, [omega, v]."""
    loss = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY_SCALE)
    graph = gtsam.NonlinearFactorGraph()
    rows = zip(
        factors.sources.tolist(), factors.targets.tolist(), factors.Ts_source_target, factors.covariances, factors.robust, strict=True
    )
    for source, target, T, C, robust in rows:
        noise: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Covariance(0.5 * (C + C.T))
        if robust:
            noise = gtsam.noiseModel.Robust.Create(loss, noise)
        graph.add(gtsam.BetweenFactorPose3(source, target, gtsam.Pose3(T), noise))
    return graph


def solve(plan: Plan) -> Refined:
    """The poses that fit the factors best, with their marginal covariances.

    Raises:
        DeloError: a plan that cannot be solved; see `plan.check`.
    """
    Ts, factors = check(plan)
    graph = graph_of(factors)
    graph.add(gauge(Ts[0]))
    start = gtsam.Values()
    for number, T in enumerate(Ts):
        start.insert(number, gtsam.Pose3(T))
    options = gtsam.LevenbergMarquardtParams()
    options.setMaxIterations(MAX_ITERATIONS)
    options.setRelativeErrorTol(TOLERANCE)
    options.setAbsoluteErrorTol(TOLERANCE)
    try:
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, options)
        found = optimizer.optimize()
        tree = gtsam.ISAM2(by_qr())
        tree.update(graph, found)
        covariances = np.stack([tree.marginalCovariance(number) for number in range(len(Ts))])
    except RuntimeError as error:  # an indeterminate system
        raise DeloError(f"graph: expected one that determines all poses, got {str(error).strip().splitlines()[0]}") from error
    Ts_refined = np.stack([Ts[0], *(found.atPose3(number).matrix() for number in range(1, len(Ts)))])
    covariances[0] = 0.0
    num_iterations = optimizer.iterations()
    return Refined(Ts_refined, covariances, graph.error(start), graph.error(found), num_iterations, num_iterations < MAX_ITERATIONS)
