"""Images with alpha, and their turning and scaling in floating point."""

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dmrl.errors import SourceError
from dmrl.guards import limits
from dmrl.images.codec import decode


def decode_with_alpha(data: bytes, name: object) -> NDArray[np.uint8]:
    """Decode an image with alpha, (H, W, 4).

    Raises
    ------
    SourceError
        If it is broken, too large, or has no alpha.
    """
    decode(data, name, limits.PIXELS)  # refuses what is broken or too large
    with Image.open(io.BytesIO(data)) as image:
        if "A" not in image.getbands() and "transparency" not in image.info:
            raise SourceError(f"{name} has no alpha. Cut the robot out and save it as PNG")
        return np.asarray(image.convert("RGBA"))


def turn_and_scale(
    picture: NDArray[np.float32],
    turn_deg: float,
    box_px: tuple[float, float, float, float],
    size_px: tuple[int, int],
) -> NDArray[np.float32]:
    """Turn an image about its middle, then average a box of it.

    Parameters
    ----------
    picture
        (H, W, C).
    turn_deg
        Turn, anticlockwise.
    box_px
        Left, top, right, bottom, pixel-edge coordinates; fractions allowed.
    size_px
        Width and height of the result.
    """
    channels = []
    for channel in np.moveaxis(picture, 2, 0):
        image = Image.fromarray(np.ascontiguousarray(channel))
        turned = image.rotate(turn_deg, Image.Resampling.BILINEAR)
        channels.append(np.asarray(turned.resize(size_px, Image.Resampling.BOX, box=box_px)))
    return np.stack(channels, axis=2)
