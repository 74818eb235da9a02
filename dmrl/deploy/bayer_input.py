"""Raw Bayer images of colour cameras, the input of the C; NumPy, bit-identical to it."""

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


def to_mosaic(image: Image, *, red_row: int = 0, red_col: int = 0) -> Image:
    """Simulate the (H, W) Bayer mosaic of an (H, W, 3) RGB image, or of (H, W, 1) grey.

    Parameters
    ----------
    image
        Source image.
    red_row, red_col
        0 or 1: the rows and columns, modulo 2, of the red pixels. Both 0: RGGB.
    """
    red, green, blue = np.broadcast_to(image, (*image.shape[:2], 3)).transpose(2, 0, 1)
    raw: Image = green.copy()
    raw[red_row::2, red_col::2] = red[red_row::2, red_col::2]
    raw[1 - red_row :: 2, 1 - red_col :: 2] = blue[1 - red_row :: 2, 1 - red_col :: 2]
    return raw


def demosaic(raw: Image, *, channels: int = 3, red_row: int = 0, red_col: int = 0) -> Image:
    """Demosaic an (H, W) Bayer image to (H, W, channels): RGB, or grey.

    A missing colour is the mean of the two or four nearest neighbours that measured it, halves
    rounded up; the border is mirrored.

    Parameters
    ----------
    raw
        Bayer mosaic, at least 2 x 2.
    channels
        3, or 1 for (77 R + 150 G + 29 B + 128) >> 8.
    red_row, red_col
        0 or 1: the rows and columns, modulo 2, of the red pixels. Both 0: RGGB.
    """
    around = np.pad(raw.astype(np.int32), 1, mode="reflect")
    across = around[1:-1, :-2] + around[1:-1, 2:]
    down = around[:-2, 1:-1] + around[2:, 1:-1]
    corners = around[:-2, :-2] + around[:-2, 2:] + around[2:, :-2] + around[2:, 2:]
    cross, corners = (across + down + 2) >> 2, (corners + 2) >> 2
    across, down = (across + 1) >> 1, (down + 1) >> 1
    rows, cols = np.indices(raw.shape)
    in_red_row = rows % 2 == red_row
    measured_green = in_red_row != (cols % 2 == red_col)
    green = np.where(measured_green, raw, cross)
    red = np.where(measured_green, np.where(in_red_row, across, down),
                   np.where(in_red_row, raw, corners))  # fmt: skip
    blue = np.where(measured_green, np.where(in_red_row, down, across),
                    np.where(in_red_row, corners, raw))  # fmt: skip
    grey = (77 * red + 150 * green + 29 * blue + 128) >> 8
    planes = (red, green, blue) if channels == 3 else (grey,)
    out: Image = np.stack(planes, axis=2).astype(np.uint8)
    return out
