"""Contact sheets of images of several cameras."""

from collections.abc import Sequence

import numpy as np

from dmrl.images.codec import Rgb, crop_and_scale, encode_png

TILE_PX, COLUMNS, ROWS = (192, 144), 8, 2
GAP_PX = 8


def even_indices(count: int, most: int) -> list[int]:
    """Return at most ``most`` indices from 0 to count - 1, evenly spaced."""
    return sorted({int(k) for k in np.linspace(0, count - 1, min(count, most)).round()})


def make_contact_sheet(image_sets: Sequence[Sequence[Rgb]]) -> bytes:
    """Return a PNG with two rows of evenly spaced images of each set.

    Parameters
    ----------
    image_sets
        Sets of (H, W, 3) uint8 images, at least one image each.
    """
    rows = []
    for images in image_sets:
        tiles = [
            crop_and_scale(images[k], (0, 0, images[k].shape[1], images[k].shape[0]), *TILE_PX)
            for k in even_indices(len(images), ROWS * COLUMNS)
        ]
        tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % COLUMNS)
        rows += [np.hstack(tiles[k : k + COLUMNS]) for k in range(0, len(tiles), COLUMNS)]
        rows.append(np.full((GAP_PX, rows[-1].shape[1], 3), 255, np.uint8))
    return encode_png(np.vstack(rows))
