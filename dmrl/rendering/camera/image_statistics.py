"""Image statistics that compare the cameras of real and rendered images.

All statistics refer to the stored pixels. None needs a target, a known scene or a label. They
compare sets of images and do not calibrate a camera.
"""

from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array
from dmrl.images.codec import Rgb
from dmrl.rendering.camera.distortion import FloatImage
from dmrl.rendering.camera.sensor import radius_squared
from dmrl.rendering.camera.sensor_noise import estimate_noise, measure_blocks

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
EDGE_REACH_PX = 4
"""Search range for an edge, pixels to either side."""
EDGE_SHARE = 0.02
"""Share of the pixels that count as edges: those with the largest step across."""
CORNER_RADIUS2, MIDDLE_RADIUS2 = 0.7, 0.1
"""Squared radii that bound the corners and the middle. The radius is 1 in the corners."""


@dataclass(frozen=True, slots=True)
class ImageStatistics:
    """Mean statistics of a set of images. None where the images do not determine one.

    Parameters
    ----------
    brightness
        Mean luma, 0 to 1.
    contrast
        Standard deviation of luma over its mean.
    cast
        Mean red over mean blue. Above 1 is warm.
    colour
        Standard deviation of red minus blue, each over its mean. 0 for a grey camera.
    edge_px
        Step across an edge over its steepest slope, pixels.
    corners
        Luma of the corners over that of the middle, of all images together.
    grain
        Standard deviation of luma in smooth areas, levels of 256. Dark, grey and bright areas have
        equal weight.
    grain_correlation
        Correlation of the noise of neighbouring pixels. 0 for white noise.
    """

    brightness: float | None
    contrast: float | None
    cast: float | None
    colour: float | None
    edge_px: float | None
    corners: float | None
    grain: float | None
    grain_correlation: float | None


FIGURES = tuple(field.name for field in fields(ImageStatistics))
IMAGE_FIGURES = FIGURES[:5]
"""Statistics that a single image has."""
RATIOS = ("contrast", "cast", "edge_px")


@dataclass(frozen=True, slots=True)
class ImageMeasurements:
    """Measurements of a set of images.

    Parameters
    ----------
    rows
        (N, 5) `IMAGE_FIGURES` of every image, NaN where they are undetermined.
    corners
        (N, 2) luma of the corners and of the middle.
    blocks
        (M, 4) of all images, see `dmrl.rendering.camera.sensor_noise`.
    """

    rows: Array
    corners: Array
    blocks: NDArray[np.float32]

    def figure_values(self, figure: str) -> Array:
        """Return (N,) determined values of a statistic of images, or (1,) of one of the set."""
        if figure in IMAGE_FIGURES:
            column = self.rows[:, IMAGE_FIGURES.index(figure)]
        elif figure == "corners":
            corner, middle = self.corners.mean(axis=0)
            column = np.array([corner / max(middle, 1.0)])
        else:
            column = np.array([getattr(estimate_noise(self.blocks), figure)])
        return np.asarray(column[np.isfinite(column)])

    def figure_mean(self, figure: str) -> float | None:
        """Return the mean over images, geometric for ratios."""
        found = self.figure_values(figure)
        return mean_of_figure(figure, found) if len(found) else None

    def to_statistics(self) -> ImageStatistics:
        """Return all statistics."""
        return ImageStatistics(*(self.figure_mean(figure) for figure in FIGURES))


def mean_of_figure(figure: str, values: Array) -> float:
    """Return the mean of a statistic's values, geometric for ratios.

    Parameters
    ----------
    figure
        One of `FIGURES`.
    values
        (N,) values of N images, at least one.
    """
    if figure in RATIOS:
        return float(np.exp(np.log(np.maximum(values, 1e-3)).mean()))
    return float(values.mean())


def measure_images(pictures: Iterable[Rgb]) -> ImageMeasurements:
    """Measure images.

    Parameters
    ----------
    pictures
        (H, W, 3) uint8 each, larger than 16 px. At least one.
    """
    rows, corners, blocks = [], [], []
    for picture in pictures:
        levels = picture.astype(np.float32)
        luma: FloatImage = levels @ LUMA
        rows.append(_measure_image(levels, luma))
        corners.append(_measure_corners(luma))
        blocks.append(measure_blocks(luma))
    return ImageMeasurements(np.array(rows), np.array(corners), np.concatenate(blocks))


def _measure_image(levels: FloatImage, luma: FloatImage) -> list[float]:
    """Return `IMAGE_FIGURES` of one image."""
    mean = max(float(luma.mean()), 1.0)
    red, blue = (levels[..., k] / max(float(levels[..., k].mean()), 1.0) for k in (0, 2))
    cast = max(float(levels[..., 0].mean()), 1.0) / max(float(levels[..., 2].mean()), 1.0)
    colour = float((red - blue).std())
    return [mean / 255, float(luma.std()) / mean, cast, colour, _edge_width_px(luma)]


def _edge_width_px(luma: FloatImage) -> float:
    """Return the median width of the strongest edges, across and down, or NaN without any."""
    steps, slopes = [], []
    for lines in (luma, luma.T):
        step = np.abs(lines[:, 2 * EDGE_REACH_PX :] - lines[:, : -2 * EDGE_REACH_PX])
        slope = np.abs(np.diff(lines, axis=1))
        for reach in (1, 2, 4):  # the steepest of two, of four, of eight
            slope = np.maximum(slope[:, reach:], slope[:, :-reach])
        steps.append(step.ravel())
        slopes.append(slope.ravel())
    step, steep = np.concatenate(steps), np.concatenate(slopes)
    strong = step >= np.quantile(step, 1 - EDGE_SHARE)
    if not step[strong].min() > 0:
        return np.nan
    return float(np.median(step[strong] / steep[strong]))


def _measure_corners(luma: FloatImage) -> list[float]:
    """Return the luma of the corners and of the middle."""
    radius2 = radius_squared(*luma.shape)
    return [
        float(luma[part].mean()) for part in (radius2 > CORNER_RADIUS2, radius2 < MIDDLE_RADIUS2)
    ]
