"""Does a pose graph gain what its information matrix predicts, do both backends agree, and how long do they take?

Motions along simulated bends and along KITTI's official poses, measured at gaps 1, 2 and 4 with independent noise of known covariance.

- Gain: error of the relative pose over 1, 10 and 100 frames, of the chained motions over that of the refined poses (root mean square),
  beside the same ratio from the inverse of the information matrix at the truth, assembled here and factorised by SciPy. Bound: within 10 %.
- Agreement of GTSAM and optimistix, up to 300 poses: at most 1e-6 rad and 1e-5 m.
- Wrong loops: a graph with twenty of them is at most 5 % worse than without.
- Time: 4,500 poses and 13,500 factors in batch (GTSAM, with marginals) under 15 s; the fixed-lag smoother under 5 ms a frame.

Run:     python experiments/pose_graph.py --data DIR      (about 6 minutes on 2 cores)
Expect:  all bounds kept.
"""

import time
from typing import NamedTuple

import _harness
import numpy as np
from _harness import Row
from _routes import SEQUENCES, official
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from delo_jax.geometry import se3
from delo_jax.metrics.ate import absolute_errors
from delo_jax.refine import gtsam_backend, jax_backend
from delo_jax.refine import plan as plans
from delo_jax.refine.fixed_lag import FixedLagSmoother

SIGMAS = np.repeat([1e-3, 1e-2], 3)  # rad, m
FRAMES = (1, 10, 100)
GAIN_OFF, AGREE_RAD, AGREE_M = 0.1, 1e-6, 1e-5
NUM_POSES, NUM_REPEATS = 201, 200
NUM_ASKED = 40  # pairs per gap of which the information is asked
NUM_WRONG = 20


class Gain(NamedTuple):
    """Root mean square errors of relative poses, rotation [rad] and translation [m]."""

    chained: np.ndarray  # (2,)
    refined: np.ndarray

    @property
    def ratio(self) -> np.ndarray:
        """(2,) how much smaller the refined one is."""
        return self.chained / self.refined


def bends(num_poses: int, rng: np.random.Generator) -> np.ndarray:
    """True poses of a winding drive, a metre a frame."""
    number = np.arange(num_poses - 1)
    yaw_rate = 0.03 * np.sin(number / rng.uniform(5, 20) + rng.uniform(0, 6))
    twists = np.stack([0 * number, 0.002 * np.sin(number), yaw_rate, 1.0 + 0 * number, 0 * number, 0 * number], 1)
    return poses_of(se3.exp(twists))


def poses_of(Ts_step: np.ndarray) -> np.ndarray:
    """Running product, from the identity."""
    Ts = [np.eye(4)]
    for T in Ts_step:
        Ts.append(Ts[-1] @ T)
    return np.stack(Ts)


def measured(Ts: np.ndarray, gap: int, rng: np.random.Generator) -> plans.Factors:
    """All motions over a gap, each with a noise of its own, known covariance."""
    sources = np.arange(len(Ts) - gap)
    turns, sizes = np.linalg.qr(rng.normal(size=(len(sources), 6, 6)))[0], rng.uniform(0.5, 1.5, size=(len(sources), 1, 6))
    halves = SIGMAS[:, None] * turns * sizes
    errors = (halves @ rng.normal(size=(len(sources), 6, 1)))[..., 0]
    between = se3.inverse(Ts[sources]) @ Ts[sources + gap]
    kind = plans.ODOMETRY if gap == 1 else plans.MULTI_FRAME
    return plans.factors(sources, sources + gap, between @ se3.exp(errors), halves @ halves.transpose(0, 2, 1), kind)


def noisy_plan(Ts: np.ndarray, rng: np.random.Generator) -> plans.Plan:
    """Motions at gaps 1, 2 and 4, begun from the chain."""
    lots = [measured(Ts, gap, rng) for gap in (1, 2, 4)]
    return plans.Plan(poses_of(lots[0].Ts_source_target), plans.joined(lots))


def relative_errors(Ts: np.ndarray, Ts_true: np.ndarray, gap: int) -> np.ndarray:
    """(n, 6) twists."""
    true, found = (se3.inverse(poses[:-gap]) @ poses[gap:] for poses in (Ts_true, Ts))
    return se3.log(se3.inverse(true) @ found)


def rms(errors: np.ndarray) -> np.ndarray:
    """(2,) of rotation and translation."""
    return np.sqrt(np.mean(np.sum(errors.reshape(-1, 2, 3) ** 2, axis=2), axis=0))


def predicted(Ts: np.ndarray, factors: plans.Factors, gap: int, starts: np.ndarray) -> np.ndarray:
    """(2,) root mean square that the information matrix at the truth gives to relative poses."""
    whiteners = np.linalg.inv(np.linalg.cholesky(factors.covariances))
    steps = se3.inverse(Ts[factors.sources]) @ Ts[factors.targets]
    J = whiteners @ np.concatenate([-se3.adjoint(se3.inverse(steps)), np.broadcast_to(np.eye(6), (len(steps), 6, 6))], axis=2)
    blocks = J.transpose(0, 2, 1) @ J
    index = (6 * np.stack([factors.sources, factors.targets], 1)[:, :, None] + np.arange(6)).reshape(-1, 12)
    rows, columns = np.broadcast_arrays(index[:, :, None], index[:, None, :])
    size = 6 * len(Ts)
    H = coo_array((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size)).tocsc()[6:, 6:]
    solver, squares = splu(H), []
    for start in starts:
        Ad = se3.adjoint(se3.inverse(Ts[start + gap]) @ Ts[start])
        A = np.zeros((size, 6))
        A[6 * start : 6 * start + 6] = -Ad.T
        A[6 * (start + gap) : 6 * (start + gap) + 6] += np.eye(6)
        covariance = A[6:].T @ solver.solve(A[6:])
        squares.append(np.diag(covariance).reshape(2, 3).sum(axis=1))
    return np.sqrt(np.mean(squares, axis=0))


def asked(num_poses: int, gap: int) -> np.ndarray:
    """Starts of the pairs that the information is asked of, all along the drive."""
    return np.unique(np.linspace(0, num_poses - 1 - gap, NUM_ASKED).astype(int))


def gains(Ts_true: list[np.ndarray], seed: int) -> dict[int, tuple[Gain, Gain]]:
    """Measured and predicted, by number of frames, over drives."""
    rng = np.random.default_rng(seed)
    errors: dict[int, list] = {gap: [] for gap in FRAMES}
    expected: dict[int, list] = {gap: [] for gap in FRAMES}
    for Ts in Ts_true:
        plan = noisy_plan(Ts, rng)
        refined = gtsam_backend.solve(plan).Ts_world_lidar
        chain = plan.factors.rows(~plan.factors.robust)
        for gap in FRAMES:
            starts = asked(len(Ts), gap)
            found = [relative_errors(poses, Ts, gap)[:: max(1, gap // 10)] for poses in (plan.Ts_world_lidar, refined)]
            errors[gap].append([rms(one) ** 2 for one in found])
            expected[gap].append([predicted(Ts, factors, gap, starts) ** 2 for factors in (chain, plan.factors)])
    return {gap: (Gain(*np.sqrt(np.mean(errors[gap], axis=0))), Gain(*np.sqrt(np.mean(expected[gap], axis=0)))) for gap in FRAMES}


def show_gains(title: str, table: dict[int, tuple[Gain, Gain]]) -> list[Row]:
    """Prints them; rows with bounds."""
    print(f"\n## {title}\n")
    print("| frames | chained mrad | refined | gain | predicted | chained cm | refined | gain | predicted |\n|---:|" + "---:|" * 8)
    rows = []
    for gap, (found, expected) in table.items():
        halves = [
            f"{scale * found.chained[i]:.3f} | {scale * found.refined[i]:.3f} | {found.ratio[i]:.3f} | {expected.ratio[i]:.3f}"
            for i, scale in ((0, 1e3), (1, 1e2))
        ]
        print(f"| {gap} | {' | '.join(halves)} |", flush=True)
        for i, what in enumerate(("rotation", "translation")):
            off = abs(found.ratio[i] / expected.ratio[i] - 1.0)
            rows.append(Row(f"{title}, {gap} frames, {what}: gain off by", 100 * off, "%", 100 * GAIN_OFF))
    return rows


def agreement(sizes: tuple[int, ...]) -> list[Row]:
    """Both backends on the same plans, a true loop among the factors."""
    print(
        "\n## Agreement\n\n| poses | factors | rad | m | optimistix steps | GTSAM steps | GTSAM s | optimistix s, compiled |\n|"
        + "---:|" * 8
    )
    worst = np.zeros(2)
    for size in sizes:
        rng = np.random.default_rng(size)
        Ts = bends(size, rng)
        plan = noisy_plan(Ts, rng)
        T_loop = se3.inverse(Ts[0]) @ Ts[-1] @ se3.exp(SIGMAS * rng.normal(size=6))
        loop = plans.factors([0], [size - 1], T_loop[None], np.diag(SIGMAS**2)[None], plans.LOOP)
        plan = plan._replace(factors=plans.joined([plan.factors, loop]))
        begin = time.perf_counter()
        ours = gtsam_backend.solve(plan)
        gtsam_s = time.perf_counter() - begin
        jax_backend.solve(plan)
        begin = time.perf_counter()
        other = jax_backend.solve(plan)
        jax_s = time.perf_counter() - begin
        off = np.abs(se3.log(se3.inverse(ours.Ts_world_lidar) @ other.Ts_world_lidar)).reshape(-1, 2, 3).max(axis=(0, 2))
        worst = np.maximum(worst, off)
        steps = f"{other.num_iterations} | {ours.num_iterations} | {gtsam_s:.2f} | {jax_s:.2f}"
        print(f"| {size} | {len(plan.factors.sources)} | {off[0]:.1e} | {off[1]:.1e} | {steps} |", flush=True)
    microns = Row("backends: differ by, translation", 1e6 * worst[1], "um", 1e6 * AGREE_M)
    return [Row("backends: differ by, rotation", 1e6 * worst[0], "urad", 1e6 * AGREE_RAD), microns]


def wrong_loops() -> list[Row]:
    """Loops that are wrong by metres and say centimetres."""
    rng = np.random.default_rng(5)
    Ts = bends(300, rng)
    plan = noisy_plan(Ts, rng)
    ends = np.sort(rng.choice(300, size=(NUM_WRONG, 2), replace=False), axis=1)
    T_wrong = se3.exp(np.concatenate([rng.normal(size=(NUM_WRONG, 3)), 10.0 * rng.normal(size=(NUM_WRONG, 3))], axis=1))
    wrong = plans.factors(ends[:, 0], ends[:, 1], T_wrong, np.broadcast_to(np.diag(SIGMAS**2), (NUM_WRONG, 6, 6)), plans.LOOP)
    without, spoiled = (
        absolute_errors(gtsam_backend.solve(plan._replace(factors=rows)).Ts_world_lidar, Ts).rmse_m
        for rows in (plan.factors, plans.joined([plan.factors, wrong]))
    )
    chained = absolute_errors(plan.Ts_world_lidar, Ts).rmse_m
    print("\n## Wrong loops\n")
    print(f"ATE of 300 poses: chained {chained:.3f} m, refined {without:.3f} m, with {NUM_WRONG} wrong loops {spoiled:.3f} m")
    return [Row("wrong loops: ATE, with / without", spoiled / without, "", 1.05)]


def times(num_poses: int) -> list[Row]:
    """Batch with marginals, and the stream."""
    plan = noisy_plan(bends(num_poses, np.random.default_rng(6)), np.random.default_rng(7))
    begin = time.perf_counter()
    found = gtsam_backend.solve(plan)
    batch_s = time.perf_counter() - begin
    rows = plan.factors
    by_target = [rows.rows(np.flatnonzero(rows.targets == number)) for number in range(num_poses)]
    smoother, spent = FixedLagSmoother(plan.Ts_world_lidar[0]), []
    for number in range(1, num_poses):
        ending = by_target[number]
        begin = time.perf_counter()
        smoother.add(ending.rows(~ending.robust), ending.rows(ending.robust))
        smoother.iterate()
        spent.append(1e3 * (time.perf_counter() - begin))
    p50, p95 = np.percentile(spent, [50, 95])
    print(f"\n## Time\n\n{num_poses} poses, {len(rows.sources)} factors: {batch_s:.1f} s, {found.num_iterations} steps, marginals with it")
    print(f"fixed-lag smoother: {p50:.2f} ms a frame (median), {p95:.2f} ms (95 %), {max(spent):.1f} ms (most)")
    return [Row("batch of a long drive", batch_s, "s", 15.0), Row("smoother, 95 % of frames within", float(p95), "ms", 5.0)]


def main(argv: list[str] | None = None) -> int:
    """All parts."""
    args = _harness.parser(__doc__, needs_data=True).parse_args(argv)
    rng = np.random.default_rng(0)
    repeats, sizes, num_long = (5, (30,), 500) if args.quick else (NUM_REPEATS, (30, 100, 300), 4503)
    rows = show_gains("Simulated bends", gains([bends(NUM_POSES, rng) for _ in range(repeats)], seed=1))
    names = SEQUENCES[:2] if args.quick else SEQUENCES
    drives = [se3.orthonormal(official(args.data, name, "camera")) for name in names]
    rows += show_gains("KITTI's official motions", gains(drives, seed=2))
    rows += agreement(sizes) + wrong_loops() + times(num_long)
    return _harness.finish(rows, {"repeats": repeats, "sequences": list(names), "sigmas": SIGMAS.tolist()}, args)


if __name__ == "__main__":
    _harness.run(main)
