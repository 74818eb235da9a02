"""Canvas that draws filled, antialiased polygons on a region of an image.

Colours are (red, green, blue), 0 to 1. Corners are pixels in pixel-edge coordinates, u right
and v down.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from dmrl.geometry.frames import Array

FloatImage = NDArray[np.float32]
Levels = NDArray[np.uint8]
Colour = Array
"""(3,) red, green, blue."""
Outline = tuple[list[float], tuple[int, ...]]
"""Corners in fine pixels, u and v alternating; red, green, blue and opacity, 0 to 255."""
LEVELS = 255
BAND_ROWS = 56


def iter_bands(rows: int) -> Iterator[slice]:
    """Iterate over bands of an image's rows whose arrays fit in a processor's cache."""
    return (slice(k, min(k + BAND_ROWS, rows)) for k in range(0, rows, BAND_ROWS))


class Canvas:
    """Region of an image to draw on, initially transparent.

    The canvas has several fine pixels per pixel and integer values, so the same polygons give the
    same bytes on every machine. Averaging the fine pixels antialiases the edges. Polygons become
    about 0.2 fine pixels larger on every side, without a shift.

    Parameters
    ----------
    left_px, top_px
        Corner of the canvas in the image.
    width_px, height_px
        Size of the canvas.
    fineness
        Fine pixels per pixel, in each direction.
    brightest
        Maximum value of a colour.
    ground
        (H, W, 3) background, 255 at maximum. None: transparent, and `to_opacity` returns the
        opacity.
    """

    def __init__(
        self,
        left_px: int,
        top_px: int,
        width_px: int,
        height_px: int,
        *,
        fineness: int = 4,
        brightest: float = 1.0,
        ground: Levels | None = None,
    ) -> None:
        self.left_px, self.top_px = left_px, top_px
        self.width_px, self.height_px = width_px, height_px
        self._fineness, self._brightest = fineness, brightest
        size = (width_px * fineness, height_px * fineness)
        if ground is None:
            self._rgb = Image.new("RGB", size)
        else:
            self._rgb = Image.fromarray(ground).resize(size, Image.Resampling.NEAREST)
        self._cover = Image.new("RGB", size) if ground is None else None
        # Drawing in RGBA on an image without alpha blends, which is slower than replacing.
        images = [self._rgb] if self._cover is None else [self._rgb, self._cover]
        self._over = [(ImageDraw.Draw(one), ImageDraw.Draw(one, "RGBA")) for one in images]

    def make_outlines(
        self, corners_px: Array, colours: Array, opacity: float | Array
    ) -> list[Outline]:
        """Prepare polygons with equal numbers of corners for `draw_outline`.

        Parameters
        ----------
        corners_px
            (F, K, 2) pixels of the image, in order around each polygon.
        colours
            (F, 3) of each.
        opacity
            Of all of them, or (F,) of each; 1 for opaque.
        """
        fine = (corners_px - (self.left_px, self.top_px)) * self._fineness
        inks = np.empty((len(fine), 4))
        inks[:, :3] = colours * (LEVELS / self._brightest)
        inks[:, 3] = np.multiply(opacity, LEVELS)
        whole = np.clip(np.rint(inks), 0, LEVELS).astype(int).tolist()
        corners = fine.reshape(len(fine), 2 * fine.shape[1]).tolist()
        return list(zip(corners, map(tuple, whole), strict=True))

    def draw_outline(self, outline: Outline) -> None:
        """Draw one of `make_outlines` over the existing content."""
        corners, ink = outline
        whole = ink[3] == LEVELS
        for (replacing, blending), colour in zip(
            self._over, (ink, (LEVELS, LEVELS, LEVELS, ink[3])), strict=False
        ):
            if whole:
                replacing.polygon(corners, fill=colour[:3])
            else:
                blending.polygon(corners, fill=colour)

    @property
    def part(self) -> tuple[slice, slice]:
        """Rows and columns of the image that the canvas covers."""
        return (
            slice(self.top_px, self.top_px + self.height_px),
            slice(self.left_px, self.left_px + self.width_px),
        )

    def to_levels(self) -> Levels:
        """Return (H, W, 3) colours, 255 at maximum. Without a background they are premultiplied."""
        return np.asarray(self._rgb.reduce(self._fineness))

    def to_rgb(self) -> FloatImage:
        """Return `to_levels` as (H, W, 3) colours."""
        return self.to_levels() * np.float32(self._brightest / LEVELS)

    def to_opacity(self) -> FloatImage:
        """Return the (H, W, 1) opacity, 0 to 1.

        Raises
        ------
        ValueError
            If the canvas has a background, which is opaque.
        """
        if self._cover is None:
            raise ValueError("a canvas with a background has no opacity of its own")
        levels = np.asarray(self._cover.getchannel(0).reduce(self._fineness), np.float32)
        return np.asarray(levels[..., None] / np.float32(LEVELS), np.float32)
