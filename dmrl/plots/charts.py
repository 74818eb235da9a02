"""SVG charts for an HTML page, in the page's text colour, light or dark."""

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.plots.style import STYLE, Figure, MaxNLocator, add_legend_below, mpl, use_plain_numbers

Array = NDArray[np.float64]

INK_PLACEHOLDER = "#010203"
"""Placeholder of the page's text colour, which SVG names currentColor."""
LINE_COLOURS = ["#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#7f7f7f"]
"""Line colours after Okabe and Ito, legible on white and on black."""
INKED = ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color")
THEME = STYLE | dict.fromkeys(INKED, INK_PLACEHOLDER)
THEME |= {"svg.fonttype": "none", "font.family": "sans-serif"}
THEME["axes.prop_cycle"] = f"cycler(color={LINE_COLOURS})"
SIZE_INCHES = (4.8, 3.6)
MAX_SHORT_NAME = 28
"""Maximum letters of a name in a legend with two columns."""


@contextmanager
def _open_chart(size: tuple[float, float] = SIZE_INCHES, **axes: Any) -> Iterator[Any]:
    """Yield the axes of a themed figure, which have a list ``svg`` that receives its SVG."""
    with mpl.rc_context(THEME):
        figure = Figure(size, layout="constrained")
        drawn: Any = figure.subplots()
        drawn.svg = []
        yield drawn
        drawn.set(**axes)
        drawn.grid(alpha=0.25)
        stream = io.StringIO()
        metadata = {"Date": None, "Creator": None, "Format": None, "Type": None}
        figure.savefig(stream, format="svg", transparent=True, metadata=metadata)
    svg = stream.getvalue()
    svg = svg[svg.index("<svg") :].replace(INK_PLACEHOLDER, "currentColor")
    # Remove the size: the page determines it.
    size_of = r'(<svg[^>]*?) height="[^"]*"([^>]*?) width="[^"]*"'
    drawn.svg.append(re.sub(size_of, r"\1\2", svg, count=1))


def _add_legend(axes: Any) -> None:
    """Add a legend below the axes, unless there is a single curve."""
    names = axes.get_legend_handles_labels()[1]
    if len(names) > 1:
        columns = 2 if max(map(len, names)) < MAX_SHORT_NAME else 1
        add_legend_below(axes.figure, axes, loc="outside lower left", ncols=columns)


def plot_losses(histories: Mapping[str, Sequence[float]], words: str = "loss") -> str:
    """Plot the loss over the epochs of a training, one line per model."""
    with _open_chart(xlabel="epoch", ylabel=words) as axes:
        axes.set_yscale("log")
        for name, values in histories.items():
            axes.plot(range(1, len(values) + 1), values, label=name)
        use_plain_numbers(axes.yaxis)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        _add_legend(axes)
    return str(axes.svg[0])


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
    ranges = sorted({row[:2] for rows in figures.values() for row in rows})
    told = [f"{low:g}-{high:g}" if high < np.inf else f"{low:g}-" for low, high in ranges]
    depth = "depth of the label, m; bars: 95 % intervals"
    with _open_chart(xlabel=depth, ylabel=words, ylim=(0, None)) as axes:
        beside = min(0.15, 0.8 / len(figures))  # offsets stay within the range's column
        for k, (name, rows) in enumerate(figures.items()):
            at = np.array([ranges.index(row[:2]) for row in rows], float)
            at += beside * (k - (len(figures) - 1) / 2)
            value, low, high = np.array([row[2:] for row in rows], float).reshape(-1, 3).T
            reach = np.maximum([value - low, high - value], 0.0)
            axes.errorbar(at, value, reach, fmt="o", markersize=4, capsize=2, label=name)
        axes.set(xticks=range(len(ranges)), xticklabels=told)
        _add_legend(axes)
    return str(axes.svg[0])


def plot_precision_recall(curves: Mapping[str, tuple[Array, Array]]) -> str:
    """Plot precision over recall, one line per evaluation: (K,) recall and precision each."""
    with _open_chart(xlabel="recall", ylabel="precision", xlim=(0, 1), ylim=(0, 1.02)) as axes:
        for name, (recall, precision) in curves.items():
            axes.plot(recall, precision, label=name)
        _add_legend(axes)
    return str(axes.svg[0])


def plot_reliability(bins: Mapping[str, tuple[Array, Array, Array]]) -> str:
    """Plot the share of correct detections over their confidence. The diagonal is calibrated.

    Parameters
    ----------
    bins
        By evaluation: (K,) mean confidence, share of correct ones, and number of detections.
    """
    words: dict[str, Any] = {"xlabel": "confidence", "ylabel": "share that is right"}
    with _open_chart(**words, xlim=(0, 1), ylim=(0, 1.02)) as axes:
        axes.plot((0, 1), (0, 1), color=INK_PLACEHOLDER, linewidth=0.8, linestyle=":")
        for k, (name, (confidence, right, count)) in enumerate(bins.items()):
            colour = LINE_COLOURS[k % len(LINE_COLOURS)]
            axes.plot(confidence, right, color=colour, label=name)
            axes.scatter(confidence, right, 8 + 40 * count / max(count.max(), 1), color=colour)
        _add_legend(axes)
    return str(axes.svg[0])


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
    words: dict[str, Any] = {"xlabel": "to the right, m", "ylabel": "forward, m", "aspect": "equal"}
    blue, orange = LINE_COLOURS[:2]
    with _open_chart((4.6, 4.4), **words) as axes:
        for k in np.flatnonzero(kept)[:: max(1, int(kept.sum()) // 30)]:
            ellipse = _confidence_ellipse(estimate_m[k], covariance[k])
            axes.plot(*_to_plot_axes(ellipse), color=blue, alpha=0.35)
        of_estimate = {"markersize": 3, "color": blue, "label": "estimate"}
        axes.plot(*_to_plot_axes(estimate_m[kept]), ".", **of_estimate)
        of_truth = {"markersize": 1.5, "color": orange, "label": "ground truth"}
        axes.plot(*_to_plot_axes(true_m), ".", **of_truth)
        axes.plot(0, 0, "^", color=INK_PLACEHOLDER, label="observer, looks up")
        _add_legend(axes)
    return str(axes.svg[0])


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
