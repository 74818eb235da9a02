"""SVG charts for an HTML page, in the page's text colour, light or dark."""

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.plots.style import STYLE, Figure, MaxNLocator, mpl, use_plain_numbers

Array = NDArray[np.float64]

INK_PLACEHOLDER = "#010203"
"""Placeholder of the page's text colour, which SVG names currentColor."""
LINE_COLOURS = (
    "#0072b2",
    "#e69f00",
    "#009e73",
    "#d55e00",
    "#cc79a7",
    "#56b4e9",
    "#7f7f7f",
    "#b8a800",
)
"""Line colours after Okabe and Ito, legible on white and on black."""
THEME = STYLE | {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "text.color": INK_PLACEHOLDER,
    "axes.edgecolor": INK_PLACEHOLDER,
    "axes.labelcolor": INK_PLACEHOLDER,
    "xtick.color": INK_PLACEHOLDER,
    "ytick.color": INK_PLACEHOLDER,
    "axes.prop_cycle": f"cycler(color={LINE_COLOURS})",
}
SIZE_INCHES = (4.8, 3.6)
MAX_SHORT_NAME = 28
"""Maximum letters of a name in a legend with two columns."""


@contextmanager
def _svg_chart(size: tuple[float, float] = SIZE_INCHES) -> Iterator[tuple[Figure, list[str]]]:
    """Yield a themed figure, and a list that receives its SVG at the end."""
    made: list[str] = []
    with mpl.rc_context(THEME):
        figure = Figure(size, layout="constrained")
        yield figure, made
        stream = io.StringIO()
        metadata = {"Date": None, "Creator": None, "Format": None, "Type": None}
        figure.savefig(stream, format="svg", transparent=True, metadata=metadata)
    svg = stream.getvalue()
    svg = svg[svg.index("<svg") :].replace(INK_PLACEHOLDER, "currentColor")
    # Remove the size: the page determines it.
    made.append(re.sub(r'(<svg[^>]*?) height="[^"]*"([^>]*?) width="[^"]*"', r"\1\2", svg, count=1))


def _add_legend(axes: Any) -> None:
    """Add a legend below the axes, where it covers no curve. A single curve has none."""
    handles, names = axes.get_legend_handles_labels()
    if len(names) > 1:
        columns = 2 if max(map(len, names)) < MAX_SHORT_NAME else 1
        how = {"fontsize": 8, "frameon": False, "ncols": columns}
        axes.figure.legend(handles, names, loc="outside lower left", **how)


def plot_losses(histories: Mapping[str, Sequence[float]], words: str = "loss") -> str:
    """Plot the loss over the epochs of a training, one line per model."""
    with _svg_chart() as (figure, made):
        axes = figure.subplots()
        for name, values in histories.items():
            axes.plot(range(1, len(values) + 1), values, label=name)
        axes.set(xlabel="epoch", ylabel=words, yscale="log")
        use_plain_numbers(axes.yaxis)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.25)
        _add_legend(axes)
    return made[0]


def plot_by_distance(
    figures: Mapping[str, Sequence[tuple[float, float, float, float, float]]], words: str
) -> str:
    """Plot a metric with its interval for each range of distance, one colour per evaluation.

    Parameters
    ----------
    figures
        By evaluation: both ends of the range, metres, the last one infinite; value, and both ends
        of the interval.
    words
        Label of the vertical axis.
    """
    with _svg_chart() as (figure, made):
        axes = figure.subplots()
        ranges = sorted({row[:2] for rows in figures.values() for row in rows})
        beside = min(0.15, 0.8 / len(figures))  # offsets stay within the range's column
        for k, (name, rows) in enumerate(figures.items()):
            at = np.array([ranges.index(row[:2]) for row in rows], float)
            at += beside * (k - (len(figures) - 1) / 2)
            value, low, high = np.array([row[2:] for row in rows], float).reshape(-1, 3).T
            reach = np.maximum([value - low, high - value], 0.0)
            axes.errorbar(at, value, reach, fmt="o", markersize=4, capsize=2, label=name)
        for k in range(1, len(ranges)):
            axes.axvline(k - 0.5, color=INK_PLACEHOLDER, linewidth=0.5, alpha=0.25)
        told = [f"{low:g}-{high:g}" if high < np.inf else f"{low:g}-" for low, high in ranges]
        axes.set(xticks=range(len(ranges)), xticklabels=told, ylabel=words, ylim=(0, None))
        axes.set_xlabel("depth of the label, m; bars: 95 % intervals")
        axes.grid(axis="y", alpha=0.25)
        _add_legend(axes)
    return made[0]


def plot_precision_recall(curves: Mapping[str, tuple[Array, Array]]) -> str:
    """Plot precision over recall, one line per evaluation: (K,) recall and precision each."""
    with _svg_chart() as (figure, made):
        axes = figure.subplots()
        for name, (recall, precision) in curves.items():
            axes.plot(recall, precision, label=name)
        axes.set(xlabel="recall", ylabel="precision", xlim=(0, 1), ylim=(0, 1.02))
        axes.grid(alpha=0.25)
        _add_legend(axes)
    return made[0]


def plot_reliability(bins: Mapping[str, tuple[Array, Array, Array]]) -> str:
    """Plot the share of correct detections over their confidence. The diagonal is calibrated.

    Parameters
    ----------
    bins
        By evaluation: (K,) mean confidence, share of correct ones, and number of detections.
    """
    with _svg_chart() as (figure, made):
        axes = figure.subplots()
        axes.plot((0, 1), (0, 1), color=INK_PLACEHOLDER, linewidth=0.8, linestyle=":")
        for k, (name, (confidence, right, count)) in enumerate(bins.items()):
            colour = LINE_COLOURS[k % len(LINE_COLOURS)]
            axes.plot(confidence, right, color=colour, label=name)
            axes.scatter(confidence, right, 8 + 40 * count / max(count.max(), 1), color=colour)
        axes.set(xlabel="confidence", ylabel="share that is right", xlim=(0, 1), ylim=(0, 1.02))
        axes.grid(alpha=0.25)
        _add_legend(axes)
    return made[0]


def plot_positions(
    true_m: Array, estimate_m: Array, covariance: Array, kept: NDArray[np.bool_]
) -> str:
    """Plot true and estimated positions of a peer from above, with 95 % ellipses.

    Parameters
    ----------
    true_m, estimate_m
        (N, 2) x forward and y left of the observer, metres.
    covariance
        (N, 2, 2), square metres. About thirty ellipses are drawn.
    kept
        (N,) whether the estimator keeps the position.
    """
    with _svg_chart((4.6, 4.4)) as (figure, made):
        axes = figure.subplots()
        for k in np.flatnonzero(kept)[:: max(1, int(kept.sum()) // 30)]:
            axes.plot(
                *_to_plot_axes(_confidence_ellipse(estimate_m[k], covariance[k])),
                color=LINE_COLOURS[0],
                alpha=0.35,
            )
        axes.plot(
            *_to_plot_axes(estimate_m[kept]),
            ".",
            markersize=3,
            color=LINE_COLOURS[0],
            label="estimate",
        )
        axes.plot(
            *_to_plot_axes(true_m), ".", markersize=1.5, color=LINE_COLOURS[1], label="ground truth"
        )
        axes.plot(0, 0, "^", color=INK_PLACEHOLDER, label="observer, looks up")
        axes.set(xlabel="to the right, m", ylabel="forward, m", aspect="equal")
        axes.grid(alpha=0.25)
        axes.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return made[0]


def _to_plot_axes(xy_m: Array) -> tuple[Array, Array]:
    """Convert to the axes of the plot: forward is up, left is left."""
    return -xy_m[..., 1], xy_m[..., 0]


def _confidence_ellipse(centre_m: Array, covariance: Array, inside: float = 0.95) -> Array:
    """Return (41, 2) points of the ellipse that contains this share of a Gaussian."""
    values, axes = np.linalg.eigh(covariance)
    turn = np.linspace(0, 2 * np.pi, 41)
    radii = np.sqrt(-2 * np.log(1 - inside) * np.maximum(values, 0.0))
    circle = np.stack((np.cos(turn), np.sin(turn)), axis=-1)
    return np.asarray(centre_m + (circle * radii) @ axes.T)


def plot_lineage(columns: Sequence[Sequence[str]], arrows: Sequence[tuple[str, str]]) -> str:
    """Plot the lineage of results: boxes in columns, from sources to results.

    Parameters
    ----------
    columns
        Texts of the boxes, each once, from left to right.
    arrows
        (from, to), by texts.
    """
    tallest = max(len(column) for column in columns)
    with _svg_chart((1.9 * len(columns), max(0.5 * tallest, 1.0))) as (figure, made):
        axes = figure.subplots()
        at = {
            words: (x, (len(column) - 1) / 2 - y)
            for x, column in enumerate(columns)
            for y, words in enumerate(column)
        }
        for source, result in arrows:
            (x0, y0), (x1, y1) = at[source], at[result]
            arrow = {
                "arrowstyle": "->",
                "color": INK_PLACEHOLDER,
                "alpha": 0.5,
                "shrinkA": 0,
                "shrinkB": 0,
            }
            axes.annotate("", (x1 - 0.42, y1), (x0 + 0.42, y0), arrowprops=arrow)
        box = {"boxstyle": "round", "facecolor": "none", "edgecolor": INK_PLACEHOLDER, "alpha": 0.6}
        for words, (x, y) in at.items():
            axes.text(x, y, words, ha="center", va="center", fontsize=8, bbox=box)
        axes.set(xlim=(-0.5, len(columns) - 0.5), ylim=(-tallest / 2, tallest / 2))
        axes.axis("off")
    return made[0]
