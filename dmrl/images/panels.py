"""Panels for a card, drawn by Pillow in milliseconds: stacked bars, a heat map, labelled images."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from dmrl.colours import paint_viridis

SIZE_PX = (900, 540)
FRAME_PX = (90, 50, 870, 460)
"""Left, upper, right and lower edge of the axes in a panel."""
INK, PAPER, SOFT = "#1b1f24", "#ffffff", "#d0d7de"
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")
"""Colours of the splits, after Okabe and Ito."""
TILE_PX, CAPTION_PX, SAMPLE_COLUMNS = 320, 24, 3
TEXT_PX = 18


@dataclass(frozen=True, slots=True)
class LabelledImage:
    """An image, (H, W, 3) uint8, with the pixels (N, 2) and texts of its labels, and a caption."""

    rgb: NDArray[np.uint8]
    uv_px: NDArray[np.float64]
    texts: Sequence[str]
    caption: str


class _Panel:
    """White panel with axes, whose methods take values of the axes."""

    def __init__(
        self, title: str, xlabel: str, x: tuple[float, float], y: tuple[float, float]
    ) -> None:
        self.image = Image.new("RGB", SIZE_PX, PAPER)
        self.draw = ImageDraw.Draw(self.image)
        self._x, self._y = x, y
        self.write((SIZE_PX[0] / 2, 24), title, "mm", TEXT_PX + 2)
        self.write(((FRAME_PX[0] + FRAME_PX[2]) / 2, SIZE_PX[1] - 20), xlabel, "mm")

    def to_px(self, x: float, y: float) -> tuple[float, float]:
        """Return the pixel of a point."""
        left, top, right, bottom = FRAME_PX
        along, up = ((v - a) / (b - a) for v, (a, b) in ((x, self._x), (y, self._y)))
        return left + along * (right - left), bottom + up * (top - bottom)

    def fill(self, x: tuple[float, float], y: tuple[float, float], colour: str) -> None:
        """Fill a rectangle."""
        (left, bottom), (right, top) = self.to_px(x[0], y[0]), self.to_px(x[1], y[1])
        self.draw.rectangle((left, top, right, bottom), fill=colour)

    def write(
        self, at: tuple[float, float], text: str, anchor: str, height_px: int = TEXT_PX
    ) -> None:
        """Write a text at a pixel."""
        self.draw.text(at, text, fill=INK, font=ImageFont.load_default(height_px), anchor=anchor)

    def add_ticks(self, x: Sequence[float], y: Sequence[float]) -> None:
        """Draw the numbers of both axes, and a line at each of y."""
        for value in x:
            left, _ = self.to_px(value, self._y[0])
            self.write((left, FRAME_PX[3] + 10), f"{value:g}", "mt")
        for value in y:
            left, level = self.to_px(self._x[0], value)
            self.draw.line((left, level, FRAME_PX[2], level), fill=SOFT)
            self.write((left - 10, level), f"{value:g}", "rm")


def _find_ticks(most: float, *, whole: bool = False) -> list[float]:
    """Return about five round numbers from 0 to a value."""
    rough = max(most, 1e-9) / 5
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(k * power for k in (1, 2, 5, 10) if k * power >= rough * (1 - 1e-9))
    step = max(step, 1.0) if whole else step
    return [k * step for k in range(int(most / step + 1e-9) + 1)]


def draw_stacked_bars(
    counts: Mapping[str, NDArray[np.int64]],
    edges: NDArray[np.float64],
    title: str,
    xlabel: str,
    *,
    middle: bool = False,
) -> bytes:
    """Draw bars that stack the counts of each name, as PNG.

    Parameters
    ----------
    counts
        (N,) by name, which the legend shows.
    edges
        (N + 1,) edges of the bars on the horizontal axis.
    title, xlabel
        Texts above and below.
    middle
        Write whole numbers below the middles of the bars.
    """
    tops = np.cumsum([np.zeros(len(edges) - 1), *counts.values()], axis=0)
    most = max(float(tops[-1].max()), 1.0)
    panel = _Panel(title, xlabel, (float(edges[0]), float(edges[-1])), (0.0, 1.25 * most))
    ticks = _find_ticks(float(edges[-1]), whole=middle)
    shown = [t for t in ticks if t < edges[-1] or not middle]
    panel.add_ticks(shown, _find_ticks(most, whole=True))
    for k, name in enumerate(counts):
        colour = COLOURS[k % len(COLOURS)]
        for j in np.flatnonzero(tops[k + 1] > tops[k]).tolist():
            gap = 0.1 * (edges[j + 1] - edges[j])
            panel.fill((edges[j] + gap, edges[j + 1] - gap), (tops[k][j], tops[k + 1][j]), colour)
        level = FRAME_PX[1] + 12 + 26 * k
        panel.draw.rectangle((FRAME_PX[2] - 18, level - 8, FRAME_PX[2], level + 8), fill=colour)
        panel.write((FRAME_PX[2] - 26, level), name, "rm")
    return _to_bytes(panel.image)


def draw_heat(counts: NDArray[np.float64], size_px: tuple[int, int], title: str) -> bytes:
    """Draw a heat map over the area of an image, as PNG; empty cells are white.

    Parameters
    ----------
    counts
        (rows, cols) of equal cells.
    size_px
        Width and height of the image.
    title
        Text above.
    """
    most = max(float(counts.max()), 1.0)
    rgb = paint_viridis(counts / most)
    rgb[counts == 0] = 255
    left, top, right, bottom = FRAME_PX
    scale = min((right - left) / size_px[0], (bottom - top) / size_px[1])
    shown = round(size_px[0] * scale), round(size_px[1] * scale)
    x_range, y_range = (0.0, (right - left) / scale), ((bottom - top) / scale, 0.0)
    panel = _Panel(title, f"u, px; v, px down; yellow: {most:g}", x_range, y_range)
    heat = Image.fromarray(rgb).resize(shown, Image.Resampling.NEAREST)
    panel.add_ticks(_find_ticks(size_px[0]), _find_ticks(size_px[1]))
    panel.image.paste(heat, (left, top))
    panel.draw.rectangle((left, top, left + shown[0], top + shown[1]), outline=SOFT)
    return _to_bytes(panel.image)


def draw_samples(shown: Sequence[LabelledImage]) -> bytes:
    """Draw images in rows, with a circle and a text for every label, as JPEG."""
    height_px, width_px = shown[0].rgb.shape[:2]
    scale = TILE_PX / width_px
    tall = round(height_px * scale) + CAPTION_PX
    rows = -(-len(shown) // SAMPLE_COLUMNS)
    sheet = Image.new("RGB", (TILE_PX * min(SAMPLE_COLUMNS, len(shown)), tall * rows), PAPER)
    font = ImageFont.load_default(13)
    for k, one in enumerate(shown):
        tile = Image.fromarray(one.rgb).resize((TILE_PX, tall - CAPTION_PX))
        draw = ImageDraw.Draw(tile)
        for (u, v), text in zip((one.uv_px * scale).tolist(), one.texts, strict=True):
            for colour, radius in (("black", 11), ("white", 10)):
                draw.circle((u, v), radius, outline=colour, width=2)
            at, side = (u + 14, "lm") if u < 0.75 * TILE_PX else (u - 14, "rm")
            how: dict[str, Any] = {"fill": "white", "stroke_fill": "black", "stroke_width": 2}
            draw.text((at, v), text, font=font, anchor=side, **how)
        corner = TILE_PX * (k % SAMPLE_COLUMNS), tall * (k // SAMPLE_COLUMNS)
        sheet.paste(tile, corner)
        below = corner[0] + 4, corner[1] + tall - CAPTION_PX / 2
        ImageDraw.Draw(sheet).text(below, one.caption, fill=INK, font=font, anchor="lm")
    return _to_bytes(sheet, format="JPEG", quality=85)


def _to_bytes(image: Image.Image, **how: Any) -> bytes:
    stream = BytesIO()
    image.save(stream, **({"format": "PNG"} | how))
    return stream.getvalue()
