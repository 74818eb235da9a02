"""Filled convex polygons on an array, with smooth edges. Pure NumPy.

Colours are (red, green, blue), 0 to 1. Corners are pixels in pixel-edge coordinates, u right
and v down.
"""

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array

Picture = NDArray[np.float32]
Colour = Array
"""(3,) red, green, blue."""


class Canvas:
    """A part of an image to draw on, transparent at first.

    A pixel row is drawn as several thin ones; along them coverage is exact. Their mean
    makes edges smooth.

    Parameters
    ----------
    left_px, top_px
        Corner of the canvas in the image.
    width_px, height_px
        Its size.
    fineness
        Thin rows per pixel row.
    """

    def __init__(
        self, left_px: int, top_px: int, width_px: int, height_px: int, fineness: int = 4
    ) -> None:
        self.left_px, self.top_px = left_px, top_px
        self.width_px, self.height_px = width_px, height_px
        self._fineness = fineness
        rows = height_px * fineness
        self._rgb = np.zeros((rows, width_px, 3), np.float32)
        self._clear = np.ones((rows, width_px, 1), np.float32)

    def fill(self, corners_px: Array, colour: Colour, opacity: float = 1.0) -> None:
        """Draw a convex polygon over what is there.

        Parameters
        ----------
        corners_px
            (K, 2) pixels of the image, in order around the polygon.
        colour
            Its colour.
        opacity
            1 hides what is below.
        """
        corners = (corners_px - (self.left_px, self.top_px)) * (1, self._fineness)
        (left, top), (right, bottom) = corners.min(axis=0), corners.max(axis=0)
        row_0 = max(int(top), 0)
        row_1 = min(int(bottom) + 1, self.height_px * self._fineness)
        col_0, col_1 = max(int(left), 0), min(int(right) + 1, self.width_px)
        if row_0 >= row_1 or col_0 >= col_1:
            return
        start, stop = _spans(corners, np.arange(row_0 + 0.5, row_1))
        column = np.arange(col_0, col_1, dtype=np.float32)
        cover = np.minimum(column + 1, stop[:, None]) - np.maximum(column, start[:, None])
        # A row that is crossed covers at most 1 of a pixel, one that is not less than 0.
        cover = np.maximum(cover, 0.0, out=cover)[..., None] * np.float32(opacity)
        part = np.s_[row_0:row_1, col_0:col_1]
        self._rgb[part] += cover * (np.asarray(colour, np.float32) - self._rgb[part])
        self._clear[part] *= 1 - cover

    def result(self) -> tuple[Picture, Picture]:
        """Colours, multiplied by their opacity, and opacity: (H, W, 3) and (H, W, 1)."""
        shape = (self.height_px, self._fineness, self.width_px, -1)
        rgb = self._rgb.reshape(shape).mean(axis=1)
        return rgb, 1 - self._clear.reshape(shape).mean(axis=1)


def _spans(corners: Array, rows: Array) -> tuple[Picture, Picture]:
    """Where a convex polygon starts and stops in each row; start > stop: not in it."""
    u, v = corners.T
    along_u, rise = np.append(u[1:], u[0]) - u, np.append(v[1:], v[0]) - v
    sloped = rise != 0
    u, v, along_u, rise = u[sloped], v[sloped], along_u[sloped], rise[sloped]
    share = (rows[:, None] - v) / rise
    crosses = (share >= 0) & (share <= 1)
    here = u + share * along_u
    start = np.where(crosses, here, np.inf).min(axis=1, initial=np.inf)
    stop = np.where(crosses, here, -np.inf).max(axis=1, initial=-np.inf)
    return start.astype(np.float32), stop.astype(np.float32)
