"""Sensor model of a small camera, from light to bytes: lens, Bayer mosaic, noise, exposure."""

from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, gaussian_filter1d

from dmrl.images.bayer import to_bayer
from dmrl.rendering.camera.distortion import FloatImage

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
VALUE_BINS = 4096
"""Bins of a value from 0 to 1. None has two levels' limits, for a gamma of 0.5 to 3."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """Response of a camera in one image.

    Parameters
    ----------
    brightness
        Target of automatic exposure: mean of the image, 0 to 1, before vignetting. None: a fixed
        exposure, where light of 1 is full scale.
    contrast_gamma
        1: values are proportional to light, as of raw sensors. 2.2: as screens expect.
    balance
        Red, green and blue gains.
    saturation
        1: unchanged colours. 0: grey; without a mosaic, a grey camera with three equal channels.
        Small sensors have poor colour filters.
    vignetting
        Light lost in the farthest corner, 0 to 1.
    defocus_px
        Standard deviation of the lens' blur, pixels.
    bayer
        Whether each pixel measures one colour and the others are interpolated.
    shot_noise
        Variance of the noise per unit of light. Full scale is 1.
    read_noise
        Standard deviation of the noise in the dark. Full scale is 1.
    """

    brightness: float | None = 0.4
    contrast_gamma: float = 2.2
    balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    saturation: float = 1.0
    vignetting: float = 0.0
    defocus_px: float = 0.0
    bayer: bool = False
    shot_noise: float = 0.0
    read_noise: float = 0.0


def expose(light: FloatImage, sensor: Sensor, rng: Generator) -> NDArray[np.uint8]:
    """Convert linear light to an (H, W, 3) uint8 image.

    Parameters
    ----------
    light
        (H, W, 3) linear, any scale, not modified.
    sensor
        Response of the camera.
    rng
        Random generator of the noise.
    """
    gain = np.array(sensor.balance, np.float32)
    if sensor.brightness is not None:
        target = sensor.brightness**sensor.contrast_gamma
        gain *= np.float32(target / max(float((light @ LUMINANCE).mean()), 1e-6))
    height, width, _ = light.shape
    values = gaussian_blur(_mix_channels(light, sensor.saturation), sensor.defocus_px)
    # Row by row: NumPy is ten times slower where the innermost axis is three colours.
    values = (values.reshape(height, -1) * np.tile(gain, width)).reshape(light.shape)
    if sensor.bayer:
        values = to_bayer(values)
    if sensor.vignetting > 0:
        distance = radius_squared(height, width).astype(np.float32)
        falloff = 1 - np.float32(sensor.vignetting) * distance
        values *= falloff if sensor.bayer else falloff[..., None]
    grey = sensor.saturation == 0 and not sensor.bayer  # one value and one noise per pixel
    values = _add_noise(values[..., :1].copy() if grey else values, sensor, rng)
    if sensor.bayer:
        values = demosaic(values)
    elif grey:
        values = values.repeat(3, axis=2)
    return _quantize(values, sensor.contrast_gamma)


def _quantize(values: FloatImage, gamma: float) -> NDArray[np.uint8]:
    """Round values from 0 to 1, to the power of 1 / gamma, to 256 levels.

    A value is compared with a single threshold, the one in its bin. A power takes twice as long,
    and its last bits depend on the C library and on the processor.
    """
    levels_of_bins, thresholds = _tabulate_levels(gamma)
    bins = _find_bins(values)
    levels = levels_of_bins.take(bins)
    levels += values >= thresholds.take(bins)
    return levels


@lru_cache(64)
def _tabulate_levels(gamma: float) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return the level at the start of each bin, and the value in it where the next one starts."""
    steps = (((np.arange(255) + 0.5) / 255) ** gamma).astype(np.float32)
    bins = _find_bins(steps)
    levels = np.searchsorted(bins, np.arange(VALUE_BINS + 1)).astype(np.uint8)
    thresholds = np.full(VALUE_BINS + 1, np.inf, np.float32)
    thresholds[bins] = steps
    return levels, thresholds


def _find_bins(values: FloatImage) -> NDArray[np.intp]:
    """Return the bins of values, equally spaced by their square roots: dark levels are narrow."""
    places = np.sqrt(values)
    places *= np.float32(VALUE_BINS)
    return places.astype(np.intp)


def _mix_channels(light: FloatImage, saturation: float) -> FloatImage:
    if saturation == 1:
        return light
    mix = np.float32(saturation) * np.eye(3, dtype=np.float32)
    mix += np.float32(1 - saturation) * LUMINANCE
    return light @ mix.T


def _add_noise(values: FloatImage, sensor: Sensor, rng: Generator) -> FloatImage:
    """Clip values to 0 to 1 and add noise, in place."""
    np.clip(values, 0, 1, out=values)
    if sensor.shot_noise or sensor.read_noise:
        spread = np.sqrt(values * np.float32(sensor.shot_noise) + np.float32(sensor.read_noise**2))
        values += spread * rng.standard_normal(values.shape, np.float32)
        np.clip(values, 0, 1, out=values)
    return values


@cache
def radius_squared(height: int, width: int) -> NDArray[np.float64]:
    """Return the squared distance from the middle, 1 in the corners."""
    v, u = np.mgrid[:height, :width] + 0.5
    return np.asarray(((u / width * 2 - 1) ** 2 + (v / height * 2 - 1) ** 2) / 2)


def gaussian_blur(picture: FloatImage, sigma_px: float) -> FloatImage:
    """Apply a Gaussian blur to an (H, W, C) image. Its edges are extended."""
    if sigma_px < 0.2:
        return picture
    reach = int(np.ceil(2.5 * sigma_px))
    for axis in (0, 1):
        picture = gaussian_filter1d(picture, sigma_px, axis, mode="nearest", radius=reach)
    return picture


def demosaic(raw: FloatImage) -> FloatImage:
    """Interpolate an (H, W, 3) image from a Bayer mosaic, linearly per colour."""
    out = np.zeros((*raw.shape, 3), np.float32)
    green = raw.copy()
    for channel, first in ((0, 0), (2, 1)):
        places = np.s_[first::2, first::2]
        out[..., channel][places], green[places] = raw[places], 0
        for axis in (0, 1):
            correlate1d(out[..., channel], (0.5, 1, 0.5), axis, out[..., channel], mode="mirror")
    beside = (correlate1d(green, (0.25, 0, 0.25), axis, mode="mirror") for axis in (0, 1))
    out[..., 1] = green + sum(beside)
    return out
