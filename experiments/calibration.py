"""Which covariance of a pair fits the errors: the evidence as it is, rescaled, the registration's information, or a full one.

Pairs of simulated worlds with exact truth, at gaps 1, 2, 3 and 5, in both directions, from the identity. What has to be fitted is fitted
on the worlds of `delo calibrate` (other seeds) by maximum likelihood; nothing is fitted on the worlds of the table. Lost pairs are apart.

- evidence: normal-inverse-gamma, the moments of the released head, second moment about the pose.
- evidence, rescaled: each sigma to a power, times a factor, axis by axis: twelve numbers.
- information: inverse Gauss-Newton matrix of the planes, scaled for rotation and translation, plus a variance per axis: eight numbers.
- full: `ops.spread`, a Cholesky factor in the frame of the motion, from the solver's statistics and the evidence; the default.
- Student: the same head under a multivariate Student-t likelihood, its degrees of freedom fitted too; its intervals are those of t.
- ensemble of 5 heads: mean covariance of five such heads, each fitted on a bootstrap sample of the worlds; their mean is the same pose.

Only `full` has had its last scales set on folds. Then the default in bins of speed, turn rate and overlap (share of the source points that
have a target point within 1 m at the true pose, of the preprocessed scans). Figures go to the folder of the worlds.

Run:     python experiments/calibration.py                      (about 25 minutes on 2 cores once `delo calibrate` has made its worlds)
Expect:  all bounds kept.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import _harness
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from _harness import Row
from _uncertainty import relative
from scipy.spatial import cKDTree
from scipy.stats import multivariate_t, norm
from scipy.stats import t as student_t

import delo_jax
from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.geometry import se3
from delo_jax.metrics.calibration import coverage, nees, negative_log_likelihood, sparsification_error
from delo_jax.model.delo import Model
from delo_jax.ops import spread
from delo_jax.report.calibration import error_figure, reliability_figure
from delo_jax.train.calibrate import LEVELS as BOUNDED_LEVELS
from delo_jax.train.calibrate import NUM_FRAMES, Pairs, fit, halves, solved_pairs
from delo_jax.train.worlds import CALIBRATION_SEED, World, scan_of, stored_worlds
from delo_jax.uncertainty import covariance
from delo_jax.uncertainty.observability import AXES

UNSEEN_SEED = 1_600_000
FRAMES = ((0, 1), (2, 3), (4, 5), (0, 2), (3, 5), (0, 3), (1, 4), (0, 5), (1, 0), (4, 2), (5, 2))  # (source, target) of unseen pairs
NUM_UNSEEN, NUM_FITTED, NUM_QUICK = 150, 900, 4
NUM_HEADS = 5
UNITS = np.repeat([1e-3, 1e-2], 3)  # rad, m
LEVELS = (0.5, 0.68, 0.9, 0.95, 0.99)
POINTS, NEES_RANGE = 5.0, (0.8, 1.25)
GAPS = (1, 2, 3, 5)
FULL = "full"
BINS = {  # edges
    "speed, m/s": (0.0, 3.0, 8.0, 15.0, np.inf),
    "turn rate, deg/s": (0.0, 2.0, 5.0, 15.0, np.inf),
    "overlap": (0.0, 0.5, 0.6, 0.7, 0.8, 1.01),
}
NEAR_M = 1.0
FRAME_S = 1e-9 * FRAME_PERIOD_NS


class Method(NamedTuple):
    """What a method says of n pairs."""

    covariances: np.ndarray  # (n, 6, 6)
    freedom: float = np.inf  # of the Student-t distribution whose covariances they are; infinite: a Gaussian

    def rows(self, which: np.ndarray) -> "Method":
        """Some of them."""
        return self._replace(covariances=self.covariances[which])

    def stretched(self, level: float) -> np.ndarray:
        """(n, 6) standard deviations, times what makes a Gaussian interval of that level one of this distribution."""
        upper, nu = 0.5 + 0.5 * level, self.freedom
        factor = 1.0 if np.isinf(nu) else student_t.ppf(upper, nu) / norm.ppf(upper) * np.sqrt((nu - 2.0) / nu)
        return factor * np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2))

    def nats(self, errors: np.ndarray) -> np.ndarray:
        """(n,) minus log densities."""
        if np.isinf(self.freedom):
            return negative_log_likelihood(errors, self.covariances)
        shapes = (self.freedom - 2.0) / self.freedom * self.covariances
        return -np.array([multivariate_t.logpdf(e, shape=shape, df=self.freedom) for e, shape in zip(errors, shapes, strict=True)])


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


def candidates(model: Model, seen: Pairs, unseen: Pairs) -> dict[str, Method]:
    """What is said of the unseen pairs, by method."""
    evidence = raw(unseen)
    rows = jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), unseen)
    found = {"evidence": Method(evidence)}
    for name, formula, start in (
        ("evidence, rescaled", rescaled, np.repeat([0.0, 1.0], 6)),
        ("information", of_information, np.zeros(8)),
    ):
        free = jnp.asarray(fitted(formula, start, seen))
        found[name] = Method(np.asarray(formula(free, rows, jnp.asarray(evidence, jnp.float32)), np.float64))
    found["Student"] = student(model, seen, unseen)
    found[f"ensemble of {NUM_HEADS} heads"] = Method(ensemble(model, seen, unseen))
    return found | {FULL: Method(squares(halves(model, model.variables["covariance"], unseen)))}


def squares(H: np.ndarray) -> np.ndarray:
    """H H^T."""
    return H @ H.transpose(0, 2, 1)


def student(model: Model, seen: Pairs, unseen: Pairs) -> Method:
    """The head under a heavy-tailed likelihood."""
    weights = fit(model, seen, likelihood=spread.student_negative_log_likelihood, more={"freedom": jnp.array(1.0)})
    nu = float(spread.freedom(weights))
    print(f"Student: {nu:.2f} degrees of freedom")
    return Method(nu / (nu - 2.0) * squares(halves(model, weights, unseen)), nu)


def ensemble(model: Model, seen: Pairs, unseen: Pairs) -> np.ndarray:
    """Mean covariances of heads that are fitted on as many worlds, drawn with repetition."""
    rows_of = [np.flatnonzero(seen.worlds == world) for world in np.unique(seen.worlds)]
    total = np.zeros((len(unseen.errors), 6, 6))
    for head in range(NUM_HEADS):
        drawn = np.random.default_rng(head).integers(len(rows_of), size=len(rows_of))
        weights = fit(model, seen.rows(np.concatenate([rows_of[world] for world in drawn])), seed=head)
        total += squares(halves(model, weights, unseen)) / NUM_HEADS
    return total


def show(title: str, pairs: Pairs, by_method: dict[str, Method]) -> None:
    """Likelihood, consistency, sharpness, sparsification; then coverage."""
    print(f"\n## {title}: {len(pairs.errors)} pairs\n")
    print("| covariance | nats | squared / expected | sigma: mrad | sigma: cm | AUSE rotation | AUSE translation |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for name, method in by_method.items():
        C = method.covariances
        sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
        sharpness = 1e3 * np.median(sigma[:, :3]), 100 * np.median(sigma[:, 3:])
        ause = " | ".join(f"{value:.3f}" for value in sparsifications(pairs.errors, C))
        likelihood, squared = method.nats(pairs.errors).mean(), nees(pairs.errors, C).mean() / 6
        print(f"| {name} | {likelihood:.2f} | {squared:.2f} | {sharpness[0]:.2f} | {sharpness[1]:.2f} | {ause} |")
    constant = sparsifications(pairs.errors, np.broadcast_to(np.eye(6), (len(pairs.errors), 6, 6)))
    print(f"| constant | | | | | {constant[0]:.3f} | {constant[1]:.3f} |")
    print(f"\n| covariance | level | {' | '.join(AXES)} |\n|---|---:|{'---:|' * 6}")
    for name, method in by_method.items():
        for level in LEVELS:
            cells = " | ".join(f"{100 * share:.1f}" for share in coverage(pairs.errors, method.stretched(level), level))
            print(f"| {name} | {100 * level:.0f} % | {cells} |")


def conditions(worlds: list[World], cfg) -> dict[str, np.ndarray]:
    """What the bins are about, of every pair of `FRAMES` of every world, from the truth."""
    rows = []
    for world in worlds:
        clouds = [scan.points[scan.mask] for scan in (scan_of(world, frame, cfg) for frame in range(NUM_FRAMES))]
        trees = [cKDTree(cloud) for cloud in clouds]
        for source, target in FRAMES:
            T = relative(world.Ts_world_lidar, source, target)
            elapsed_s = FRAME_S * abs(target - source)
            distances, _ = trees[target].query(clouds[source] @ T[:3, :3].T + T[:3, 3], distance_upper_bound=NEAR_M)
            turn_deg = np.degrees(se3.rotation_angle(T[:3, :3]))
            rows.append((np.linalg.norm(T[:3, 3]) / elapsed_s, turn_deg / elapsed_s, np.isfinite(distances).mean()))
    return dict(zip(BINS, np.array(rows).T, strict=True))


def show_bins(pairs: Pairs, values: dict[str, np.ndarray], C: np.ndarray) -> None:
    """Consistency and coverage at 68 % of the default by bin."""
    print(f"\n## {FULL} by speed, turn rate and overlap\n")
    print(f"| of | from | to | pairs | squared / expected | {' | '.join(f'{axis}: 68 %' for axis in AXES)} |")
    print(f"|---|---:|---:|---:|---:|{'---:|' * 6}")
    sigma, squared = np.sqrt(np.diagonal(C, axis1=1, axis2=2)), nees(pairs.errors, C) / 6
    for name, edges in BINS.items():
        for low, high in zip(edges[:-1], edges[1:], strict=True):
            inside = (values[name] >= low) & (values[name] < high)
            if inside.any():
                cells = " | ".join(f"{100 * share:.0f}" for share in coverage(pairs.errors[inside], sigma[inside], 0.68))
                print(
                    f"| {name} | {low:g} | {min(high, values[name].max()):.3g} | {inside.sum()} | {squared[inside].mean():.2f} | {cells} |"
                )


def draw(folder: Path, pairs: Pairs, method: Method) -> None:
    """Reliability diagram, and errors over sigma."""
    sigma = np.sqrt(np.diagonal(method.covariances, axis1=1, axis2=2))
    levels = np.linspace(0.05, 0.95, 19)
    title = f"Unseen worlds, {len(pairs.errors)} pairs"
    observed = {float(level): coverage(pairs.errors, sigma, float(level)) for level in (*levels, 0.99)}
    reliability_figure(folder / "reliability.png", observed, AXES, title=title)
    printed = 1.0 / UNITS
    error_figure(folder / "errors.png", printed * pairs.errors, printed * sigma, AXES, ("mrad",) * 3 + ("cm",) * 3, title=title)


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


def stored(model: Model, folder: Path, name: str, seed: int, count: int, bar) -> Iterator[World]:
    """Worlds, read or made."""
    task = bar.add_task(f"{name} worlds", total=count)
    cfg = model.cfg.preprocess
    return stored_worlds(folder, name, count, seed, num_frames=NUM_FRAMES, cfg=cfg, on_world=lambda: bar.advance(task))


def main(argv: list[str] | None = None) -> int:
    """Solve, fit, print, draw, judge."""
    parser = _harness.parser(__doc__, needs_data=False)
    parser.add_argument("--weights", default="delo-base", help="name or file, calibrated")
    parser.add_argument("--out", type=Path, default=Path("runs/calibrated"), help="folder of `delo calibrate`, for worlds and figures")
    args = parser.parse_args(argv)
    model, folder = delo_jax.load(args.weights), args.out / "worlds"
    num_unseen, num_fitted = (NUM_QUICK, NUM_QUICK) if args.quick else (NUM_UNSEEN, NUM_FITTED)
    with _harness.progress() as bar:
        seen = solved_pairs(model, stored(model, folder, "calibration", CALIBRATION_SEED, num_fitted, bar))
        worlds = list(stored(model, folder, "unseen", UNSEEN_SEED, num_unseen, bar))
        unseen = solved_pairs(model, worlds, FRAMES)
    for name, pairs in (("calibration", seen), ("unseen", unseen)):
        print(f"{name} worlds: {len(pairs.errors)} pairs, {pairs.lost(model).sum()} lost, which are left out")
    kept = np.flatnonzero(~unseen.lost(model))
    seen, unseen = seen.rows(np.flatnonzero(~seen.lost(model))), unseen.rows(kept)
    by_method = candidates(model, seen, unseen)
    show("Unseen worlds", unseen, by_method)
    for gap in GAPS:
        which = np.flatnonzero(np.abs(unseen.gaps) == gap)
        show(
            f"Gap {gap}", unseen.rows(which), {name: method.rows(which) for name, method in by_method.items() if name in ("evidence", FULL)}
        )
    values = {name: array[kept] for name, array in conditions(worlds, model.cfg.preprocess).items()}
    show_bins(unseen, values, by_method[FULL].covariances)
    draw(args.out, unseen, by_method[FULL])
    rows = judge(unseen, by_method[FULL].covariances)
    return _harness.finish(rows, {"weights": args.weights, "unseen": num_unseen, "fitted": num_fitted}, args)


if __name__ == "__main__":
    _harness.run(main)
