"""Backgrounds for rendered robots: a folder of photos, rooms, or the images of a dataset.

Images of a dataset show the place where robots fly, through their own camera. The robots in them
are painted over.
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
from dmrl.rendering.backgrounds.photos import Photos, open_photos
from dmrl.rendering.backgrounds.rooms import ROOMS, open_rooms

MAX_HIDDEN_SHARE = 0.15
"""Largest share of an image that may be painted over. Beyond it, too little background is left."""
MARGIN_SHARE_OF_BOX = 0.15
"""Margin around a robot's box that is painted over as well, as a share of the box's longer side."""
MARGIN_PX = 3.0
"""Further margin, pixels, for the robot's blurred edge."""
INPAINT_RADIUS_PX = 5.0
"""Radius around a hidden pixel from which the inpainting takes colours."""

Ellipse = tuple[float, float, float, float]
"""Centre u, v and half axes u, v, pixels."""


def open_backgrounds(folder: Path) -> Photos:
    """Open the backgrounds of a folder, the built-in rooms, or the train split of a dataset.

    Robots in the images of a dataset are painted over.

    Raises
    ------
    SettingError
        If the folder has no readable photo, or the dataset no image with enough background.
    DatasetError
        If the dataset has no train split or is damaged.
    """
    if str(folder) == ROOMS:
        return open_rooms()
    if not is_dataset(folder):
        return open_photos(folder)
    split = open_dataset(folder).split("train")
    robots = [_fit_ellipses(peers) for peers in split.table.column("peers").to_pylist()]
    height_px, width_px = split.image_shape
    whole = MAX_HIDDEN_SHARE * height_px * width_px
    rows = [
        row
        for row, found in enumerate(robots)
        if found is not None and _total_area_px(found) <= whole
    ]
    if not rows:
        raise SettingError(
            f"{folder} has no image for a background: robots fill them, or have no box. "
            "Choose another --backgrounds"
        )
    return Photos(lambda k: _remove_robots(split, rows[k], robots[rows[k]] or ()), len(rows))


def _fit_ellipses(peers: Sequence[dict[str, Any]]) -> list[Ellipse] | None:
    """Return an ellipse around every robot of an image; None if a robot has no box."""
    boxes = [peer["box_px"] for peer in peers]
    return [_fit_ellipse(box) for box in boxes] if all(boxes) else None


def _fit_ellipse(box_px: Sequence[float]) -> Ellipse:
    left, top, right, bottom = box_px
    more = MARGIN_SHARE_OF_BOX * max(right - left, bottom - top) + MARGIN_PX
    # The corners of a box rarely show the robot. A slightly wider ellipse hides less background.
    half_u, half_v = (right - left) / 2 + more, (bottom - top) / 2 + more
    return (left + right) / 2, (top + bottom) / 2, half_u, half_v


def _total_area_px(robots: Sequence[Ellipse]) -> float:
    return sum(np.pi * half_u * half_v for _, _, half_u, half_v in robots)


def _remove_robots(split: Split, row: int, robots: Sequence[Ellipse]) -> Rgb:
    height_px, width_px = split.image_shape
    v, u = np.mgrid[:height_px, :width_px] + 0.5
    hidden: NDArray[np.bool_] = np.zeros((height_px, width_px), bool)
    for at_u, at_v, half_u, half_v in robots:
        hidden |= ((u - at_u) / half_u) ** 2 + ((v - at_v) / half_v) ** 2 < 1
    return inpaint_hidden(next(split.images([row])), hidden)


def inpaint_hidden(rgb: Rgb, hidden: NDArray[np.bool_]) -> Rgb:
    """Fill the hidden pixels of an image from their surroundings (Telea 2004).

    Parameters
    ----------
    rgb
        (H, W, 3), uint8.
    hidden
        (H, W), True where the image is painted over.

    Raises
    ------
    MissingExtra
        If OpenCV is not installed.
    """
    cv2 = load_opencv("train", "a dataset as --backgrounds")
    picture, mask = np.ascontiguousarray(rgb), hidden.astype(np.uint8)
    return np.asarray(cv2.inpaint(picture, mask, INPAINT_RADIUS_PX, cv2.INPAINT_TELEA), np.uint8)
