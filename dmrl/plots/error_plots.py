"""Figures of errors: distributions, over time and over distance."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.plots.style import SIZE_INCHES, add_legend_below, open_figure, use_plain_numbers


def plot_error_violins(
    u_px: NDArray[np.float64], v_px: NDArray[np.float64], depth_m: NDArray[np.float64], stem: Path
) -> None:
    """Plot violins of the errors in u, v and depth, as in the paper.

    Parameters
    ----------
    u_px, v_px, depth_m
        (N,) detection minus label, NaN where there was no detection.
    stem
        Path without suffix.
    """
    with open_figure(stem) as figure:
        pixels, metres = figure.subplots(1, 2, width_ratios=(2, 1))
        _draw_violins(pixels, {"u": u_px, "v": v_px}, 24.0)
        pixels.set(ylabel="pixel error, px", title=f"{len(u_px)} labels")
        _draw_violins(metres, {"depth": depth_m}, 0.6)
        metres.set(ylabel="depth error, m")
        figure.supxlabel("detection minus label; line: median, bar: middle half", fontsize=9)


def _draw_violins(axes: Any, errors: Mapping[str, NDArray[np.float64]], least: float) -> None:
    """Draw one violin per name over the values inside the axis, and count the others."""
    known = {name: values[np.isfinite(values)] for name, values in errors.items()}
    spread = [np.percentile(np.abs(values), 80) for values in known.values() if values.size]
    limit = max([least, *spread])
    labels = []
    for place, (name, values) in enumerate(known.items(), start=1):
        near = values[np.abs(values) <= limit]
        if np.ptp(near) if near.size else False:
            axes.violinplot(near, [place], widths=0.8, showextrema=False)
        if values.size:
            low, middle, high = np.percentile(values, (25, 50, 75))
            axes.vlines(place, low, high, color="black", linewidth=4)
            axes.hlines(middle, place - 0.15, place + 0.15, color="black")
        labels.append(f"{name}\n{values.size - near.size} outside")
    axes.axhline(0, color="grey", linewidth=0.8)
    axes.set(xticks=range(1, len(known) + 1), xticklabels=labels, ylim=(-limit, limit))
    axes.set_xlim(0.4, len(known) + 0.6)
    axes.grid(axis="y", alpha=0.3)


def plot_error_trace(
    title: str,
    time_s: NDArray[np.float64],
    sigma_m: NDArray[np.float64],
    errors_m: Mapping[str, NDArray[np.float64]],
    stem: Path,
) -> None:
    """Plot position errors over time, one row per axis, with their 3-sigma bands.

    Parameters
    ----------
    title
        Title of the figure.
    time_s
        (N,) seconds.
    sigma_m
        (N, A) standard deviations of the estimator.
    errors_m
        (N, A) errors by their source, NaN where missing. The last one is black and on top.
    stem
        Path without suffix.
    """
    colours = ["tab:red", "black"][-len(errors_m) :]
    with open_figure(stem, (SIZE_INCHES[0], 2.2 * sigma_m.shape[1])) as figure:
        rows: Any = figure.subplots(sigma_m.shape[1], 1, sharex=True, sharey=True)
        for k, axes in enumerate(rows):
            band = 3 * sigma_m[:, k]
            axes.fill_between(time_s, -band, band, alpha=0.25, linewidth=0, label="3 sigma")
            for (word, error_m), colour in zip(errors_m.items(), colours, strict=True):
                axes.plot(time_s, error_m[:, k], ".", color=colour, markersize=2, label=word)
            axes.axhline(0, color="grey", linewidth=0.8)
            axes.grid(alpha=0.3)
            axes.set_ylabel(f"error in {'xyz'[k]}, m")
        # Limit the axis: large errors and wide bands at the start would flatten the rest.
        sizes = np.abs(np.concatenate([error.ravel() for error in errors_m.values()]))
        limit = np.percentile(sizes[np.isfinite(sizes)], 99) if np.isfinite(sizes).any() else 0.0
        axes.set_ylim(-1.2 * max(0.3, float(limit)), 1.2 * max(0.3, float(limit)))
        axes.set_xlabel("time, s")
        figure.axes[0].set_title(title)
        add_legend_below(figure, figure.axes[0], markerscale=4, ncols=4)


def plot_error_by_distance(
    distance_m: NDArray[np.float64],
    error_px: NDArray[np.float64],
    depth_error_m: NDArray[np.float64],
    stem: Path,
    *,
    step_m: float = 0.25,
) -> None:
    """Plot pixel and depth error of every label over its distance, with medians.

    Parameters
    ----------
    distance_m
        (N,) depth of the label, metres; NaN: unknown, not drawn.
    error_px
        (N,) length of the pixel error, not finite where there was no detection.
    depth_error_m
        (N,) detection minus label, metres.
    stem
        Path without suffix.
    step_m
        Width of the distance bins of the medians, metres.
    """
    found = np.isfinite(error_px) & np.isfinite(distance_m)
    with open_figure(stem, (SIZE_INCHES[0], 5.0)) as figure:
        pixels, metres = figure.subplots(2, 1, sharex=True)
        # Errors below a tenth of a pixel are only noise on a logarithmic axis.
        shown_px = np.maximum(error_px[found], 0.1)
        for axes, values in ((pixels, shown_px), (metres, depth_error_m[found])):
            axes.plot(distance_m[found], values, ".", alpha=0.5, label="label")
            edges, medians = _medians_by_step(distance_m[found], values, step_m)
            axes.stairs(medians, edges, color="black", baseline=None, linewidth=2, label="median")
            axes.grid(alpha=0.3)
        pixels.set(yscale="log", ylabel="pixel error, px", title=f"{found.sum()} labels")
        use_plain_numbers(pixels.yaxis)
        for radius_px in (8, 20):
            pixels.axhline(radius_px, color="grey", linestyle=":", linewidth=1)
            pixels.annotate(
                f"{radius_px} px", (1, radius_px), xycoords=("axes fraction", "data"), fontsize=8
            )
        metres.axhline(0, color="grey", linewidth=0.8)
        metres.set(ylabel="depth error, m\n(detection minus label)", xlabel="depth of the label, m")
        metres.set_xlim(left=0)
        add_legend_below(figure, metres, fontsize=9, ncols=2)


def _medians_by_step(
    at: NDArray[np.float64], values: NDArray[np.float64], step: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return edges of equal bins from zero, and the median in each, NaN in empty ones."""
    edges = np.arange(0.0, at.max(initial=step) + step, step)
    place = np.digitize(at, edges) - 1
    steps = (values[place == k] for k in range(len(edges) - 1))
    medians = [np.median(step) if step.size else np.nan for step in steps]
    return edges, np.array(medians)
