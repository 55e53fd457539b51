"""Pictures of predicted uncertainty beside the errors that were made, as PNG files; no display and no global plotting state."""

import os
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

COLORS = ("#1f5fa8", "#2a9d5c", "#d62728", "#f2a900", "#8e44ad", "#5b6770")
NUM_BINS = 8  # of predicted sigma, equally filled


def reliability_figure(
    path: str | os.PathLike[str], observed: Mapping[float, Float[np.ndarray, " k"]], names: Sequence[str], *, title: str = ""
) -> None:
    """Draws the observed coverage of central intervals over the nominal one; above the diagonal sigma is too wide.

    Args:
        path: the PNG file to write.
        observed: nominal level, in (0, 1) -> observed shares, one per component.
        names: of the components.
        title: written above the picture.
    """
    levels = np.array(sorted(observed))
    shares = np.stack([observed[level] for level in levels])
    figure = Figure(figsize=(5.5, 5.5), layout="constrained")
    ax = figure.subplots()
    ax.plot([0, 100], [0, 100], color="#8a8a8a", lw=1.0, ls="--", label="calibrated")
    for index, name in enumerate(names):
        ax.plot(100 * levels, 100 * shares[:, index], color=COLORS[index % len(COLORS)], lw=1.4, marker="o", ms=4.0, label=name)
    ax.set(xlabel="nominal coverage [%]", ylabel="observed coverage [%]", xlim=(0, 100), ylim=(0, 100), title=title, aspect="equal")
    ax.grid(alpha=0.3)
    ax.legend(loc="lower right", fontsize="small")
    _save(figure, path)


def error_figure(
    path: str | os.PathLike[str],
    errors: Float[np.ndarray, "n k"],
    sigmas: Float[np.ndarray, "n k"],
    names: Sequence[str],
    units: Sequence[str],
    *,
    title: str = "",
) -> None:
    """Draws the size of each error over its predicted sigma, and in bins of sigma the root mean square and the 68 % quantile.

    Args:
        path: the PNG file to write.
        errors: of either sign, in units.
        sigmas: predicted, > 0, in units.
        names: of the components.
        units: of the components, for the axes.
        title: written above the picture.
    """
    num_columns = min(3, len(names))
    num_rows = -(-len(names) // num_columns)
    figure = Figure(figsize=(3.6 * num_columns, 3.4 * num_rows), layout="constrained")
    axes = figure.subplots(num_rows, num_columns, squeeze=False).ravel()
    for ax, error, sigma, name, unit in zip(axes, np.abs(errors).T, sigmas.T, names, units, strict=False):
        _draw_errors(ax, error, sigma)
        ax.set(title=name, xlabel=f"predicted σ [{unit}]", ylabel=f"|error| [{unit}]")
    for ax in axes[len(names) :]:
        ax.set_axis_off()
    axes[0].legend(loc="lower right", fontsize="x-small")
    figure.suptitle(title)
    _save(figure, path)


def ratios_figure(
    path: str | os.PathLike[str], ratios: Mapping[str, Float[np.ndarray, " k"]], names: Sequence[str], *, bound: float, title: str = ""
) -> None:
    """Draws ratios to a reference as bars, a group for each condition, their mean as a line, on a logarithmic scale.

    Args:
        path: the PNG file to write.
        ratios: condition -> ratios > 0, one per component.
        names: of the components.
        bound: drawn as a line.
        title: written above the picture.
    """
    figure = Figure(figsize=(2.0 + 1.9 * len(ratios), 4.2), layout="constrained")
    ax = figure.subplots()
    width, places = 0.8 / len(names), np.arange(len(ratios))
    heights = np.stack(list(ratios.values()))
    for index, name in enumerate(names):
        ax.bar(places + (index - 0.5 * (len(names) - 1)) * width, heights[:, index], width, color=COLORS[index % len(COLORS)], label=name)
    ax.hlines(heights.mean(axis=1), places - 0.45, places + 0.45, color="black", lw=1.6, label="mean")
    ax.axhline(1.0, color="#8a8a8a", lw=1.0)
    ax.axhline(bound, color="#8a8a8a", lw=1.0, ls="--", label=f"{bound:g}")
    ax.set_yscale("log")
    ax.set_xticks(places, list(ratios))
    ax.set(ylabel="ratio", title=title)
    ax.legend(loc="upper left", fontsize="x-small", ncols=2)
    _save(figure, path)


def cutoff_figure(
    path: str | os.PathLike[str],
    cutoffs: Float[np.ndarray, " c"],
    curves: Mapping[str, Float[np.ndarray, "c k"]],
    names: Sequence[str],
    units: Sequence[str],
    *,
    thresholds: tuple[float, float],
    title: str = "",
) -> None:
    """Draws the error of the pairs above each cut-off of the confidence, a panel for each axis, with a band between the curves.

    Args:
        path: the PNG file to write.
        cutoffs: of the confidence, in [0, 1].
        curves: condition -> root mean square errors, in units.
        names: of the axes.
        units: of the axes.
        thresholds: ends of the band in which a gate skips.
        title: written above the picture.
    """
    figure = Figure(figsize=(10.8, 6.4), layout="constrained")
    axes = figure.subplots(2, -(-len(names) // 2), squeeze=False).ravel()
    for axis, (ax, name, unit) in enumerate(zip(axes, names, units, strict=False)):
        rows = np.stack([curve[:, axis] for curve in curves.values()])
        ax.fill_between(100 * cutoffs, rows.min(axis=0), rows.max(axis=0), color=COLORS[0], alpha=0.15, lw=0)
        for color, (label, row) in zip(COLORS, zip(curves, rows, strict=True), strict=False):
            ax.plot(100 * cutoffs, row, color=color, lw=1.4, label=label)
        for theta in thresholds:
            ax.axvline(100 * theta, color="#8a8a8a", lw=1.0, ls="--")
        ax.set(title=name, xlabel="confidence at least [%]", ylabel=f"RMSE [{unit}]", xlim=(0, 100), ylim=(0, None))
        ax.grid(alpha=0.3)
    for ax in axes[len(names) :]:
        ax.set_axis_off()
    axes[0].legend(loc="lower left", fontsize="x-small")
    figure.suptitle(title)
    _save(figure, path)


def gap_figure(
    path: str | os.PathLike[str],
    doubts: Mapping[int, Float[np.ndarray, "_ k"]],
    names: Sequence[str],
    units: Sequence[str],
    *,
    title: str = "",
) -> None:
    """Draws quartiles of epistemic standard deviations by frame gap, a panel for each axis, on a logarithmic scale.

    Args:
        path: the PNG file to write.
        doubts: gap in frames -> standard deviations > 0 of its pairs, in units.
        names: of the axes.
        units: of the axes.
        title: written above the picture.
    """
    figure = Figure(figsize=(2.1 * len(names), 3.6), layout="constrained")
    axes = figure.subplots(1, len(names), squeeze=False).ravel()
    for axis, (ax, name, unit) in enumerate(zip(axes, names, units, strict=True)):
        boxes = ax.boxplot([sigmas[:, axis] for sigmas in doubts.values()], whis=(5, 95), showfliers=False, patch_artist=True, widths=0.6)
        for box, color in zip(boxes["boxes"], COLORS, strict=False):
            box.set(facecolor=color, alpha=0.5)
        ax.set(title=name, ylabel=f"σ [{unit}]", yscale="log", xlabel="gap [frames]")
        ax.set_xticks(range(1, len(doubts) + 1), [str(gap) for gap in doubts])
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.grid(alpha=0.3, axis="y")
    figure.suptitle(title)
    _save(figure, path)


def _draw_errors(ax: Axes, error: np.ndarray, sigma: np.ndarray) -> None:
    low, high = np.quantile(sigma, [0.005, 0.995]) * [0.7, 1.4]
    widen = max(1.0, np.sqrt(12.0 * low / high))  # more than a decade, or the ticks' labels would be many
    low, high = low / widen, high * widen
    ax.scatter(sigma, np.maximum(error, 1e-3 * low), s=4.0, lw=0, alpha=0.35, color=COLORS[0])
    ax.plot([low, high], [low, high], color="#8a8a8a", lw=1.0, ls="--", label="|error| = σ")
    bins = [part for part in np.array_split(np.argsort(sigma, kind="stable"), NUM_BINS) if len(part)]
    middles = [np.sqrt(np.mean(sigma[part] ** 2)) for part in bins]
    ax.plot(
        middles,
        [np.sqrt(np.mean(error[part] ** 2)) for part in bins],
        color=COLORS[2],
        lw=1.4,
        marker="o",
        ms=4.0,
        label="root mean square",
    )
    ax.plot(
        middles, [np.quantile(error[part], 0.6827) for part in bins], color=COLORS[3], lw=1.4, marker="s", ms=3.5, label="68 % quantile"
    )
    ax.set(xscale="log", yscale="log", xlim=(low, high), ylim=(0.03 * low, 5.0 * high))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.grid(alpha=0.3)


def _save(figure: Figure, path: str | os.PathLike[str]) -> None:
    figure.savefig(path, format="png", dpi=130, metadata={"Software": None})  # the same bytes for the same run
