"""Pictures of predicted uncertainty beside the errors that were made, as PNG files; no display and no global plotting state."""

import os
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

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
    ax.grid(alpha=0.3)


def _save(figure: Figure, path: str | os.PathLike[str]) -> None:
    figure.savefig(path, format="png", dpi=130, metadata={"Software": None})  # the same bytes for the same run
