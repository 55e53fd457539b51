"""Pictures of a followed drive: the sub-map with all outputs, and errors and uncertainty along the way."""

from pathlib import Path

import numpy as np
from _sequence import Followed
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, FancyArrowPatch, Rectangle
from scipy.ndimage import gaussian_filter1d

from delo_jax.errors import DeloError
from delo_jax.geometry import se3
from delo_jax.metrics.ate import relative_errors
from delo_jax.metrics.drift import Drift, kitti_drift
from delo_jax.metrics.registration import pose_errors
from delo_jax.refine.plan import LOOP, MULTI_FRAME
from delo_jax.report.figures import STATUS_COLORS
from delo_jax.uncertainty.observability import AXES

BEFORE, AFTER, TRUTH = "#d1495b", "#1f5fa8", "#222222"
AXIS_COLORS = ("#1f5fa8", "#2a9d5c", "#d62728")
PASS_COLOR, LOOP_COLOR, SKIP_COLOR, REFINE_COLOR = "#f28e2b", "#8e44ad", "#5b6770", "#d62728"
ALONG, ACROSS = "along the drive [m]", "across [m]"
SMOOTH_FRAMES = 5.0  # standard deviation of the Gaussian filter
NUM_ELLIPSES, MAX_POINTS, DETAIL_FRAMES = 12, 250_000, 17
LENGTHS_M = (10, 20, 30, 40, 50, 75, *range(100, 801, 100))
HEIGHT_M = (-2.0, 4.0)  # against the first sensor position; what is higher is drawn as the highest


def turned(followed: Followed) -> Followed:
    """The same drive in a world that is turned about the vertical, so that the track's longer extent runs along x, and its end is ahead."""
    track = followed.Ts_true[:, :2, 3]
    _, _, (along, _) = np.linalg.svd(track - track.mean(axis=0, keepdims=True), full_matrices=False)
    along = along * (1.0 if along @ (track[-1] - track[0]) >= 0.0 else -1.0)
    T = np.eye(4)
    T[:2, :2] = [[along[0], along[1]], [-along[1], along[0]]]
    refined = followed.refined._replace(Ts_world_lidar=T @ followed.refined.Ts_world_lidar)
    return followed._replace(Ts_true=T @ followed.Ts_true, refined=refined)


def cloud_of(followed: Followed, frames: slice = slice(None)) -> np.ndarray:
    """(m, 3) registered points of some frames at the refined poses, the highest last."""
    poses = zip(followed.clouds[frames], followed.refined.Ts_world_lidar[frames], strict=True)
    cloud = np.concatenate([points @ T[:3, :3].T + T[:3, 3] for points, T in poses])
    cloud = cloud[:: max(1, -(-len(cloud) // MAX_POINTS))]
    return cloud[np.argsort(cloud[:, 2], kind="stable")]


def submap_figure(path: Path, followed: Followed, title: str) -> None:
    """The whole drive from above, and the middle of its sharpest turn enlarged."""
    followed = turned(followed)
    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    ax, detail = figure.subplots(1, 2, width_ratios=[2.0, 1.0])
    cloud, Ts = cloud_of(followed), followed.refined.Ts_world_lidar
    dots = _draw_cloud(ax, cloud, 0.25)
    figure.colorbar(dots, ax=ax, location="left", label="height above the first sensor position [m]", shrink=0.9, pad=0.02)
    _draw_tracks(ax, followed)
    times = _draw_ellipses(ax, followed)
    _draw_statuses(ax, followed)
    _draw_verdicts(ax, followed)
    _frame(ax, Ts[:, :2, 3], margin_m=25.0)
    ax.set_title("(a) sub-map", fontsize=10)
    frames = _sharpest(Ts)
    _draw_cloud(detail, cloud, 2.0)
    _draw_tracks(detail, followed)
    _draw_factors(detail, followed, frames)
    xy = Ts[frames.start : frames.stop, :2, 3]
    _frame(detail, xy, margin_m=1.5)
    detail.set_title(f"(b) graph of frames {frames.start + 1} to {frames.stop}", fontsize=10)
    low, high = np.min(xy, axis=0) - 1.5, np.max(xy, axis=0) + 1.5
    ax.add_patch(Rectangle(tuple(low), *(high - low), fill=False, ec="black", lw=1.2, zorder=7))
    box = {"boxstyle": "square,pad=0.15", "fc": "white", "ec": "none"}
    ax.annotate("(b)", (low[0], high[1]), xytext=(-6, 4), textcoords="offset points", ha="right", fontsize=9, bbox=box, zorder=8)
    figure.suptitle(title, fontsize=11)
    figure.legend(handles=_keys(followed, times), loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    _save(figure, path)


def _keys(followed: Followed, times: float) -> list[Line2D]:
    """Of what there is in either panel."""

    def line(label: str, color: str, **how) -> Line2D:
        return Line2D([], [], label=label, color=color, **{"lw": 1.8, **how})

    statuses, actions = set(followed.trajectory.statuses), {judged.verdict.action for judged in followed.judged}
    keys = [
        line("refined trajectory", AFTER),
        line("truth", TRUTH, ls="--"),
        line(f"2σ of the position, {times:g} times as large", BEFORE, lw=1.2),
        line("odometry factor (square: key frame)", STATUS_COLORS["ok"], marker="s", mec="black", ms=6),
        line("multi-frame factor", PASS_COLOR),
        *([line("loop", LOOP_COLOR)] if _pairs_of(followed, LOOP) else []),
        *(
            [line("key frames: confident, skipped", SKIP_COLOR, marker="D", ls="--", lw=1.2, mec="white", ms=6)]
            if "skip" in actions
            else []
        ),
        *([line("key frames: refined", REFINE_COLOR, marker="D", mec="white", ms=7)] if "refine" in actions else []),
    ]
    bad = [(status, color) for status, color in STATUS_COLORS.items() if status != "ok" and status in statuses]
    return keys + [line(status.replace("_", " "), color, marker="X", lw=0, mec="white", ms=7) for status, color in bad]


def _draw_cloud(ax: Axes, cloud: np.ndarray, size: float):
    ax.set_facecolor("white")
    ax.set(xlabel=ALONG, ylabel=ACROSS)
    colors = np.clip(cloud[:, 2], *HEIGHT_M)
    return ax.scatter(cloud[:, 0], cloud[:, 1], c=colors, s=size, lw=0, cmap="viridis", vmin=HEIGHT_M[0], vmax=HEIGHT_M[1], rasterized=True)


def _draw_tracks(ax: Axes, followed: Followed) -> None:
    Ts, Ts_true = followed.refined.Ts_world_lidar, followed.Ts_true
    ax.plot(Ts[:, 0, 3], Ts[:, 1, 3], color="white", lw=4.0)
    ax.plot(Ts[:, 0, 3], Ts[:, 1, 3], color=AFTER, lw=2.0)
    ax.plot(Ts_true[:, 0, 3], Ts_true[:, 1, 3], color=TRUTH, lw=0.9, ls="--")


def _draw_ellipses(ax: Axes, followed: Followed) -> float:
    """2 sigma of the position in the plane at intervals, enlarged so that they are seen; by how much."""
    Ts, covariances = followed.refined.Ts_world_lidar, followed.refined.covariances
    rows = np.linspace(0, len(Ts) - 1, NUM_ELLIPSES + 1).round().astype(int)[1:]
    planar = [(Ts[k, :3, :3] @ covariances[k, 3:, 3:] @ Ts[k, :3, :3].T)[:2, :2] for k in rows]
    largest = 2.0 * max(np.sqrt(np.linalg.eigvalsh(C)[-1]) for C in planar)
    wanted = 0.07 * np.ptp(Ts[:, :2, 3], axis=0).max() / largest
    decade = 10.0 ** np.floor(np.log10(wanted))
    times = float(decade * max(step for step in (1, 2, 5) if step * decade <= wanted))
    for k, C in zip(rows, planar, strict=True):
        values, vectors = np.linalg.eigh(C)
        size = 4.0 * times * np.sqrt(values.clip(min=0.0))
        angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
        ax.add_patch(Ellipse(tuple(Ts[k, :2, 3]), size[1], size[0], angle=angle, fill=False, ec=BEFORE, lw=1.4, zorder=4))
    return times


def _draw_statuses(ax: Axes, followed: Followed) -> None:
    track = followed.refined.Ts_world_lidar[:, :2, 3]
    for status, color in STATUS_COLORS.items():
        marked = np.array(followed.trajectory.statuses) == status
        if status != "ok" and marked.any():
            ax.plot(*track[marked].T, color=color, marker="X", ms=8, mec="white", ls="none", zorder=6)


def _draw_verdicts(ax: Axes, followed: Followed) -> None:
    """A diamond at the later of two key frames."""
    track = followed.refined.Ts_world_lidar[:, :2, 3]
    for action, color, size in (("skip", SKIP_COLOR, 3.0), ("refine", REFINE_COLOR, 7.0)):
        rows = [judged.target for judged in followed.judged if judged.verdict.action == action]
        ax.plot(*track[rows].T, color=color, marker="D", ms=size, mec="white", mew=0.3, ls="none", zorder=5)
    for source, target in _pairs_of(followed, LOOP):
        ax.plot(*track[[source, target]].T, color=LOOP_COLOR, lw=1.4, zorder=5)


def _pairs_of(followed: Followed, kind: int) -> list[tuple[int, int]]:
    rows = followed.plan.factors.rows(followed.plan.factors.kinds == kind)
    return list(zip(rows.sources.tolist(), rows.targets.tolist(), strict=True))


def _sharpest(Ts: np.ndarray) -> range:
    """Frames around the sharpest turn per metre of way, of those that move."""
    half = min(DETAIL_FRAMES, len(Ts)) // 2
    steps = se3.inverse(Ts[: -2 * half]) @ Ts[2 * half :]
    turn, way = np.abs(se3.log(steps)[:, 2]), np.linalg.norm(steps[:, :3, 3], axis=1)
    start = int(np.argmax(np.where(way >= 0.5 * np.median(way), turn, -1.0)))
    return range(start, start + 2 * half + 1)


def _draw_factors(ax: Axes, followed: Followed, frames: range) -> None:
    """Nodes, odometry's edges, and beside them arcs of the pairs; those of key frames on the other side."""
    track = followed.refined.Ts_world_lidar[:, :2, 3]

    def arc(source: int, target: int, bend: float, **how) -> None:
        ends, style = (tuple(track[source]), tuple(track[target])), f"arc3,rad={bend}"
        ax.add_patch(FancyArrowPatch(*ends, arrowstyle="-", connectionstyle=style, shrinkA=2, shrinkB=2, zorder=4, **how))

    def inside(source: int, target: int) -> bool:
        return source in frames and target in frames

    ax.plot(*track[frames.start : frames.stop].T, color=STATUS_COLORS["ok"], lw=2.2, marker="o", ms=4.5, mec="white", zorder=5)
    key = {end for judged in followed.judged for end in judged[:2]}
    shown = [frame for frame in frames if frame in key]
    ax.plot(*track[shown].T, color=STATUS_COLORS["ok"], marker="s", ms=8, mec="black", ls="none", zorder=6)
    verdicts = {judged[:2]: judged.verdict.action for judged in followed.judged}
    for pair in filter(lambda ends: inside(*ends) and ends not in verdicts, _pairs_of(followed, MULTI_FRAME)):
        arc(*pair, -0.45, color=PASS_COLOR, lw=1.6)
    for pair, action in verdicts.items():
        if inside(*pair):
            skipped = action == "skip"
            arc(*pair, 0.35, color=SKIP_COLOR if skipped else REFINE_COLOR, lw=1.2 if skipped else 2.0, ls="--" if skipped else "-")


def report_figure(path: Path, followed: Followed, title: str) -> None:
    """Nine panels: tracks by error and the map; uncertainty along the way; errors before and after."""
    figure = Figure(figsize=(11.0, 9.0), layout="constrained")
    axes = figure.subplots(3, 3, height_ratios=[1.35, 1.0, 1.0])
    seen, Ts = turned(followed), followed.trajectory.Ts_world_lidar
    steps = relative_errors(Ts, followed.Ts_true)
    _draw_by_error(axes[0, 0], seen.Ts_true, 100.0 * steps.translation_m, "(a) error of the motions, translation", "Δt [cm]")
    _draw_by_error(axes[0, 1], seen.Ts_true, 1e3 * np.degrees(steps.rotation_rad), "(b) error of the motions, rotation", "φ [mdeg]")
    part = slice(len(Ts) // 3, 2 * len(Ts) // 3)
    dots = _draw_cloud(axes[0, 2], cloud_of(seen, part), 0.3)
    figure.colorbar(dots, ax=axes[0, 2], location="bottom", label="height [m]", shrink=0.8, aspect=30, pad=0.02)
    axes[0, 2].plot(*seen.refined.Ts_world_lidar[part, :2, 3].T, color=BEFORE, lw=2.0)
    _frame(axes[0, 2], seen.Ts_true[part, :2, 3], margin_m=20.0)
    axes[0, 2].set_title(f"(c) map of frames {part.start + 1} to {part.stop}", fontsize=10)
    _draw_sigmas(axes[1, 0], followed, slice(0, 3), 1e3, "(d) rotation: σ [mrad]")
    _draw_sigmas(axes[1, 1], followed, slice(3, 6), 1e2, "(e) translation: σ [cm]")
    _draw_before_after(axes[1, 2], axes[2, 2], followed)
    _draw_drift(axes[2, 0], axes[2, 1], followed)
    figure.suptitle(title, fontsize=12)
    _save(figure, path)


def _draw_by_error(ax: Axes, Ts: np.ndarray, errors: np.ndarray, title: str, label: str) -> None:
    """The track, each step in the colour of its smoothed error."""
    segments = np.stack([Ts[:-1, :2, 3], Ts[1:, :2, 3]], axis=1)
    smooth = gaussian_filter1d(errors, SMOOTH_FRAMES)
    lines = LineCollection(list(segments), cmap="plasma", array=smooth, lw=4.0, capstyle="round")
    ax.add_collection(lines)
    ax.plot(*Ts[0, :2, 3], marker="s", color="black", ms=6)
    ax.annotate("start", (Ts[0, 0, 3], Ts[0, 1, 3]), xytext=(0, -14), textcoords="offset points", fontsize=8)
    ax.figure.colorbar(lines, ax=ax, location="bottom", label=label, shrink=0.8, aspect=30, pad=0.02)
    _frame(ax, Ts[:, :2, 3], margin_m=10.0)
    ax.set_title(title, fontsize=10)
    ax.set(xlabel=ALONG, ylabel=ACROSS)
    ax.grid(alpha=0.3)


def _draw_sigmas(ax: Axes, followed: Followed, part: slice, unit: float, title: str) -> None:
    """Predicted standard deviations of the motions, and below them the root mean square errors, smoothed alike."""
    Ts, Ts_true = followed.trajectory.Ts_world_lidar, followed.Ts_true
    errors = se3.log(se3.inverse(se3.inverse(Ts[:-1]) @ Ts[1:]) @ se3.inverse(Ts_true[:-1]) @ Ts_true[1:])[:, part]
    sigmas, frames = followed.trajectory.sigmas[1:, part], np.arange(2, len(Ts) + 1)
    for name, color, sigma, error in zip(AXES[part], AXIS_COLORS, sigmas.T, errors.T, strict=True):
        ax.plot(frames, unit * gaussian_filter1d(sigma, SMOOTH_FRAMES), color=color, lw=1.6, label=name)
        ax.plot(frames, unit * np.sqrt(gaussian_filter1d(error**2, SMOOTH_FRAMES)), color=color, lw=0.9, ls=":")
    ax.plot([], [], color="black", lw=0.9, ls=":", label="error, r.m.s.")
    ax.set(xlabel="frame", ylim=(0.0, 1.35 * ax.get_ylim()[1]))
    ax.set_title(title, fontsize=10)
    ax.legend(loc="upper center", ncols=2, fontsize=8, frameon=False)
    ax.grid(alpha=0.3)


def _draw_before_after(top: Axes, bottom: Axes, followed: Followed) -> None:
    """Errors of the poses along the way."""
    for name, Ts, color in (
        ("odometry", followed.trajectory.Ts_world_lidar, BEFORE),
        ("refined", followed.refined.Ts_world_lidar, AFTER),
    ):
        errors = pose_errors(Ts, followed.Ts_true)
        frames = np.arange(1, len(Ts) + 1)
        top.plot(frames, 100.0 * errors.translation_m, color=color, lw=1.3, label=name)
        bottom.plot(frames, 1e3 * np.degrees(errors.rotation_rad), color=color, lw=1.3, label=name)
    for ax, title in ((top, "(f) position error [cm]"), (bottom, "(i) rotation error [mdeg]")):
        ax.set(xlabel="frame", ylim=(0.0, None))
        ax.set_title(title, fontsize=10)
        ax.legend(fontsize=8, frameon=False)
        ax.grid(alpha=0.3)


def _draw_drift(left: Axes, right: Axes, followed: Followed) -> None:
    """Drift by the lengths that fit."""
    tracks = ("odometry", followed.trajectory.Ts_world_lidar, BEFORE, "o"), ("refined", followed.refined.Ts_world_lidar, AFTER, "s")
    for name, Ts, color, marker in tracks:
        if (found := _drift(Ts, followed.Ts_true)) is not None:
            left.plot(found.lengths_m, found.t_rel_percent_by_length, color=color, marker=marker, ms=4, label=name)
            right.plot(found.lengths_m, found.r_rel_deg_per_100m_by_length, color=color, marker=marker, ms=4, label=name)
    for ax, title in ((left, "(g) translation drift [%]"), (right, "(h) rotation drift [deg/100 m]")):
        ax.set_xscale("log")
        ends = [np.max(np.asarray(line.get_xdata())[np.isfinite(np.asarray(line.get_ydata()))]) for line in ax.lines]
        longest = float(max(ends, default=100.0))
        ticks = [length for length in (10, 20, 50, 100, 200, 400, 800) if length <= longest]
        ax.set_xticks(ticks, [str(length) for length in ticks], minor=False)
        ax.minorticks_off()
        ax.set(xlabel="segment length [m]", xlim=(9.0, 1.15 * longest), ylim=(0.0, 1.1 * ax.dataLim.y1))
        ax.set_title(title, fontsize=10)
        ax.legend(fontsize=8, frameon=False)
        ax.grid(alpha=0.3)


def _drift(Ts: np.ndarray, Ts_true: np.ndarray) -> Drift | None:
    try:
        return kitti_drift(Ts, Ts_true, lengths_m=LENGTHS_M, step=1)
    except DeloError:  # shorter than all segments
        return None


def _frame(ax: Axes, xy: np.ndarray, *, margin_m: float) -> None:
    """Equal axes around positions."""
    low, high = xy.min(axis=0) - margin_m, xy.max(axis=0) + margin_m
    ax.dataLim.set_points(np.stack([low, high]))
    ax.margins(0.0)
    ax.autoscale_view()
    ax.set_aspect("equal", adjustable="datalim")


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=150, metadata={"Software": None})
