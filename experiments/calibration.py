"""Which covariance of a pair fits the errors: the evidence as it is, rescaled, the registration's information, or a full one.

Pairs of simulated worlds with exact truth, at gaps 1, 2, 3 and 5, in both directions, from the identity. What has to be fitted is fitted
on the worlds of `delo calibrate` (other seeds) by maximum likelihood; nothing is fitted on the worlds of the table. Lost pairs are apart.

- evidence: normal-inverse-gamma, the moments of the released head, second moment about the pose.
- evidence, rescaled: each sigma to a power, times a factor, axis by axis: twelve numbers.
- information: inverse Gauss-Newton matrix of the planes, scaled for rotation and translation, plus a variance per axis: eight numbers.
- full: `ops.spread`, a Cholesky factor in the frame of the motion, from the solver's statistics and the evidence; the default.

Run:     python experiments/calibration.py                      (about 10 minutes on 2 cores; worlds are kept in runs/)
Expect:  all bounds kept.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import _harness
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from _harness import Row

import delo_jax
from delo_jax.metrics.calibration import coverage, nees, negative_log_likelihood, sparsification_error
from delo_jax.model.delo import Model
from delo_jax.train.calibrate import LEVELS as BOUNDED_LEVELS
from delo_jax.train.calibrate import NUM_FRAMES, Pairs, halves, solved_pairs
from delo_jax.train.worlds import CALIBRATION_SEED, stored_worlds
from delo_jax.uncertainty import covariance
from delo_jax.uncertainty.observability import AXES

UNSEEN_SEED = 1_600_000
NUM_UNSEEN, NUM_FITTED, NUM_QUICK = 150, 200, 4
UNITS = np.repeat([1e-3, 1e-2], 3)  # rad, m
LEVELS = (0.5, 0.68, 0.9, 0.95, 0.99)
POINTS, NEES_RANGE = 5.0, (0.8, 1.25)
GAPS = (1, 2, 3, 5)
FULL = "full"


def raw(pairs: Pairs) -> np.ndarray:
    """Covariances (n, 6, 6) of the evidence as it is."""
    numbers = zip(*(np.asarray(array, np.float64) for array in pairs.nig), strict=True)
    return np.stack([covariance.from_evidence(*nig).covariance for nig in numbers])


def rescaled(free, pairs: Pairs, evidence) -> jax.Array:
    """Of the evidence, each sigma to a power and times a factor."""
    sigmas = jnp.sqrt(jnp.diagonal(evidence, axis1=1, axis2=2)) / UNITS[None]
    return jax.vmap(jnp.diag)((jnp.exp(free[None, :6]) * UNITS[None] * sigmas ** free[None, 6:]) ** 2)


def of_information(free, pairs: Pairs, evidence) -> jax.Array:
    """Inverse of the information, scaled, plus a variance per axis."""
    lever = jnp.asarray(np.repeat([1.0 / 15.0, 1.0], 3), jnp.float32)
    scaled = pairs.information * lever[None, :, None] * lever[None, None, :] + 1e-4 * jnp.eye(6)[None]
    size = lever * jnp.repeat(jnp.exp(free[:2]), 3) * 1e-2
    floors = jnp.diag((jnp.exp(free[2:]) * UNITS) ** 2)
    return jnp.linalg.inv(scaled) * size[None, :, None] * size[None, None, :] + floors[None]


def fitted(model: Callable, start: np.ndarray, pairs: Pairs) -> np.ndarray:
    """Numbers that make the errors most likely."""
    evidence, errors = jnp.asarray(raw(pairs), jnp.float32), jnp.asarray(pairs.errors / UNITS, jnp.float32)
    rows = jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), pairs)

    def loss(free, _):
        C = model(free, rows, evidence) / (UNITS[:, None] * UNITS[None, :])[None]
        L = jnp.linalg.cholesky(C)
        white = jax.scipy.linalg.solve_triangular(L, errors[:, :, None], lower=True)[..., 0]
        log_det = jnp.sum(jnp.log(jnp.diagonal(L, axis1=1, axis2=2)), axis=1)
        return jnp.mean(0.5 * jnp.sum(white**2, axis=1) + log_det)

    solver: Any = optimistix.BFGS(rtol=1e-5, atol=1e-6)
    return np.asarray(optimistix.minimise(loss, solver, jnp.asarray(start, jnp.float32), max_steps=500, throw=False).value)


def candidates(model: Model, seen: Pairs, unseen: Pairs) -> dict[str, np.ndarray]:
    """Covariances (n, 6, 6) of the unseen pairs, by method."""
    evidence = raw(unseen)
    rows = jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), unseen)
    found = {"evidence": evidence}
    for name, formula, start in (
        ("evidence, rescaled", rescaled, np.repeat([0.0, 1.0], 6)),
        ("information", of_information, np.zeros(8)),
    ):
        free = jnp.asarray(fitted(formula, start, seen))
        found[name] = np.asarray(formula(free, rows, jnp.asarray(evidence, jnp.float32)), np.float64)
    H = halves(model, model.variables["covariance"], unseen)
    return found | {FULL: H @ H.transpose(0, 2, 1)}


def show(title: str, pairs: Pairs, by_method: dict[str, np.ndarray]) -> None:
    """Likelihood, consistency, sharpness, sparsification; then coverage."""
    print(f"\n## {title}: {len(pairs.errors)} pairs\n")
    print("| covariance | nats | squared / expected | sigma: mrad | sigma: cm | AUSE rotation | AUSE translation |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for name, C in by_method.items():
        sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
        sharpness = 1e3 * np.median(sigma[:, :3]), 100 * np.median(sigma[:, 3:])
        ause = " | ".join(f"{value:.3f}" for value in sparsifications(pairs.errors, C))
        likelihood, squared = negative_log_likelihood(pairs.errors, C).mean(), nees(pairs.errors, C).mean() / 6
        print(f"| {name} | {likelihood:.2f} | {squared:.2f} | {sharpness[0]:.2f} | {sharpness[1]:.2f} | {ause} |")
    constant = sparsifications(pairs.errors, np.broadcast_to(np.eye(6), (len(pairs.errors), 6, 6)))
    print(f"| constant | | | | | {constant[0]:.3f} | {constant[1]:.3f} |")
    print(f"\n| covariance | level | {' | '.join(AXES)} |\n|---|---:|{'---:|' * 6}")
    for name, C in by_method.items():
        sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
        for level in LEVELS:
            cells = " | ".join(f"{100 * share:.1f}" for share in coverage(pairs.errors, sigma, level))
            print(f"| {name} | {100 * level:.0f} % | {cells} |")


def sparsifications(errors: np.ndarray, C: np.ndarray) -> tuple[float, float]:
    """Of the length of the rotation's and of the translation's error, ordered by the trace of its covariance."""
    parts = slice(0, 3), slice(3, 6)
    sizes = (np.sqrt(np.trace(C[:, part, part], axis1=1, axis2=2)) for part in parts)
    values = [sparsification_error(np.linalg.norm(errors[:, part], axis=1), size) for part, size in zip(parts, sizes, strict=True)]
    return values[0], values[1]


def judge(pairs: Pairs, C: np.ndarray) -> list[Row]:
    """Bounds of the default."""
    sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    rows = []
    for level in BOUNDED_LEVELS:
        shares = 100 * coverage(pairs.errors, sigma, level)
        for axis, share in zip(AXES, shares, strict=True):
            rows.append(Row(f"{axis}: coverage at {100 * level:.0f} %, off by", abs(float(share) - 100 * level), "points", POINTS))
    squared = float(nees(pairs.errors, C).mean()) / 6
    rows += [Row("error squared / expected", squared, "", NEES_RANGE[1]), Row("the same", squared, "", NEES_RANGE[0], True)]
    constant = sparsifications(pairs.errors, np.broadcast_to(np.eye(6), C.shape))
    for what, ours, level in zip(("rotation", "translation"), sparsifications(pairs.errors, C), constant, strict=True):
        rows.append(Row(f"{what}: AUSE / that of a constant variance", ours / level, "", 1.0))
    return rows


def solved(model: Model, folder: Path, name: str, seed: int, count: int, bar) -> Pairs:
    """Solved pairs of some worlds; prints how many are lost, which are left out."""
    task = bar.add_task(f"{name} worlds", total=count)
    cfg = model.cfg.preprocess
    worlds = stored_worlds(folder, name, count, seed, num_frames=NUM_FRAMES, cfg=cfg, on_world=lambda: bar.advance(task))
    pairs = solved_pairs(model, worlds)
    lost = pairs.lost(model)
    print(f"{name} worlds {seed} to {seed + count - 1}: {len(lost)} pairs, {lost.sum()} lost")
    return pairs.rows(np.flatnonzero(~lost))


def main(argv: list[str] | None = None) -> int:
    """Solve, fit, print, judge."""
    parser = _harness.parser(__doc__, needs_data=False)
    parser.add_argument("--weights", default="delo-base", help="name or file, calibrated")
    parser.add_argument("--out", type=Path, default=Path("runs/calibrated"), help="folder of `delo calibrate`, for worlds")
    args = parser.parse_args(argv)
    model = delo_jax.load(args.weights)
    num_unseen, num_fitted = (NUM_QUICK, NUM_QUICK) if args.quick else (NUM_UNSEEN, NUM_FITTED)
    with _harness.progress() as bar:
        seen = solved(model, args.out / "worlds", "calibration", CALIBRATION_SEED, num_fitted, bar)
        unseen = solved(model, args.out / "worlds", "unseen", UNSEEN_SEED, num_unseen, bar)
    by_method = candidates(model, seen, unseen)
    show("Unseen worlds", unseen, by_method)
    for gap in GAPS:
        rows = np.flatnonzero(np.abs(unseen.gaps) == gap)
        show(f"Gap {gap}", unseen.rows(rows), {name: C[rows] for name, C in by_method.items() if name in ("evidence", FULL)})
    return _harness.finish(judge(unseen, by_method[FULL]), {"weights": args.weights, "unseen": num_unseen, "fitted": num_fitted}, args)


if __name__ == "__main__":
    _harness.run(main)
