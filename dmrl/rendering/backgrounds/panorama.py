"""Backdrops from panoramas: light from all directions, seen by a camera."""

from functools import cache

import numpy as np

from dmrl.geometry.frames import Array, Camera
from dmrl.geometry.lens import undistort
from dmrl.rendering.camera.distortion import FloatImage, interpolate_bilinear

ARCTAN_TERMS = (-0.01172120, 0.05265332, -0.11643287, 0.19354346, -0.33262347, 0.99997726)
"""Of the arctangent from -1 to 1, by odd powers from the 11th to the first, within 2e-6."""
BLOCK_PX = 8192
"""Pixels that are computed together. Their arrays stay in the processor's cache."""


class Panorama:
    """Light from all directions.

    Parameters
    ----------
    light
        (h, w, 3) linear light. The middle column points along -x, the top row up.
    """

    def __init__(self, light: FloatImage) -> None:
        # Around: the last column also before the first, and the first after the last. NumPy takes
        # pixels of four channels six times as fast as those of three.
        height, width, _ = light.shape
        self._padded = np.zeros((height, width + 2, 4), np.float32)
        for channel in range(3):
            self._padded[:, 1:-1, channel] = light[..., channel]
        self._padded[:, 0], self._padded[:, -1] = self._padded[:, -2], self._padded[:, 1]

    @property
    def light(self) -> FloatImage:
        """(h, w, 3) linear light."""
        return self._padded[:, 1:-1, :3]

    def render(self, camera: Camera, turn_rad: tuple[float, float, float]) -> FloatImage:
        """Return the (H, W, 3) linear light in a camera's view.

        Parameters
        ----------
        camera
            Camera with its distortion.
        turn_rad
            Roll and pitch of the camera, and the panorama's rotation about the vertical.
        """
        rays = _panorama_from_camera(turn_rad).astype(np.float32) @ _camera_rays(camera)
        view = np.empty((rays.shape[1], 3), np.float32)
        for first in range(0, len(view), BLOCK_PX):
            block = slice(first, first + BLOCK_PX)
            seen = interpolate_bilinear(self._padded, *self._find_places(rays[:, block]))
            for channel in range(3):
                view[block, channel] = seen[:, channel]
        return view.reshape(camera.height_px, camera.width_px, 3)

    def _find_places(self, rays: FloatImage) -> tuple[FloatImage, FloatImage]:
        """Return the places of (3, N) rays, right and down from the first padded pixel's centre."""
        height, width, _ = self.light.shape
        azimuth, elevation = find_angles(rays)
        azimuth *= np.float32(-width / (2 * np.pi))
        azimuth += np.float32(width / 2 + 0.5)
        elevation *= np.float32(-height / np.pi)
        elevation += np.float32(height / 2 - 0.5)
        return azimuth, np.clip(elevation, 0, height - 1.001, out=elevation)


def find_angles(rays: FloatImage) -> FloatImage:
    """Return (2, N) the azimuth and the elevation of rays, within 1e-5 of ``np.arctan2``.

    NumPy's takes three times as long, and its last bits depend on the C library and on the
    processor. Those of sums, products, quotients and roots do not.

    Parameters
    ----------
    rays
        (3, N) unit vectors.
    """
    x, y, _ = rays
    level = np.sqrt(x * x + y * y)
    halves = np.empty((2, len(x)), np.float32)  # tangents of half the angles, from -1 to 1
    np.add(level, np.abs(x), out=halves[0])
    np.maximum(halves[0], np.finfo(np.float32).tiny, out=halves[0])
    np.add(level, 1, out=halves[1])
    np.divide(rays[1:], halves, out=halves)
    squares = halves * halves
    angles = squares * np.float32(2 * ARCTAN_TERMS[0])
    for term in ARCTAN_TERMS[1:-1]:
        angles += np.float32(2 * term)
        angles *= squares
    angles += np.float32(2 * ARCTAN_TERMS[-1])
    angles *= halves
    angles[0] = np.where(x < 0, np.copysign(np.float32(np.pi), y) - angles[0], angles[0])
    return angles


@cache
def _camera_rays(camera: Camera) -> FloatImage:
    """Return the (3, H * W) rays of all pixels, unit vectors in the camera frame."""
    v, u = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    right = (u - camera.cx_px) / camera.fx_px
    down = (v - camera.cy_px) / camera.fy_px
    x, y = np.moveaxis(undistort(np.stack([right, down], axis=-1), camera.distortion), 2, 0)
    rays = np.stack([np.ones_like(u), -x, -y]).reshape(3, -1)
    return np.asarray(rays / np.linalg.norm(rays, axis=0), np.float32)


def _panorama_from_camera(turn_rad: tuple[float, float, float]) -> Array:
    """Return Rz(turn) Ry(pitch) Rx(roll), the order of Blender's XYZ angles."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(turn_rad), np.sin(turn_rad)
    tilt = np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])
    return np.asarray(np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]]) @ tilt)
