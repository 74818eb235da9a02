"""Figures of a dataset's contents."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.plots.style import SIZE_INCHES, STYLE, Figure, MaxNLocator, mpl, save_figure


def plot_depth_histogram(depth_m: Mapping[str, NDArray[np.float64]], stem: Path) -> None:
    """Plot a histogram of the peers' depths, one colour per split.

    Parameters
    ----------
    depth_m
        Depths of the peers inside the images, by split, metres.
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
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_title("Depth of the peers")
        axes.grid(axis="y", alpha=0.3)
        figure.legend(title="split (peers)", loc="outside right upper")
    save_figure(figure, stem)


def plot_position_heat(
    uv_px: NDArray[np.float64], width_px: int, height_px: int, cell_px: int, stem: Path
) -> None:
    """Plot a heat map of the peers' positions in the image.

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
    save_figure(figure, stem)


def plot_peers_per_image(counts: Mapping[str, NDArray[np.int64]], stem: Path) -> None:
    """Plot a bar chart of the number of peers per image, one colour per split.

    Parameters
    ----------
    counts
        Number of peers inside each image, by split.
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
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_title("Peers per image")
        axes.grid(axis="y", alpha=0.3)
        figure.legend(title="split (images)", loc="outside right upper")
    save_figure(figure, stem)
