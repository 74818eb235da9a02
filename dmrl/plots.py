"""Figures of datasets and evaluations, as PNG and SVG. The only home of matplotlib and pandas."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.colours import RGB
from dmrl.errors import MissingExtra

try:
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator
except ImportError as e:
    raise MissingExtra("matplotlib", "plot", "a figure") from e

# Equal input gives equal bytes: no date, no version, no random ids.
STYLE: dict[Any, Any] = {
    "svg.hashsalt": "dmrl",
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
}
METADATA = {".png": {"Software": None}, ".svg": {"Date": None, "Creator": None}}
SIZE_INCHES = (6.0, 3.6)


def save(figure: Figure, stem: Path) -> None:
    """Write ``<stem>.png`` and ``<stem>.svg``."""
    for suffix, metadata in METADATA.items():
        with mpl.rc_context(STYLE):
            figure.savefig(stem.with_suffix(suffix), dpi=150, metadata=metadata)


def depth_histogram(depth_m: Mapping[str, NDArray[np.float64]], stem: Path) -> None:
    """Histogram of the peers' depths, one colour per split.

    Parameters
    ----------
    depth_m
        Split to depths of the peers inside its images, metres.
    stem
        Path without suffix.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(SIZE_INCHES, layout="constrained")
        axes = figure.subplots()
        every = np.concatenate([np.zeros(1), *depth_m.values()])
        edges = np.linspace(0.0, max(float(every.max()), 0.1), 41).tolist()
        names = [f"{split} ({len(values)})" for split, values in depth_m.items()]
        axes.hist(list(depth_m.values()), edges, stacked=True, label=names)
        axes.set(xlabel="depth along the optical axis, m", ylabel="peers")
        axes.set_title("Depth of the peers")
        axes.grid(axis="y", alpha=0.3)
        figure.legend(title="split (peers)", loc="outside right upper")
    save(figure, stem)


def position_heat(
    uv_px: NDArray[np.float64], width_px: int, height_px: int, cell_px: int, stem: Path
) -> None:
    """Heat map of where peers are in the image.

    Parameters
    ----------
    uv_px
        (N, 2) pixels of the peers' centres.
    width_px, height_px
        Size of the images.
    cell_px
        Side of a square, pixels.
    stem
        Path without suffix.
    """
    edges = [np.arange(0, size + cell_px, cell_px) for size in (width_px, height_px)]
    counts, *_ = np.histogram2d(uv_px[:, 0], uv_px[:, 1], bins=edges)
    with mpl.rc_context(STYLE):
        figure = Figure(SIZE_INCHES, layout="constrained")
        axes = figure.subplots()
        empty_is_white = np.ma.masked_equal(counts.T, 0)
        heat = axes.pcolormesh(*edges, empty_is_white, cmap="viridis", vmin=0)
        axes.set(
            xlabel="u, px", ylabel="v, px", aspect="equal", xlim=(0, width_px), ylim=(height_px, 0)
        )
        axes.set_title(f"Peers per square of {cell_px} x {cell_px} px ({len(uv_px)} peers)")
        figure.colorbar(heat, label="peers", shrink=0.8, ticks=MaxNLocator(integer=True))
    save(figure, stem)


def peers_per_image(counts: Mapping[str, NDArray[np.int64]], stem: Path) -> None:
    """Bar chart of how many peers an image shows, one colour per split.

    Parameters
    ----------
    counts
        Split to the number of peers inside each image.
    stem
        Path without suffix.
    """
    most = max((int(c.max()) for c in counts.values() if c.size), default=0)
    with mpl.rc_context(STYLE):
        figure = Figure(SIZE_INCHES, layout="constrained")
        axes = figure.subplots()
        bottom = np.zeros(most + 1)
        for split, values in counts.items():
            images = np.bincount(values, minlength=most + 1)
            axes.bar(np.arange(most + 1), images, bottom=bottom, label=f"{split} ({values.size})")
            bottom += images
        axes.set(xlabel="peers inside the image", ylabel="images", xticks=range(most + 1))
        axes.set_title("Peers per image")
        axes.grid(axis="y", alpha=0.3)
        figure.legend(title="split (images)", loc="outside right upper")
    save(figure, stem)


def error_violins(
    u_px: NDArray[np.float64], v_px: NDArray[np.float64], depth_m: NDArray[np.float64], stem: Path
) -> None:
    """Violins of the errors in u, v and depth, as in the paper.

    Parameters
    ----------
    u_px, v_px, depth_m
        (N,) label minus detection; NaN where there was no detection.
    stem
        Path without suffix.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(SIZE_INCHES, layout="constrained")
        pixels, metres = figure.subplots(1, 2, width_ratios=(2, 1))
        _violins(pixels, {"u": u_px, "v": v_px}, 24.0)
        pixels.set(ylabel="pixel error, px", title=f"{len(u_px)} labels")
        _violins(metres, {"depth": depth_m}, 0.6)
        metres.set(ylabel="depth error, m")
        figure.supxlabel("label minus detection; line: median, bar: middle half", fontsize=9)
    save(figure, stem)


def _violins(axes: Any, errors: Mapping[str, NDArray[np.float64]], least: float) -> None:
    """One violin per name, over what lies within the axis; the rest is counted."""
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


def error_trace(
    title: str,
    time_s: NDArray[np.float64],
    sigma_m: NDArray[np.float64],
    errors_m: Mapping[str, NDArray[np.float64]],
    stem: Path,
) -> None:
    """Errors of positions over time, one axis above the other, with their 3-sigma bands.

    Parameters
    ----------
    title
        Words above it.
    time_s
        (N,) seconds.
    sigma_m
        (N, A) standard deviations, as the estimator has them.
    errors_m
        (N, A) errors by what made them, NaN where there are none; the last in black, on top.
    stem
        Path without suffix.
    """
    colours = ["tab:red", "black"][-len(errors_m) :]
    with mpl.rc_context(STYLE):
        figure = Figure((SIZE_INCHES[0], 2.2 * sigma_m.shape[1]), layout="constrained")
        rows: Any = figure.subplots(sigma_m.shape[1], 1, sharex=True, sharey=True)
        for k, axes in enumerate(rows):
            band = 3 * sigma_m[:, k]
            axes.fill_between(time_s, -band, band, alpha=0.25, linewidth=0, label="3 sigma")
            for (word, error_m), colour in zip(errors_m.items(), colours, strict=True):
                axes.plot(time_s, error_m[:, k], ".", color=colour, markersize=2, label=word)
            axes.axhline(0, color="grey", linewidth=0.8)
            axes.grid(alpha=0.3)
            axes.set_ylabel(f"error in {'xyz'[k]}, m")
        # Far errors and wide bands at the start would flatten the rest.
        sizes = np.abs(np.concatenate([error.ravel() for error in errors_m.values()]))
        limit = np.percentile(sizes[np.isfinite(sizes)], 99) if np.isfinite(sizes).any() else 0.0
        axes.set_ylim(-1.2 * max(0.3, float(limit)), 1.2 * max(0.3, float(limit)))
        axes.set_xlabel("time, s")
        figure.axes[0].set_title(title)
        figure.axes[0].legend(loc="upper right", fontsize=8, markerscale=4)
    save(figure, stem)


def error_by_distance(
    distance_m: NDArray[np.float64],
    error_px: NDArray[np.float64],
    depth_error_m: NDArray[np.float64],
    stem: Path,
    *,
    step_m: float = 0.25,
) -> None:
    """Pixel and depth error of every label over its distance, with medians.

    Parameters
    ----------
    distance_m
        (N,) depth of the label, metres.
    error_px
        (N,) length of the pixel error; not finite where there was no detection.
    depth_error_m
        (N,) label minus detection, metres.
    stem
        Path without suffix.
    step_m
        Range of distance that one median is taken over.
    """
    found = np.isfinite(error_px)
    with mpl.rc_context(STYLE):
        figure = Figure((SIZE_INCHES[0], 5.0), layout="constrained")
        pixels, metres = figure.subplots(2, 1, sharex=True)
        # Below a tenth of a pixel a logarithmic axis would show nothing but noise.
        shown_px = np.maximum(error_px[found], 0.1)
        for axes, values in ((pixels, shown_px), (metres, depth_error_m[found])):
            axes.plot(distance_m[found], values, ".", alpha=0.5, label="label")
            edges, medians = _medians(distance_m[found], values, step_m)
            axes.stairs(medians, edges, color="black", baseline=None, linewidth=2, label="median")
            axes.grid(alpha=0.3)
        pixels.set(yscale="log", ylabel="pixel error, px", title=f"{found.sum()} labels")
        for radius_px in (8, 20):
            pixels.axhline(radius_px, color="grey", linestyle=":", linewidth=1)
            pixels.annotate(
                f"{radius_px} px", (1, radius_px), xycoords=("axes fraction", "data"), fontsize=8
            )
        metres.axhline(0, color="grey", linewidth=0.8)
        metres.set(ylabel="depth error, m\n(label minus detection)", xlabel="depth of the label, m")
        metres.set_xlim(left=0)
        metres.legend(loc="best", fontsize=9)
    save(figure, stem)


def _medians(
    at: NDArray[np.float64], values: NDArray[np.float64], step: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Edges of equal steps from zero, and the median in each; NaN where there is none."""
    edges = np.arange(0.0, at.max(initial=step) + step, step)
    place = np.digitize(at, edges) - 1
    medians = [
        np.median(values[place == k]) if (place == k).any() else np.nan
        for k in range(len(edges) - 1)
    ]
    return edges, np.array(medians)


@dataclass(frozen=True, slots=True)
class Example:
    """One image with its labels and what the network made of it.

    Parameters
    ----------
    title
        Line above it.
    rgb
        (H, W, 3) uint8.
    confidence, depth_m
        (rows, cols) of the network.
    labels_px, detections_px
        (N, 2) pixels, u right and v down.
    source
        Source of the labels.
    """

    title: str
    rgb: NDArray[np.uint8]
    confidence: NDArray[np.float64]
    depth_m: NDArray[np.float64]
    labels_px: NDArray[np.float64]
    detections_px: NDArray[np.float64]
    source: str


def examples(shown: Sequence[Example], stem: Path, *, depth_max_m: float = 3.0) -> None:
    """A row per example: image with labels and detections, confidence map, depth map.

    Parameters
    ----------
    shown
        At least one.
    stem
        Path without suffix.
    depth_max_m
        Depth of the last colour, metres.
    """
    with mpl.rc_context(STYLE):
        figure = Figure((10.5, 2.6 * len(shown) + 0.6), layout="constrained")
        grid = figure.subplots(len(shown), 3, squeeze=False)
        maps: list[Any] = []
        for row, example in zip(grid, shown, strict=True):
            height, width = example.rgb.shape[:2]
            at = {"extent": (0, width, height, 0)}  # pixel-edge coordinates
            row[0].imshow(example.rgb, **at)
            row[0].set_title(example.title, fontsize=9, loc="left")
            maps = [
                row[1].imshow(example.confidence, vmin=0, vmax=1, cmap="inferno", **at),
                row[2].imshow(example.depth_m, vmin=0, vmax=depth_max_m, cmap="turbo", **at),
            ]
            for axes in row:
                _mark(axes, example)
                axes.set(xticks=[], yticks=[])
        for column, (image, name) in enumerate(
            zip(maps, ("confidence", "depth, m"), strict=True), start=1
        ):
            figure.colorbar(image, ax=grid[:, column], location="bottom", shrink=0.8, label=name)
        handles, names = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower left", ncols=2, frameon=False)
    save(figure, stem)


def _mark(axes: Any, example: Example) -> None:
    """Labels as squares, detections as crosses, in their colours with a dark rim."""
    marks = (
        (example.labels_px, "s", 9, example.source, f"label ({example.source})"),
        (example.detections_px, "x", 6, "detection", "detection"),
    )
    for uv_px, marker, points, kind, name in marks:
        colour = tuple(value / 255 for value in RGB.get(kind, RGB["other"]))
        for edge, ink, words in ((2.6, "black", None), (1.3, colour, name)):
            axes.plot(
                *uv_px.reshape(-1, 2).T,
                marker,
                markersize=points,
                markerfacecolor="none",
                markeredgecolor=ink,
                markeredgewidth=edge,
                label=words,
            )


@dataclass(frozen=True, slots=True)
class MapPair:
    """One image, and the maps of two networks.

    Parameters
    ----------
    title
        Line above it.
    rgb
        (H, W, 3) uint8.
    maps
        What computed them, to its (rows, cols) confidence and depth; two of them.
    """

    title: str
    rgb: NDArray[np.uint8]
    maps: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]


def map_pairs(shown: Sequence[MapPair], stem: Path) -> None:
    """A row per image: the image, then confidence and depth, each by one and by the other.

    Colours run from 0 to the largest value of a column's pair over all rows.

    Parameters
    ----------
    shown
        At least one, all computed by the same two.
    stem
        Path without suffix.
    """
    names = list(shown[0].maps)
    words = ("confidence", "depth, m")
    with mpl.rc_context(STYLE):
        figure = Figure((13.0, 2.1 * len(shown) + 1.1), layout="constrained")
        figure.get_layout_engine().set(h_pad=0.12)  # type: ignore[call-arg, union-attr]
        grid = figure.subplots(len(shown), 5, squeeze=False)
        for channel, (name, colours) in enumerate(zip(words, ("inferno", "turbo"), strict=True)):
            columns = slice(1 + 2 * channel, 3 + 2 * channel)
            most = max(pair.maps[who][channel].max() for pair in shown for who in names)
            for row, pair in zip(grid, shown, strict=True):
                for axes, who in zip(row[columns], names, strict=True):
                    drawn = axes.imshow(pair.maps[who][channel], vmin=0, vmax=most, cmap=colours)
                    axes.set_title(who, fontsize=9)
            figure.colorbar(drawn, ax=grid[:, columns], location="bottom", shrink=0.6, label=name)
        for row, pair in zip(grid, shown, strict=True):
            row[0].imshow(pair.rgb)
            row[0].set_title(pair.title, fontsize=9)
            for axes in row:
                axes.set(xticks=[], yticks=[])
    save(figure, stem)


def trade_offs(
    costs: Mapping[str, Sequence[float]],
    gains: Sequence[float],
    names: Sequence[str],
    gain: str,
    stem: Path,
) -> None:
    """A gain against each of several costs, one marker per name, the same in all.

    Parameters
    ----------
    costs
        Words of an axis to a value per name.
    gains
        A value per name.
    names
        What was measured.
    gain
        Words of the axis up.
    stem
        Path without suffix.
    """
    with mpl.rc_context(STYLE):
        figure = Figure((4.0 * len(costs), 4.2), layout="constrained")
        for axes, (words, values) in zip(
            figure.subplots(1, len(costs), sharey=True, squeeze=False)[0],
            costs.items(),
            strict=True,
        ):
            for place, name in enumerate(names):
                axes.plot(
                    values[place], gains[place], "osD^vP*X"[place % 8], markersize=8, label=name
                )
            axes.set(xlabel=words, xlim=(0, 1.08 * max(values)))
            axes.grid(alpha=0.3)
        figure.axes[0].set_ylabel(gain)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    save(figure, stem)
