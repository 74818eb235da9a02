"""Fitting of a rendering preset to real images, by matching image statistics.

The statistics are measured on backdrops alone, without Blender. A small drone changes none of
them. They depend on each other, so every round moves all ranges one step towards their targets.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from dmrl.geometry.frames import Array, Camera
from dmrl.images.codec import Rgb, decode, encode_jpeg
from dmrl.rendering.backgrounds.photos import SRGB_TO_LINEAR, Photos
from dmrl.rendering.camera.image_statistics import ImageMeasurements, mean_of_figure, measure_images
from dmrl.rendering.camera.sensor import expose
from dmrl.rendering.randomise import clip_highlights, process_backdrop, random_sensor
from dmrl.rendering.settings import LIMITS, TABLE, Settings

COARSE, FINE = (8, 32), (5, 192)
"""Rounds and images of each stage: few images first, then enough to average out chance."""
ROUNDS = COARSE[0] + FINE[0]
MAX_ROUND_PIXELS = 24_000_000
"""Pixels of all images of a round, at most. Large images are fewer, but no fewer than `COARSE`."""
FOCAL_OVER_WIDTH = 0.57
"""Focal length over the image width, as the AI-deck's. It scales motion blur."""
GREY_MAX_COLOUR = 0.01
"""Colour statistic below which a camera counts as grey."""
MOSAIC_MIN_CORRELATION = 0.15
"""Noise correlation from which a Bayer mosaic is assumed."""
JPEG_QUALITIES = ((98, 100), (90, 96), (75, 90))
"""Ranges of JPEG quality. A lower quality makes coarser noise."""


@dataclass(frozen=True, slots=True)
class Knob:
    """A range of the settings and the statistic that it controls.

    Parameters
    ----------
    key, figure
        Names of the setting and of the statistic.
    by
        Scale of a step: "factor" of both, "square" of both, or "lost", where the statistic is the
        remaining share.
    gain
        Step relative to the remaining difference.
    least
        Lower bound of the fitted range, in place of that of the key. A range at 0 would never move.
    """

    key: str
    figure: str
    by: Literal["factor", "square", "lost"]
    gain: float
    least: float | None = None


KNOBS = tuple(Knob(**row) for row in TABLE["knobs"])


def sample_scenes(
    photos: Photos, settings: Settings, size_px: tuple[int, int], seed: int
) -> list[Rgb]:
    """Return crops of photos as test scenes, as many as `FINE` requires.

    Parameters
    ----------
    photos
        Rooms or photos.
    settings
        Settings with the range of zooms.
    size_px
        Width and height.
    seed
        Seed of the crops.
    """
    width_px, height_px = size_px
    camera = Camera(width_px, height_px, 1.0, 1.0, width_px / 2, height_px / 2)
    count = int(np.clip(MAX_ROUND_PIXELS // (width_px * height_px), COARSE[1], FINE[1]))
    rngs = (np.random.default_rng((seed, number, 0)) for number in range(count))
    return [photos.random_crop(rng, camera, rng.uniform(*settings.background_zoom)) for rng in rngs]


def simulate_images(settings: Settings, backdrops: Iterable[Rgb], seed: int) -> Iterator[Rgb]:
    """Yield images of the scenes as the settings' camera takes them, without robots.

    Parameters
    ----------
    settings
        Settings of the camera and the backdrops.
    backdrops
        Result of `sample_scenes`.
    seed
        Seed of the noise and of all draws.
    """
    for number, scene in enumerate(backdrops):
        rng = np.random.default_rng((seed, number, 1))
        move_px = FOCAL_OVER_WIDTH * scene.shape[1] * rng.uniform(*settings.shutter_s)
        light = process_backdrop(settings, rng, np.take(SRGB_TO_LINEAR, scene), move_px)
        rgb = expose(clip_highlights(light), random_sensor(settings, rng), rng)
        low, high = settings.jpeg_quality
        quality = int(rng.integers(low, high + 1))
        yield rgb if settings.image_format == "png" else decode(encode_jpeg(rgb, quality))


def iter_fits(
    real: ImageMeasurements, settings: Settings, backdrops: Sequence[Rgb], seed: int
) -> Iterator[Settings]:
    """Yield settings that approach the statistics of real images, one per round.

    Parameters
    ----------
    real
        Measurements of real images of one camera.
    settings
        Settings to start from.
    backdrops
        Result of `sample_scenes`, as a substitute for the real scenes.
    seed
        Seed of all draws.
    """
    settings = _detect_camera_type(settings, real)
    for turn in range(COARSE[0] + FINE[0]):  # with the same draws, so that steps are comparable
        count = COARSE[1] if turn < COARSE[0] else FINE[1]
        have = measure_images(simulate_images(settings, backdrops[:count], seed))
        settings = _step_ranges(settings, real, have)
        if settings.image_format == "jpeg" and turn == COARSE[0] // 2:
            settings = replace(settings, jpeg_quality=_select_quality(settings, real, have))
        yield settings


def _detect_camera_type(settings: Settings, real: ImageMeasurements) -> Settings:
    """Return settings with the camera's type: colour or grey, with or without a Bayer mosaic."""
    colour, correlation = (
        real.figure_mean(name) or 0.0 for name in ("colour", "grain_correlation")
    )
    if colour < GREY_MAX_COLOUR:
        settings = replace(settings, bayer=False, saturation=(0.0, 0.0), warmth=(1.0, 1.0))
        return replace(
            settings, image_format="png" if correlation < MOSAIC_MIN_CORRELATION else "jpeg"
        )
    return replace(settings, bayer=correlation > MOSAIC_MIN_CORRELATION, image_format="jpeg")


def _step_ranges(settings: Settings, real: ImageMeasurements, have: ImageMeasurements) -> Settings:
    """Return settings whose ranges are one step closer to their targets, in middle and width."""
    changed: dict[str, Any] = {}
    for knob in KNOBS:
        if knob.key in ("saturation", "warmth") and settings.saturation[1] == 0:
            continue
        limits = getattr(settings, knob.key)
        changed[knob.key] = _step_range(
            knob, limits, real.figure_values(knob.figure), have.figure_values(knob.figure)
        )
    return replace(settings, **changed)


def _step_range(
    knob: Knob, limits: tuple[float, float], want: Array, got: Array
) -> tuple[float, float]:
    """Return a range after one step: shifted by the difference, widened by the ratio of spreads."""
    if not len(want) or not len(got):
        return limits
    least, most = LIMITS[knob.key]
    least = max(least, knob.least or 0.0)
    wanted, found = (max(mean_of_figure(knob.figure, values), 1e-3) for values in (want, got))
    ends = np.clip(limits, max(least, 0.02 if knob.least is None else knob.least), most)
    if knob.by == "factor":
        want, got = np.log(np.maximum(want, 1e-3)), np.log(np.maximum(got, 1e-3))
        bounds = np.log([max(least, 1e-9), most])
        ends = np.log(ends) + knob.gain * np.log(wanted / found)
    elif knob.by == "lost":
        ends, bounds = 1 - (1 - ends) * (wanted / found) ** knob.gain, np.array([least, most])
    else:
        ends = np.sqrt(np.maximum(ends**2 + knob.gain * (wanted**2 - found**2), 0.0))
        bounds = np.array([least, most])
    spread = np.clip(float(want.std() / max(got.std(), 1e-3)), 0.8, 1.15)
    middle = np.clip(ends.mean(), *bounds)
    # Symmetric about the middle: clipping one end alone would move the middle back.
    half = min(np.ptp(ends) / 2 * spread, *np.abs(bounds - middle))
    low, high = np.clip([middle - half, middle + half], *bounds)
    if knob.by == "factor":
        low, high = np.clip(np.exp([low, high]), least, most)
    return float(low), float(high)


def _select_quality(
    settings: Settings, real: ImageMeasurements, have: ImageMeasurements
) -> tuple[int, int]:
    """Return the next lower quality where the noise correlates less than 1/1.2 of the real one."""
    want, got = (one.figure_mean("grain_correlation") or 0.0 for one in (real, have))
    known = settings.jpeg_quality in JPEG_QUALITIES
    at = JPEG_QUALITIES.index(settings.jpeg_quality) if known else 0
    return JPEG_QUALITIES[min(at + (want > 1.2 * got), len(JPEG_QUALITIES) - 1)]
