"""Pictures of a trajectory and of the scene it passed through, as PNG files; no display and no global plotting state."""

import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

STATUS_COLORS = {"ok": "#2a9d5c", "low_confidence": "#f2a900", "degenerate": "#8e44ad", "rejected": "#d62728"}
TRACK_COLOR, TRUTH_COLOR = "#1f5fa8", "#8a8a8a"
MIN_HALF_EXTENT_M = 5.0
"""A standing vehicle is drawn in a window of this half width."""


def trajectory_figure(
    path: str | os.PathLike[str],
    Ts_world_lidar: Float[np.ndarray, "n 4 4"],
    statuses: Sequence[str],
    *,
    sigmas: Float[np.ndarray, "n 6"] | None = None,
    confidences: Float[np.ndarray, " n"] | None = None,
    truth: Float[np.ndarray, "m 4 4"] | None = None,
    title: str = "",
) -> None:
    """Draws a trajectory from above, its uncertainty and its status over the frames.

    Args:
        path: the PNG file to write.
        Ts_world_lidar: sensor poses, one or more.
        statuses: status of every frame; those that are not "ok" are marked on the track.
        sigmas: standard deviations of the motions, order [omega (rad), v (m)]; the panel is left out without them.
        confidences: confidence of every motion, in [0, 1].
        truth: true sensor poses in the same world frame, of any number.
        title: written above the picture.
    """
    heights = [_track_height(Ts_world_lidar[:, :2, 3])] + ([1.6, 1.6] if sigmas is not None else []) + [1.1]
    figure = Figure(figsize=(8.0, 1.5 + sum(heights)), layout="constrained")
    top, *uncertainty, bottom = figure.subplots(len(heights), 1, height_ratios=heights)
    _draw_track(top, Ts_world_lidar, statuses, truth)
    if sigmas is not None:
        labels = "σ rotation [deg]", "σ translation [m]"
        values = np.rad2deg(np.linalg.norm(sigmas[:, :3], axis=1)), np.linalg.norm(sigmas[:, 3:], axis=1)
        for ax, label, value in zip(uncertainty, labels, values, strict=True):
            _draw_over_frames(ax, value, label, statuses)
            ax.sharex(bottom)
            ax.tick_params(labelbottom=False)
    _draw_status(bottom, statuses, confidences)
    if title:
        figure.suptitle(title)
    _save(figure, path)


def scene_figure(
    path: str | os.PathLike[str],
    points_by_scan: Sequence[Float[np.ndarray, "_ 3"]],
    Ts_world_lidar: Float[np.ndarray, "n 4 4"],
    *,
    scan_indices: Sequence[int] | None = None,
    max_points: int = 200_000,
    title: str = "",
) -> None:
    """Draws a map from above, made of a few registered scans, coloured by height above the first sensor position.

    Args:
        path: the PNG file to write.
        points_by_scan: points of some scans [m], each in its own LiDAR frame.
        Ts_world_lidar: sensor poses of the whole track, drawn as a line.
        scan_indices: row of `Ts_world_lidar` for each scan; by default the scans are the first frames.
        max_points: with more points than this, an even subset is drawn.
        title: written above the picture.
    """
    indices = range(len(points_by_scan)) if scan_indices is None else scan_indices
    clouds = [points @ Ts_world_lidar[i, :3, :3].T + Ts_world_lidar[i, :3, 3] for points, i in zip(points_by_scan, indices, strict=True)]
    cloud = np.concatenate([np.zeros((0, 3)), *clouds])
    cloud = cloud[:: max(1, -(-len(cloud) // max_points))]
    cloud = cloud[np.argsort(cloud[:, 2], kind="stable")]  # the highest on top
    low, high = np.percentile(cloud, [1.0, 99.0], axis=0) if len(cloud) else np.zeros((2, 3))  # stray far points do not set the scale
    span = max(high[2] - low[2], 0.1)

    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    ax = figure.subplots()
    ax.set_facecolor("#10141a")
    dots = ax.scatter(cloud[:, 0], cloud[:, 1], c=cloud[:, 2], s=0.4, lw=0, cmap="turbo", vmin=low[2] - 0.15 * span, vmax=low[2] + span)
    figure.colorbar(dots, ax=ax, label="height [m]", shrink=0.8)
    track = Ts_world_lidar[:, :3, 3]
    ax.plot(track[:, 0], track[:, 1], color="white", lw=1.8, marker="o", ms=2.5)
    _equal_axes(ax, np.stack([low[:2], high[:2], track[:, :2].min(axis=0), track[:, :2].max(axis=0)]))
    ax.set(xlabel="x [m]", ylabel="y [m]", title=title)
    _save(figure, path)


def _track_height(track: Float[np.ndarray, "n 2"]) -> float:
    """Height of the track's panel [inch], from 2.5 for a straight drive along x to 6."""
    width, height = np.maximum(np.ptp(track, axis=0), 2.0 * MIN_HALF_EXTENT_M)
    return float(np.clip(8.0 * height / width, 2.5, 6.0))


def _draw_track(ax: Axes, Ts_world_lidar: np.ndarray, statuses: Sequence[str], truth: np.ndarray | None) -> None:
    track = Ts_world_lidar[:, :2, 3]
    shown = track
    if truth is not None:
        ax.plot(truth[:, 0, 3], truth[:, 1, 3], color=TRUTH_COLOR, lw=4.0, alpha=0.5, label="truth")
        shown = np.concatenate([track, truth[:, :2, 3]])
    ax.plot(track[:, 0], track[:, 1], color=TRACK_COLOR, lw=1.4, marker="." if len(track) < 200 else None, ms=4.0, label="estimate")
    ax.plot(*track[0], color=TRACK_COLOR, marker="s", ms=7.0, ls="none", label="start")
    for status, color in STATUS_COLORS.items():
        marked = np.array([other == status for other in statuses], dtype=bool)
        if status != "ok" and marked.any():
            ax.plot(track[marked, 0], track[marked, 1], color=color, marker="X", ms=8.0, mec="white", ls="none", label=_name(status))
    _equal_axes(ax, shown)
    ax.set(xlabel="x [m]", ylabel="y [m]")
    ax.grid(alpha=0.3)
    ax.legend(loc="best", fontsize="small")


def _draw_over_frames(ax: Axes, values: np.ndarray, label: str, statuses: Sequence[str]) -> None:
    positive = np.where(values > 0.0, values, np.nan)  # the first frame has no motion: exactly zero
    ax.plot(positive, color=TRACK_COLOR, lw=1.2, marker="." if len(values) < 200 else None, ms=4.0)
    _mark_frames(ax, statuses, alpha=0.25)
    if np.nanmax(positive, initial=0.0) > 10.0 * np.nanmin(positive, initial=np.inf):
        ax.set_yscale("log")
    ax.set_ylabel(label)
    ax.grid(alpha=0.3)


def _draw_status(ax: Axes, statuses: Sequence[str], confidences: np.ndarray | None) -> None:
    num_ok = sum(status == "ok" for status in statuses)
    ax.axhspan(0.0, 1.0, color=STATUS_COLORS["ok"], alpha=0.4, lw=0, label=f"ok: {num_ok}")
    _mark_frames(ax, statuses, alpha=1.0)
    if confidences is None:
        ax.set(ylabel="status", yticks=[])
    else:
        ax.set_ylabel("confidence [-]")
        ax.plot(confidences, color="black", lw=1.0, marker="." if len(statuses) < 200 else None, ms=4.0, label="confidence")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set(xlabel="frame", ylim=(0.0, 1.05), xlim=(-0.5, len(statuses) - 0.5))
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.55), ncols=5, fontsize="small", frameon=False)


def _mark_frames(ax: Axes, statuses: Sequence[str], *, alpha: float) -> None:
    """A bar for every frame that is not ok, wide enough to be seen in a long run."""
    width = max(1.5, 500.0 / len(statuses))  # of about 500 points in all
    for status, color in STATUS_COLORS.items():
        frames = [i for i, other in enumerate(statuses) if other == status]
        if status != "ok" and frames:
            label = f"{_name(status)}: {len(frames)}"
            ax.vlines(frames, 0.0, 1.0, color=color, alpha=alpha, lw=width, label=label, transform=ax.get_xaxis_transform())


def _name(status: str) -> str:
    return status.replace("_", " ")


def _equal_axes(ax: Axes, xy: Float64[np.ndarray, "n 2"]) -> None:
    """One metre is as long on both axes, and nothing is drawn in a window of no width."""
    low, high = xy.min(axis=0), xy.max(axis=0)
    centre, half = (low + high) / 2.0, np.maximum((high - low) / 2.0, MIN_HALF_EXTENT_M)
    ax.dataLim.set_points(np.stack([centre - half, centre + half]))
    ax.autoscale_view()
    ax.set_aspect("equal", adjustable="datalim")


def _save(figure: Figure, path: str | os.PathLike[str]) -> None:
    figure.savefig(path, format="png", dpi=130, metadata={"Software": None})  # the same bytes for the same run
