"""Backdrops from photos."""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.random import Generator

from dmrl.errors import SettingError, SourceError
from dmrl.geometry.frames import Camera
from dmrl.guards import limits
from dmrl.guards.paths import refuse_pipes
from dmrl.images.codec import Rgb, crop_and_scale, decode, read_size
from dmrl.rendering.camera.distortion import FloatImage
from dmrl.rendering.camera.sensor import LUMINANCE

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".ppm", ".pgm")
MAX_CACHED_PHOTOS = 64
"""Decoded photos in the cache. Bounds the memory."""


def _srgb_table() -> FloatImage:
    """Return the linear light of the 256 values of an sRGB photo."""
    value = np.arange(256) / 255
    low = value <= 0.04045
    return np.where(low, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


SRGB_TO_LINEAR = _srgb_table()


class Photos:
    """Photos that are cropped to fill an image.

    Parameters
    ----------
    load
        Returns the photo with an index, from 0. Raises SourceError if it is broken.
    count
        Number of photos.
    broken
        Number of broken photos that are not counted in ``count``.
    """

    def __init__(self, load: Callable[[int], Rgb], count: int, broken: int = 0) -> None:
        self._count, self._left_out = count, broken
        self._broken: set[int] = set()
        self._load = lru_cache(MAX_CACHED_PHOTOS)(load)

    @property
    def broken(self) -> int:
        """Number of broken photos detected so far."""
        return self._left_out + len(self._broken)

    def load_photo(self, number: int) -> Rgb:
        """Return the photo with this index, or the next one that is not broken.

        Raises
        ------
        SettingError
            If all photos are broken.
        """
        for step in range(self._count):
            here = (number + step) % self._count
            if here in self._broken:
                continue
            try:
                return self._load(here)
            except SourceError:
                self._broken.add(here)
        raise SettingError("every photo is broken. Use another --backgrounds")

    def random_backdrop(
        self, rng: Generator, camera: Camera, zoom: float, *, averaged: bool = True
    ) -> FloatImage:
        """Return a random crop as (H, W, 3) linear light, see `random_crop`."""
        return np.take(SRGB_TO_LINEAR, self.random_crop(rng, camera, zoom, averaged=averaged))

    def random_crop(
        self, rng: Generator, camera: Camera, zoom: float, *, averaged: bool = True
    ) -> Rgb:
        """Return a random (H, W, 3) uint8 crop of a random photo that fills the image.

        Parameters
        ----------
        rng
            Selects the photo, the crop, and whether it is mirrored.
        camera
            Camera with the size of the image.
        zoom
            1: as much of the photo as fits. 2: half its width and height.
        averaged
            Whether a pixel averages the photo's pixels that it covers, or takes the middle one.
        """
        number, place_u, place_v, mirrored = rng.random(4)
        photo = self.load_photo(int(number * self._count))
        height, width, _ = photo.shape
        fit = min(width / camera.width_px, height / camera.height_px) / zoom
        part_u, part_v = camera.width_px * fit, camera.height_px * fit
        left, top = (width - part_u) * place_u, (height - part_v) * place_v
        box = (left, top, left + part_u, top + part_v)
        if averaged:
            rgb = crop_and_scale(photo, box, camera.width_px, camera.height_px, sharp=False)
        else:
            rgb = _sample_middles(photo, (left, top), fit, camera)
        return rgb[:, ::-1] if mirrored < 0.5 else rgb


def open_photos(folder: Path) -> Photos:
    """Open all photos of a folder, in the order of their names.

    Raises
    ------
    SettingError
        If the folder does not exist or contains no readable photo.
    """
    if not folder.is_dir():
        raise SettingError(f"no folder {folder} of backgrounds. Check --backgrounds")
    refuse_pipes(folder)
    found = sorted(p for p in folder.iterdir() if p.suffix.lower() in PHOTO_SUFFIXES)
    paths = [path for path in found if _has_valid_header(path)]
    broken = len(found) - len(paths)
    if not paths:
        why = f", {broken} are broken" if broken else ""
        raise SettingError(
            f"{folder} contains no readable photo{why} "
            f"({', '.join(PHOTO_SUFFIXES)}). Use another --backgrounds"
        )

    def load_photo(k: int) -> Rgb:
        return decode(paths[k].read_bytes(), paths[k], limits.PIXELS)

    return Photos(load_photo, len(paths), broken)


def _sample_middles(photo: Rgb, corner: tuple[float, float], fit: float, camera: Camera) -> Rgb:
    """Return a crop of a photo, sampled at the middles of pixels ``fit`` wide."""
    height, width, _ = photo.shape
    limits = zip(corner, (camera.width_px, camera.height_px), (width, height), strict=True)
    u, v = (
        np.clip(first + (np.arange(count) + 0.5) * fit, 0, size - 1).astype(int)
        for first, count, size in limits
    )
    return np.asarray(photo[v].take(u, axis=1), np.uint8)


def _has_valid_header(path: Path) -> bool:
    try:
        read_size(path.read_bytes(), path)
    except (SourceError, OSError):
        return False
    return True


def stretch_contrast(light: FloatImage, power: float) -> FloatImage:
    """Return (H, W, 3) light with its brightness raised to a power, at the same mean.

    Parameters
    ----------
    light
        (H, W, 3) linear light, not modified.
    power
        Above 1, the contrast increases. Below 1, it decreases.
    """
    luminance = light @ LUMINANCE
    mean = max(float(luminance.mean()), 1e-6)
    share = np.power(np.maximum(luminance / mean, 1e-4), np.float32(power - 1))
    other: FloatImage = light * share[..., None]
    other *= np.float32(mean / max(float((other @ LUMINANCE).mean()), 1e-6))
    return other


def apply_motion_blur(picture: FloatImage, move_px: Sequence[float]) -> FloatImage:
    """Return the (H, W, 3) image blurred by a motion in u and v during the exposure, pixels."""
    steps = int(np.ceil(math.hypot(*move_px)))
    if steps < 1:
        return picture
    shares = np.linspace(-0.5, 0.5, steps + 1)
    shifts = np.round(np.outer(shares, move_px)).astype(int)
    pad = int(np.abs(shifts).max())
    wide = np.pad(picture, ((pad, pad), (pad, pad), (0, 0)), mode="edge")
    height, width, _ = picture.shape
    total = np.zeros_like(picture)
    for u, v in shifts:
        total += wide[pad - v : pad - v + height, pad - u : pad - u + width]
    return np.asarray(total / np.float32(len(shifts)), np.float32)
