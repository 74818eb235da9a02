"""What is put behind rendered robots: a folder of photos, rooms, or the images of a dataset.

Images of a dataset are where its robots fly, as their camera sees it; the robots in them are
painted over.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.datasets import Split, is_dataset, open_dataset
from dmrl.errors import SettingError
from dmrl.images.bayer import load_opencv
from dmrl.images.codec import Rgb
from dmrl.rendering.backgrounds.photos import Photos, photos_in
from dmrl.rendering.backgrounds.rooms import ROOMS, rooms

MOST_HIDDEN = 0.15
"""Share of an image that may be painted over; of more, too little is left to be a background."""
BEYOND_BOX = 0.15
"""How far a robot is painted over beyond its box, over the box's greater side."""
BEYOND_PX = 3.0
"""And as much for its blurred edge."""
REACH_PX = 5.0
"""How far around a hidden pixel is looked for what to paint it with."""

Ellipse = tuple[float, float, float, float]
"""Centre and half axes, u and v, pixels."""


def photos_of(folder: Path) -> Photos:
    """Photos of a folder, rooms, or images of the train split of a dataset, without their robots.

    Raises
    ------
    SettingError
        If it holds no photo that can be read, or no image of which enough is left.
    DatasetError
        If it is a dataset without a train split, or a damaged one.
    """
    if str(folder) == ROOMS:
        return rooms()
    if not is_dataset(folder):
        return photos_in(folder)
    split = open_dataset(folder).split("train")
    robots = [_robots(peers) for peers in split.table.column("peers").to_pylist()]
    height_px, width_px = split.image_shape
    whole = MOST_HIDDEN * height_px * width_px
    rows = [row for row, found in enumerate(robots) if found is not None and _area(found) <= whole]
    if not rows:
        raise SettingError(
            f"{folder} has no image for a background: robots fill them, or have no box. "
            "Choose another --backgrounds"
        )
    return Photos(lambda k: _without(split, rows[k], robots[rows[k]] or ()), len(rows))


def _robots(peers: Sequence[dict[str, Any]]) -> list[Ellipse] | None:
    """What hides the robots of an image; None if the extent of one is not known."""
    boxes = [peer["box_px"] for peer in peers]
    return [_about(box) for box in boxes] if all(boxes) else None


def _about(box_px: Sequence[float]) -> Ellipse:
    left, top, right, bottom = box_px
    more = BEYOND_BOX * max(right - left, bottom - top) + BEYOND_PX
    # Corners of a box are rarely robot: an ellipse, somewhat wider, hides less of what is behind.
    half_u, half_v = (right - left) / 2 + more, (bottom - top) / 2 + more
    return (left + right) / 2, (top + bottom) / 2, half_u, half_v


def _area(robots: Sequence[Ellipse]) -> float:
    return sum(np.pi * half_u * half_v for _, _, half_u, half_v in robots)


def _without(split: Split, row: int, robots: Sequence[Ellipse]) -> Rgb:
    height_px, width_px = split.image_shape
    v, u = np.mgrid[:height_px, :width_px] + 0.5
    hidden: NDArray[np.bool_] = np.zeros((height_px, width_px), bool)
    for at_u, at_v, half_u, half_v in robots:
        hidden |= ((u - at_u) / half_u) ** 2 + ((v - at_v) / half_v) ** 2 < 1
    return painted_over(next(split.images([row])), hidden)


def painted_over(rgb: Rgb, hidden: NDArray[np.bool_]) -> Rgb:
    """A picture with what is hidden painted over by what is around it (Telea 2004).

    Parameters
    ----------
    rgb
        (H, W, 3), uint8.
    hidden
        (H, W), True where to paint.

    Raises
    ------
    MissingExtra
        If OpenCV is not installed.
    """
    cv2 = load_opencv("train", "a dataset as --backgrounds")
    picture, mask = np.ascontiguousarray(rgb), hidden.astype(np.uint8)
    return np.asarray(cv2.inpaint(picture, mask, REACH_PX, cv2.INPAINT_TELEA), np.uint8)
