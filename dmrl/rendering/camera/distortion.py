"""Conversion between a distorted image and its pinhole image, and resampling."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from dmrl.errors import SettingError
from dmrl.geometry.frames import Array, Camera, is_inside
from dmrl.geometry.lens import distort, undistort

FloatImage = NDArray[np.float32]
MAX_SIDE_PX = 4096
"""Longest side of a rendered image, pixels. Four times the widest camera of small drones."""


def _focal_and_centre(camera: Camera) -> tuple[Array, Array]:
    return np.array([camera.fx_px, camera.fy_px]), np.array([camera.cx_px, camera.cy_px])


def image_from_pinhole(uv: Array, camera: Camera) -> Array:
    """Convert undistorted pixels (..., 2) to pixels of the camera's image.

    The result is NaN where the lens cannot project the point.
    """
    focal, centre = _focal_and_centre(camera)
    bent = (uv - centre) / focal
    if any(camera.distortion):
        bent, _ = distort(bent, camera.distortion)
    return np.asarray(bent * focal + centre)


def pinhole_from_image(uv: Array, camera: Camera) -> Array:
    """Convert pixels (..., 2) of the camera's image to undistorted pixels."""
    focal, centre = _focal_and_centre(camera)
    return np.asarray(undistort((uv - centre) / focal, camera.distortion) * focal + centre)


@dataclass(frozen=True, slots=True)
class PinholeCanvas:
    """Pinhole image large enough to be distorted into a camera's image.

    Parameters
    ----------
    pinhole
        Camera without distortion whose image covers the field of view of the real one.
    shift_px
        (2,) offset from undistorted pixels of the camera to pixels of the canvas.
    places_px
        (H, W, 2) place on the canvas of each pixel's centre. None where the camera has no
        distortion and both images are identical.
    inside
        (h, w) whether the real image contains a pixel of the canvas.
    """

    pinhole: Camera
    shift_px: Array
    places_px: FloatImage | None
    inside: NDArray[np.bool_]


@cache
def pinhole_canvas(camera: Camera) -> PinholeCanvas:
    """Return the canvas of a camera. The result is cached.

    Raises
    ------
    SettingError
        If its images are too large to render, or its distortion folds back before the corners.
    """
    if max(camera.width_px, camera.height_px) > MAX_SIDE_PX:
        raise SettingError(
            f"images of {camera.width_px}x{camera.height_px} px are too large to render: at most "
            f"{MAX_SIDE_PX} px a side. Use a calibration of smaller ones"
        )
    if not any(camera.distortion):
        everywhere = np.ones((camera.height_px, camera.width_px), bool)
        return PinholeCanvas(replace(camera, distortion=()), np.zeros(2), None, everywhere)
    v, u = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    places = pinhole_from_image(np.stack([u, v], axis=-1), camera)
    if np.isnan(places).any():
        raise SettingError(
            f"a lens with distortion {list(camera.distortion)} cannot fill an image of "
            f"{camera.width_px}x{camera.height_px}: it folds back before the corners. Calibrate "
            "it with boards there, or use fewer coefficients"
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
    within = is_inside(shown.reshape(-1, 2), camera.width_px, camera.height_px)
    places = (places - low).astype(np.float32)
    return PinholeCanvas(pinhole, -low, places, within.reshape(u.shape))


def sample_bilinear(picture: FloatImage, places_px: FloatImage) -> FloatImage:
    """Sample an image bilinearly. Places outside it are 0.

    Parameters
    ----------
    picture
        (h, w, C).
    places_px
        (H, W, 2) u and v, pixel-edge coordinates.

    Returns
    -------
    FloatImage
        (H, W, C).
    """
    height, width, channels = picture.shape
    padded = np.zeros((height + 2, width + 2, channels), np.float32)
    padded[1:-1, 1:-1] = picture
    places_px = np.clip(places_px + 0.5, 0, (width + 0.999, height + 0.999))
    return interpolate_bilinear(padded, places_px[..., 0], places_px[..., 1])


def interpolate_bilinear(picture: FloatImage, u_px: FloatImage, v_px: FloatImage) -> FloatImage:
    """Interpolate an image bilinearly at places relative to its first pixel's centre.

    Parameters
    ----------
    picture
        (h, w, C). Fastest with four channels.
    u_px, v_px
        (...) places from the centre of the first pixel, right and down, at least 0, left of the
        last column and above the last row.

    Returns
    -------
    FloatImage
        (..., C).
    """
    _, width, channels = picture.shape
    left, top = np.floor(u_px), np.floor(v_px)
    share_u = _repeat_last_axis(np.subtract(u_px, left, dtype=np.float32), channels)
    share_v = _repeat_last_axis(np.subtract(v_px, top, dtype=np.float32), channels)
    place = top.astype(np.intp) * width + left.astype(np.intp)
    flat = picture.reshape(-1, channels)
    above = _lerp_in_place(flat.take(place, axis=0), flat.take(place + 1, axis=0), share_u)
    place += width
    below = _lerp_in_place(flat.take(place, axis=0), flat.take(place + 1, axis=0), share_u)
    return _lerp_in_place(above, below, share_v)


def _repeat_last_axis(values: FloatImage, channels: int) -> FloatImage:
    """Repeat values for every channel. NumPy's own functions are four times slower here."""
    repeated = np.empty((*values.shape, channels), np.float32)
    for channel in range(channels):
        repeated[..., channel] = values
    return repeated


def _lerp_in_place(first: FloatImage, second: FloatImage, share: FloatImage) -> FloatImage:
    """Interpolate linearly from the first to the second, in place."""
    second -= first
    second *= share
    first += second
    return first
