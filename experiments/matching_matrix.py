"""The matching matrix of one pair of scans: the soft pointer of DCP beside the paper's partial transport, from the same scores.

Descriptors are those of `delo-base`, frozen, of 408 key points a scan; a pair of a simulated world that no training has seen, or with
`--recorded` one of odo_00_056. Rows are source points, columns target points; both are sorted by the true pose, so that true matches lie on
the diagonal, bearing by bearing, and what has none within 1 m comes last. Drawn at 102 x 102, sums over 4 x 4 (the paper: 1,024 points,
10 x 10), with row and column sums as histograms, the transport in two colour maps.

The paper's m = 0.1 and xi = 5 move so little that at epsilon = 1 no cap is reached: the plan is the soft pointer times m. What it learns,
lambda, decides: below 1 it points more sharply, as a soft pointer of that temperature does, and sure rows weigh more, as that one's do not.
So m = 0.1, xi = 5 is measured at both and drawn at epsilon = 0.25, beside what the weights were trained with, m = 0.6, xi = 10, and its
limit. At m = 0.6 the caps bind on crowded columns; what has no true match keeps nearly its share in any of them.

- Theory: rows of the soft pointer give all they have; every transport moves m; in the limit no row and no column is above its cap.

Run:     python experiments/matching_matrix.py [--recorded --data TREE]     (about 20 s on 2 cores)
Expect:  all bounds kept; the picture is written to --out.
"""

import dataclasses
import os
from pathlib import Path
from typing import NamedTuple

import _harness
import jax.numpy as jnp
import numpy as np
from _harness import Row
from _plans import INLIER_M
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.spatial import cKDTree

import delo_jax
from delo_jax import inference
from delo_jax.data import camera_to_lidar, read_kitti_poses
from delo_jax.errors import ConfigError
from delo_jax.geometry import se3
from delo_jax.model import delo
from delo_jax.ops.matching import matching_cost, softmax_plan, uniform_marginal
from delo_jax.ops.transport import marginal_excess, partial_transport
from delo_jax.preprocess import preprocess
from delo_jax.sim import simulate_clip

SIDE, POOLED = 102, 4
WORLD = ("urban", 750_000)
RECORDED, RECORDED_START = "odo_00_056", 40
LIMIT_ROUNDS = 2000
SOFTMAX, SHARP = "soft pointer", "soft pointer, ε = 0.25"
DRAWN, OWN, LIMIT = "transport, m = 0.1, ξ = 5, ε = 0.25", "transport, m = 0.6, ξ = 10, ε = 1", "its limit"
COLOR = "#1f5fa8"


class Transport(NamedTuple):
    """Settings of a plan."""

    mass: float
    num_iters: int
    epsilon: float


TRANSPORTS = {
    "transport, m = 0.1, ξ = 5, ε = 1": Transport(0.1, 5, 1.0),
    DRAWN: Transport(0.1, 5, 0.25),
    OWN: Transport(0.6, 10, 1.0),
    LIMIT: Transport(0.6, LIMIT_ROUNDS, 1.0),
}


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is matched."""

    gap: int = 1
    num_keypoints: int = SIDE * POOLED


class Pair(NamedTuple):
    """Descriptors' scores between key points, sorted."""

    scores: np.ndarray  # (n, m)
    near: np.ndarray  # (n, m) whether two points are truly within INLIER_M
    num_matched: int  # so many rows and columns at the front are each other's nearest


class Numbers(NamedTuple):
    """What a plan looks like; shares are of its mass."""

    total: float
    near: float  # between points that are truly within INLIER_M
    unmatched_rows: float  # of rows that have no true match
    row_variation: float  # standard deviation over mean of the row sums
    column_variation: float
    entropy: float  # of the plan as a distribution over all entries [nat]
    row_entropy: float  # of where a row points, mean by mass [nat]
    excess: float  # relative excess of the worst row or column sum over its cap


def scans_of(args, gap: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of source and target [m], and T_target_source."""
    if not args.recorded:
        first, *_, last = simulate_clip(*WORLD, num_frames=gap + 1)
        return first.points, last.points, se3.inverse(last.T_world_lidar) @ first.T_world_lidar
    if args.data is None:
        raise ConfigError("--data: expected the tree of the recorded sequences, got none; name it, or leave --recorded out")
    dataset = delo_jax.open_dataset(args.data / "sequences" / RECORDED)
    T_cam_lidar = _harness.needed(dataset.T_cam_lidar, "Tr in calib.txt")
    Ts = camera_to_lidar(read_kitti_poses(args.data / "poses_boresight" / f"{RECORDED}.txt"), T_cam_lidar)
    ends = RECORDED_START, RECORDED_START + gap
    return dataset[ends[0]].points, dataset[ends[1]].points, se3.inverse(Ts[ends[1]]) @ Ts[ends[0]]


def pair_of(model: delo.Model, points: tuple[np.ndarray, np.ndarray], T_true: np.ndarray) -> Pair:
    """Scores of the network, rows and columns in the order of the true matches."""
    cfg = model.cfg.preprocess
    source, target = (inference.encode(model, preprocess(one, cfg)) for one in points)
    masks = [np.asarray(scan.keypoint_mask) for scan in (source, target)]
    ours, theirs = (np.asarray(scan.keypoints, np.float64)[mask] for scan, mask in zip((source, target), masks, strict=True))
    found = delo.match(model, source, target)
    scores = np.exp(float(model.variables["params"]["matcher"]["log_temperature"])) * np.asarray(found.source @ found.target.T)
    moved = se3.transform(T_true, ours)
    apart, best = cKDTree(theirs).query(moved)
    mutual = (cKDTree(moved).query(theirs)[1][best] == np.arange(len(moved))) & (apart < INLIER_M)
    rows = np.flatnonzero(mutual)
    rows = rows[np.argsort(np.arctan2(moved[rows, 1], moved[rows, 0]))]
    rest, alone = np.setdiff1d(np.arange(len(moved)), rows), np.setdiff1d(np.arange(len(theirs)), best[rows])
    rest = rest[np.argsort(apart[rest])]
    order = np.concatenate([rows, rest]), np.concatenate([best[rows], alone])
    near = np.linalg.norm(moved[order[0], None] - theirs[None, order[1]], axis=2) < INLIER_M
    return Pair(scores[np.ix_(*masks)][np.ix_(*order)], near, len(rows))


def plans_of(pair: Pair) -> dict[str, np.ndarray]:
    """All of them; marginals sum up to 1."""
    scores = jnp.asarray(pair.scores, jnp.float32)
    a, b = (uniform_marginal(jnp.ones(count, bool)) for count in scores.shape)
    cost = matching_cost(scores, b > 0)
    found = {SOFTMAX: softmax_plan(scores, a, b), SHARP: softmax_plan(scores / TRANSPORTS[DRAWN].epsilon, a, b)}
    for name, (mass, num_iters, epsilon) in TRANSPORTS.items():
        found[name] = partial_transport(cost, jnp.float32(epsilon), a, b, mass=jnp.float32(mass), num_iters=num_iters)
    return {name: np.asarray(plan, np.float64) for name, plan in found.items()}


def numbers(plan: np.ndarray, pair: Pair) -> Numbers:
    """Of a plan."""
    total, rows, columns = plan.sum(), plan.sum(axis=1), plan.sum(axis=0)
    alone = ~pair.near.any(axis=1)
    share = plan / total
    logs = np.log(np.where(share > 0, share, 1.0))
    entropy = -np.sum(share * logs)
    of_rows = rows / total
    row_entropy = entropy + np.sum(of_rows * np.log(np.where(of_rows > 0, of_rows, 1.0)))
    caps = (np.full(count, 1.0 / count) for count in plan.shape)
    return Numbers(
        float(total),
        float(share[pair.near].sum()),
        float(share[alone].sum()),
        float(rows.std() / rows.mean()),
        float(columns.std() / columns.mean()),
        float(entropy),
        float(row_entropy),
        float(marginal_excess(*(jnp.asarray(array) for array in (plan, *caps)))),
    )


def pooled(plan: np.ndarray) -> np.ndarray:
    """Sums over squares of POOLED x POOLED."""
    n, m = (count // POOLED * POOLED for count in plan.shape)
    return plan[:n, :m].reshape(n // POOLED, POOLED, m // POOLED, POOLED).sum(axis=(1, 3))


def draw(plans: dict[str, np.ndarray], pair: Pair, path: Path, title: str) -> None:
    """Soft pointer, and the drawn transport twice, each with its row and column sums."""
    figure = Figure(figsize=(13.0, 5.3))
    panels = (
        ("(a) soft pointer", "every row gives all it has", plans[SOFTMAX], "viridis", False),
        ("(b) partial transport", DRAWN.removeprefix("transport, "), plans[DRAWN], "viridis", False),
        ("(c) the same, logarithmic", DRAWN.removeprefix("transport, "), plans[DRAWN], "inferno", True),
    )
    for number, (name, how, plan, cmap, logarithmic) in enumerate(panels):
        left, bottom, width, height = 0.052 + 0.329 * number, 0.215, 0.215, 0.215 * 13.0 / 5.3
        ax = figure.add_axes((left, bottom, width, height))
        above = figure.add_axes((left, bottom + height + 0.02, width, 0.10), sharex=ax)
        right = figure.add_axes((left + width + 0.008, bottom, 0.045, height), sharey=ax)
        bar = figure.add_axes((left, 0.085, width, 0.02))
        _draw_matrix(ax, bar, plan, pair, cmap, logarithmic=logarithmic)
        squares = pooled(plan)
        _draw_sums(above, squares.sum(axis=0), upright=True)
        _draw_sums(right, squares.sum(axis=1), upright=False)
        above.set_title(f"{name}\n{how}", fontsize=10)
    figure.suptitle(f"{title}; dotted: true matches first", fontsize=11, y=0.985)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    print(f"figure: {path}")


def _draw_matrix(ax: Axes, bar: Axes, plan: np.ndarray, pair: Pair, cmap: str, *, logarithmic: bool) -> None:
    """Mass in percent of the mean row."""
    shares = 100.0 * pooled(plan) * plan.shape[0] / (POOLED * plan.sum())
    norm = LogNorm(1e-3 * shares.max(), shares.max(), clip=True) if logarithmic else Normalize(0.0, shares.max())
    image = ax.imshow(shares, cmap=cmap, norm=norm, aspect="auto", interpolation="nearest")
    for line in (ax.axhline, ax.axvline):
        line(pair.num_matched / POOLED - 0.5, color="white", lw=0.8, ls=":")
    ax.set(xlabel=f"target point / {POOLED}", ylabel=f"source point / {POOLED}")
    ax.figure.colorbar(image, cax=bar, orientation="horizontal", label="mass of a cell [% of the mean row]")


def _draw_sums(ax: Axes, sums: np.ndarray, *, upright: bool) -> None:
    """Histogram along one side, over the mean."""
    relative, places = sums / sums.mean(), np.arange(len(sums))
    (ax.bar if upright else ax.barh)(places, relative, 1.0, color=COLOR)
    (ax.axhline if upright else ax.axvline)(1.0, color="#d62728", lw=0.9, ls="--")
    (ax.set_ylim if upright else ax.set_xlim)(0.0, 1.05 * relative.max())
    (ax.set_ylabel if upright else ax.set_xlabel)("column sum\n/ mean" if upright else "row sum\n/ mean", fontsize=9)
    (ax.yaxis if upright else ax.xaxis).set_major_locator(MaxNLocator(3, integer=True, prune="lower"))
    ax.tick_params(labelbottom=not upright, labelleft=upright)


def show(found: dict[str, Numbers], pair: Pair) -> None:
    """A row for each plan."""
    n, m = pair.scores.shape
    alone = ~pair.near.any(axis=1)
    print(f"{n} x {m} key points, {pair.num_matched} of them each other's nearest within {INLIER_M:g} m by the true pose")
    print(f"{alone.sum()} rows ({100 * alone.mean():.1f} %) have no target within {INLIER_M:g} m\n")
    print("| plan | mass | true matches % | rows without % | row sums: variation | column sums | entropy nat | of a row | worst cap +% |")
    print(f"|---|{'---:|' * 8}")
    for name, one in found.items():
        sums = f"{one.row_variation:.2f} | {one.column_variation:.2f} | {one.entropy:.2f} | {one.row_entropy:.2f} | {100 * one.excess:.1f}"
        print(f"| {name} | {one.total:.3f} | {100 * one.near:.1f} | {100 * one.unmatched_rows:.1f} | {sums} |")


def judge(plans: dict[str, np.ndarray], found: dict[str, Numbers]) -> list[Row]:
    """What theory says, and how the drawn ones differ."""
    rows_off = np.abs(plans[SOFTMAX].sum(axis=1) * len(plans[SOFTMAX]) - 1.0).max()
    mass_off = max(abs(found[name].total / transport.mass - 1.0) for name, transport in TRANSPORTS.items())
    return [
        Row("soft pointer: largest row sum off its cap", 1e6 * float(rows_off), "1e-6", 10.0),
        Row("transport: mass off m, worst", 1e6 * float(mass_off), "1e-6", 10.0),
        Row("transport in the limit: worst row or column above its cap", 100.0 * found[LIMIT].excess, "%", 1.0),
        Row("entropy of a row: drawn transport / soft pointer", found[DRAWN].row_entropy / found[SOFTMAX].row_entropy, ""),
        Row("mass on true matches: drawn transport - soft pointer", 100.0 * (found[DRAWN].near - found[SOFTMAX].near), "%"),
        Row("mass on true matches: drawn transport - soft pointer as sharp", 100.0 * (found[DRAWN].near - found[SHARP].near), "%"),
    ]


def main(argv: list[str] | None = None) -> int:
    """Match, print, draw, judge."""
    parser = _harness.parser(__doc__, needs_data=False)
    parser.add_argument("--out", type=Path, default=Path("runs/figures"), help="folder of the picture")
    parser.add_argument("--gap", type=int, default=Settings.gap, help="frames from source to target")
    parser.add_argument("--recorded", action="store_true", help=f"a pair of {RECORDED} instead of a simulated one")
    parser.add_argument("--data", type=Path, default=os.environ.get("DELO_DATA"), help="tree of real sequences, for --recorded")
    args = parser.parse_args(argv)
    settings = Settings(gap=args.gap)
    model = delo_jax.load("delo-base")
    cfg = dataclasses.replace(model.cfg.preprocess, num_keypoints=settings.num_keypoints)
    model = delo.Model(model.variables, dataclasses.replace(model.cfg, preprocess=cfg))
    *points, T_true = scans_of(args, settings.gap)
    pair = pair_of(model, (points[0], points[1]), T_true)
    plans = plans_of(pair)
    found = {name: numbers(plan, pair) for name, plan in plans.items()}
    show(found, pair)
    where = f"{RECORDED}, frames {RECORDED_START} and {RECORDED_START + args.gap}" if args.recorded else f"simulated, {WORLD[0]}"
    path = args.out / ("matching_matrix_recorded.png" if args.recorded else "matching_matrix.png")
    draw(plans, pair, path, f"{where}: matching matrix of {pair.scores.shape[0]} x {pair.scores.shape[1]} key points")
    return _harness.finish(judge(plans, found), dataclasses.asdict(settings), args)


if __name__ == "__main__":
    _harness.run(main)
