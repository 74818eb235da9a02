"""A camera's image, the pinhole image behind it, and resampling from one to the other."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from dmrl.errors import SettingError
from dmrl.geometry.frames import Array, Camera, inside
from dmrl.geometry.lens import distort, undistort

Picture = NDArray[np.float32]
LONGEST_SIDE_PX = 4096
"""Of an image to render: four times the widest camera's that a small drone carries."""


def _scale(camera: Camera) -> tuple[Array, Array]:
    return np.array([camera.fx_px, camera.fy_px]), np.array([camera.cx_px, camera.cy_px])


def image_from_pinhole(uv: Array, camera: Camera) -> Array:
    """(..., 2) pixels in the camera's image from those that it would have without distortion.

    NaN where the lens shows nothing.
    """
    focal, centre = _scale(camera)
    bent, _ = distort((uv - centre) / focal, camera.distortion)
    return np.asarray(bent * focal + centre)


def pinhole_from_image(uv: Array, camera: Camera) -> Array:
    """(..., 2) pixels that the camera would have without distortion, from those it has."""
    focal, centre = _scale(camera)
    return np.asarray(undistort((uv - centre) / focal, camera.distortion) * focal + centre)


@dataclass(frozen=True, slots=True)
class Canvas:
    """A pinhole image large enough to be bent into a camera's image.

    Parameters
    ----------
    pinhole
        Camera without distortion; its image covers what the real one sees.
    shift_px
        (2,) what pixels of the canvas are more than undistorted pixels of the camera.
    places_px
        (H, W, 2) where each pixel's centre of the real image lies on the canvas; None where
        the camera has no distortion and the two are the same.
    inside
        (h, w) whether the real image shows a pixel of the canvas.
    """

    pinhole: Camera
    shift_px: Array
    places_px: Picture | None
    inside: NDArray[np.bool_]


@cache
def canvas_of(camera: Camera) -> Canvas:
    """The canvas of a camera, worked out once.

    Raises
    ------
    SettingError
        If its images are too large to render, or its distortion folds them back before their
        corners.
    """
    if max(camera.width_px, camera.height_px) > LONGEST_SIDE_PX:
        raise SettingError(
            f"images of {camera.width_px}x{camera.height_px} px are too large to render: at most "
            f"{LONGEST_SIDE_PX} px a side. Give a calibration of smaller ones"
        )
    if not any(camera.distortion):
        everywhere = np.ones((camera.height_px, camera.width_px), bool)
        return Canvas(replace(camera, distortion=()), np.zeros(2), None, everywhere)
    v, u = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    places = pinhole_from_image(np.stack([u, v], axis=-1), camera)
    if np.isnan(places).any():
        raise SettingError(
            f"a lens with distortion {list(camera.distortion)} cannot fill an image of "
            f"{camera.width_px}x{camera.height_px}: it folds back before the corners. Calibrate "
            "it with boards there, or give fewer coefficients"
        )
    low = np.minimum(np.floor(places.min(axis=(0, 1))) - 2, 0)
    high = np.ceil(places.max(axis=(0, 1))) + 2
    width, height = np.maximum(high, (camera.width_px, camera.height_px)) - low
    pinhole = replace(
        camera,
        width_px=int(width),
        height_px=int(height),
        cx_px=camera.cx_px - low[0],
        cy_px=camera.cy_px - low[1],
        distortion=(),
    )
    v, u = np.mgrid[: pinhole.height_px, : pinhole.width_px] + 0.5
    shown = image_from_pinhole(np.stack([u, v], axis=-1) + low, camera)
    within = inside(shown.reshape(-1, 2), camera.width_px, camera.height_px)
    places = (places - low).astype(np.float32)
    return Canvas(pinhole, -low, places, within.reshape(u.shape))


def sample(picture: Picture, places_px: Picture) -> Picture:
    """(H, W, C) picture at places between its pixels, bilinear; nothing outside it.

    Parameters
    ----------
    picture
        (h, w, C).
    places_px
        (H, W, 2) u and v in the picture, pixel-edge coordinates.
    """
    height, width, channels = picture.shape
    padded = np.zeros((height + 2, width + 2, channels), np.float32)
    padded[1:-1, 1:-1] = picture
    return between(padded, np.clip(places_px + 0.5, 0, (width + 0.999, height + 0.999)))


def between(picture: Picture, places_px: Picture, *, around: bool = False) -> Picture:
    """(H, W, C) picture at places between its pixels' centres, bilinear.

    Parameters
    ----------
    picture
        (h, w, C).
    places_px
        (H, W, 2) from the centre of the first pixel, right and down, above the last row.
    around
        Whether the first column follows the last; else places are left of the last column.
    """
    _, width, channels = picture.shape
    corner = np.floor(places_px).astype(np.intp)
    share = np.subtract(places_px, corner, dtype=np.float32)
    share_u, share_v = share[..., :1], share[..., 1:]
    column, row = corner[..., 0], corner[..., 1] * width
    left, right = (column % width, (column + 1) % width) if around else (column, column + 1)
    flat = picture.reshape(-1, channels)
    above = _mixed(flat.take(row + left, axis=0), flat.take(row + right, axis=0), share_u)
    row += width
    below = _mixed(flat.take(row + left, axis=0), flat.take(row + right, axis=0), share_u)
    return _mixed(above, below, share_v)


def _mixed(first: Picture, second: Picture, share: Picture) -> Picture:
    """The first, into which a share of the second is mixed, in its place in memory."""
    second -= first
    second *= share
    first += second
    return first
