"""Figures of images with labels and detections, and of network output maps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.colours import RGB
from dmrl.plots.style import add_legend_below, open_figure, withStroke

Box = tuple[float, float, float, float]
NO_VALUE_GREY = "0.8"
CELL_INCHES = (3.4, 2.6)
"""Size of an image in a gallery."""
CIRCLE_POINTS, TEXT_POINTS = (19.0, 19.0), (42.0, 11.0)
"""Width and height of a detection's circle and text in a gallery."""
TEXT_OFFSETS_POINTS = [
    (x, y) for y in (0.0, -16.0, 16.0, -30.0, 30.0) for x in (33.0, -33.0, 0.0) if x or y
]
"""Offsets of the text's middle from a detection, points right and up, best first."""


@dataclass(frozen=True, slots=True)
class Example:
    """An image with its labels and the network's output.

    Parameters
    ----------
    title
        Title above the image.
    rgb
        (H, W, 3) uint8.
    confidence, depth_m
        (rows, cols) of the network; a depth of NaN is drawn grey.
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


def plot_examples(shown: Sequence[Example], stem: Path, *, depth_max_m: float = 3.0) -> None:
    """Plot one row per example: image with labels and detections, confidence map, depth map.

    Parameters
    ----------
    shown
        At least one example.
    stem
        Path without suffix.
    depth_max_m
        Depth at the end of the colour map, metres.
    """
    with open_figure(stem, (10.5, 2.6 * len(shown) + 0.6)) as figure:
        grid = figure.subplots(len(shown), 3, squeeze=False)
        maps: list[Any] = []
        for row, example in zip(grid, shown, strict=True):
            height, width = example.rgb.shape[:2]
            at = {"extent": (0, width, height, 0)}  # pixel-edge coordinates
            row[0].imshow(example.rgb, **at)
            row[0].set_title(example.title, fontsize=9, loc="left")
            maps = [
                row[1].imshow(example.confidence, vmin=0, vmax=1, cmap="inferno", **at),
                row[2].imshow(example.depth_m, vmin=0, vmax=depth_max_m, cmap="viridis", **at),
            ]
            row[2].set_facecolor(NO_VALUE_GREY)
            for axes in row:
                _draw_markers(axes, example)
                axes.set(xticks=[], yticks=[])
        for column, (image, name) in enumerate(
            zip(maps, ("confidence", "depth, m"), strict=True), start=1
        ):
            figure.colorbar(image, ax=grid[:, column], location="bottom", shrink=0.8, label=name)
        add_legend_below(figure, grid[0, 0], loc="outside lower left", fontsize=10, ncols=2)


def _draw_markers(axes: Any, example: Example) -> None:
    """Draw labels as squares and detections as crosses, in their colours with a dark rim."""
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
class GalleryImage:
    """An image with its detections.

    Parameters
    ----------
    title
        Title above the image.
    rgb
        (H, W, 3) uint8.
    uv_px
        (N, 2) pixels of the detections, u right and v down.
    depth_m
        (N,) their depths, metres.
    """

    title: str
    rgb: NDArray[np.uint8]
    uv_px: NDArray[np.float64]
    depth_m: NDArray[np.float64]


def plot_gallery(shown: Sequence[GalleryImage], stem: Path, *, columns: int = 3) -> None:
    """Plot images with a white circle around every detection, and its depth, as in the paper.

    Parameters
    ----------
    shown
        At least one image.
    stem
        Path without suffix.
    columns
        Images per row, at most.
    """
    columns = min(columns, len(shown))
    rows = -(-len(shown) // columns)
    with open_figure(stem, (CELL_INCHES[0] * columns, CELL_INCHES[1] * rows)) as figure:
        figure.supxlabel("circles: detections over the threshold, with their depths", fontsize=8)
        places = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in places:
            axes.axis("off")
        for axes, example in zip(places, shown, strict=False):
            height, width = example.rgb.shape[:2]
            axes.imshow(example.rgb, extent=(0, width, height, 0))
            axes.set_title(example.title, fontsize=8, loc="left")
            _draw_circles(axes, example, width, height)
            axes.set(xlim=(0, width), ylim=(height, 0))


def _draw_circles(axes: Any, example: GalleryImage, width: int, height: int) -> None:
    """Draw white circles with a black rim, and depths beside them where there is room."""
    places = _place_texts(example.uv_px, width, height)
    for (u, v), (text_u, text_v), depth_m in zip(
        example.uv_px.tolist(), places, example.depth_m.tolist(), strict=True
    ):
        for colour, points in (("black", 4.0), ("white", 2.0)):
            at = {"markeredgecolor": colour, "markeredgewidth": points}
            axes.plot(u, v, "o", markersize=16, markerfacecolor="none", **at)
        axes.text(
            text_u,
            text_v,
            f"{depth_m:.2f} m",
            ha="center",
            va="center",
            color="white",
            fontsize=9,
            path_effects=[withStroke(linewidth=2.5, foreground="black")],
        )


def _place_texts(uv_px: NDArray[np.float64], width: int, height: int) -> list[tuple[float, float]]:
    """Place the middle of each text, pixels, avoiding circles and other texts where possible."""
    point_px = width / (72 * CELL_INCHES[0])
    taken = [_text_box((u, v), point_px, CIRCLE_POINTS) for u, v in uv_px.tolist()]
    out = []
    for u, v in uv_px.tolist():
        level = min(max(v, 8.0), height - 8.0)
        tried = [(u + right * point_px, level - up * point_px) for right, up in TEXT_OFFSETS_POINTS]
        boxes = [_text_box(middle, point_px, TEXT_POINTS) for middle in tried]
        free = [_is_inside(box, width, height) and not _overlaps_any(box, taken) for box in boxes]
        # Without any free place, use the side that is inside the image.
        best = free.index(True) if any(free) else int(u > 0.75 * width)
        taken.append(boxes[best])
        out.append(tried[best])
    return out


def _text_box(middle: tuple[float, float], point_px: float, size: tuple[float, float]) -> Box:
    """Return the left, upper, right and lower edge, pixels, of a box of this size in points."""
    (u, v), (half_u, half_v) = middle, (0.5 * point_px * side for side in size)
    return u - half_u, v - half_v, u + half_u, v + half_v


def _is_inside(box: Box, width: int, height: int) -> bool:
    return box[0] >= 0 and box[1] >= 0 and box[2] <= width and box[3] <= height


def _overlaps_any(box: Box, others: Sequence[Box]) -> bool:
    return any(
        box[0] < other[2] and other[0] < box[2] and box[1] < other[3] and other[1] < box[3]
        for other in others
    )


@dataclass(frozen=True, slots=True)
class MapPair:
    """An image with the maps of several networks, or of one network on several backends.

    Parameters
    ----------
    title
        Title above the image.
    rgb
        (H, W, 3) uint8.
    maps
        (rows, cols) confidence and depth, by network or backend.
    """

    title: str
    rgb: NDArray[np.uint8]
    maps: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]


def plot_map_pairs(shown: Sequence[MapPair], stem: Path) -> None:
    """Plot one row per image: the image, then confidence, then depth, by network or backend.

    Colours range from 0 to the largest confidence, and to the largest depth, of all rows.

    Parameters
    ----------
    shown
        At least one, all with the same networks or backends.
    stem
        Path without suffix.
    """
    names = list(shown[0].maps)
    words = ("confidence", "depth, m")
    across = 1 + 2 * len(names)
    with open_figure(stem, (2.6 * across, 2.1 * len(shown) + 1.1)) as figure:
        figure.get_layout_engine().set(h_pad=0.12)  # type: ignore[call-arg, union-attr]
        grid = figure.subplots(len(shown), across, squeeze=False)
        for row, pair in zip(grid, shown, strict=True):
            row[0].imshow(pair.rgb)
            row[0].set_title(pair.title, fontsize=9)
        # Column 0 has the images; then one block of columns for each channel.
        for channel, (name, colours) in enumerate(zip(words, ("inferno", "viridis"), strict=True)):
            block = grid[:, 1 + channel * len(names) : 1 + (channel + 1) * len(names)]
            most = max(pair.maps[who][channel].max() for pair in shown for who in names)
            for row, pair in zip(block, shown, strict=True):
                for axes, who in zip(row, names, strict=True):
                    drawn = axes.imshow(pair.maps[who][channel], vmin=0, vmax=most, cmap=colours)
                    axes.set_title(who, fontsize=9)
            figure.colorbar(drawn, ax=block, location="bottom", shrink=0.6, label=name)
        for axes in grid.flat:
            axes.set(xticks=[], yticks=[])
