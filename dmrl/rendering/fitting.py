"""A preset whose renders look like one's own frames: each range follows the figure that it moves.

Pictures are taken of backdrops alone, without Blender: the sensor makes cast, grain, blur and the
rest, and a small drone changes none of them. What the figures measure hangs together, so all ranges
go a step towards what they lack, again and again.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from dmrl.geometry.frames import Array, Camera
from dmrl.images.codec import Rgb, decode, encode_jpeg
from dmrl.rendering.backdrops import Photos
from dmrl.rendering.likeness import FIGURES, mean_of, of_one
from dmrl.rendering.randomise import random_sensor
from dmrl.rendering.sensor import blur, expose
from dmrl.rendering.settings import LIMITS, Settings

ROUNDS, PICTURES = 12, 32
GREY = 0.01
"""Colour under which a camera is grey."""
QUALITIES = ((98, 100), (90, 96), (75, 90))
"""Of JPEG: the worse, the coarser its grain."""


@dataclass(frozen=True, slots=True)
class Knob:
    """A range of the settings and the figure that it moves.

    Parameters
    ----------
    key, figure
        Their names.
    by
        What a step is in: "factor" of both, "square" of both, or "lost", of which the figure
        is what is left.
    gain
        Of a step, over what the figure lacks.
    """

    key: str
    figure: str
    by: Literal["factor", "square", "lost"]
    gain: float


KNOBS = (
    Knob("brightness", "brightness", "factor", 0.8),
    Knob("contrast_gamma", "contrast", "factor", -0.5),
    Knob("warmth", "cast", "factor", 1.4),
    Knob("saturation", "colour", "factor", 0.7),
    Knob("vignetting", "corners", "lost", 0.7),
    Knob("defocus_px", "edge_px", "square", 0.12),
    Knob("read_noise", "grain", "factor", 0.8),
    Knob("shot_noise", "grain", "factor", 1.6),
)
LEAST = {"read_noise": 2e-4, "shot_noise": 1e-6, "saturation": 0.02, "vignetting": 0.0}
"""Of a range that is multiplied: from 0 it would never move."""


def pictures(
    settings: Settings, photos: Photos, size_px: tuple[int, int], seed: int
) -> Iterator[Rgb]:
    """`PICTURES` of backdrops as the settings' camera takes them, without robots.

    Parameters
    ----------
    settings
        Of the camera and the backdrops.
    photos
        What is pictured.
    size_px
        Width and height.
    seed
        Another seed, other pictures.
    """
    width_px, height_px = size_px
    camera = Camera(width_px, height_px, 1.0, 1.0, width_px / 2, height_px / 2)
    for number in range(PICTURES):
        rng = np.random.default_rng((seed, number))
        backdrop = photos.backdrop(rng, camera, rng.uniform(*settings.background_zoom))
        backdrop = blur(backdrop, rng.uniform(*settings.background_blur_px))
        rgb = expose(backdrop, random_sensor(settings, rng), rng)
        low, high = settings.jpeg_quality
        quality = int(rng.integers(low, high + 1))
        yield rgb if settings.image_format == "png" else decode(encode_jpeg(rgb, quality))


def fitted(real: Sequence[Rgb], settings: Settings, photos: Photos, seed: int = 0) -> Settings:
    """Settings whose pictures have the figures of real frames.

    Parameters
    ----------
    real
        (H, W, 3) uint8, frames of one camera.
    settings
        To start from.
    photos
        What stands for the scene.
    seed
        Of what is drawn.
    """
    height_px, width_px, _ = real[0].shape
    size_px = (width_px, height_px)
    wanted = np.array([of_one(rgb) for rgb in real])
    settings = _kind(settings, wanted)
    for turn in range(ROUNDS):  # of the same draws, so that a step is not chance
        have = np.array([of_one(rgb) for rgb in pictures(settings, photos, size_px, seed)])
        settings = _step(settings, wanted, have, turn)
    return settings


def _kind(settings: Settings, wanted: Array) -> Settings:
    """With or without colours, and a mosaic before the pixels where there is one."""
    colour, correlation = (_middle(wanted, name) for name in ("colour", "grain_correlation"))
    if colour < GREY:
        settings = replace(settings, bayer=False, saturation=(0.0, 0.0), warmth=(1.0, 1.0))
        return replace(settings, image_format="png" if correlation < 0.1 else "jpeg")
    return replace(settings, bayer=correlation > 0.15, image_format="jpeg")


def _step(settings: Settings, wanted: Array, have: Array, turn: int) -> Settings:
    """Settings with every range nearer to what its figure lacks, in its middle and its width."""
    changed: dict[str, Any] = {}
    for knob in KNOBS:
        if knob.key in ("saturation", "warmth") and settings.saturation[1] == 0:
            continue
        want, got = (_column(rows, knob.figure) for rows in (wanted, have))
        changed[knob.key] = _moved(knob, getattr(settings, knob.key), want, got)
    if settings.image_format == "jpeg" and turn == ROUNDS // 2:
        changed["jpeg_quality"] = _quality(settings, wanted, have)
    return replace(settings, **changed)


def _quality(settings: Settings, wanted: Array, have: Array) -> tuple[int, int]:
    """The next worse quality where the grain is finer than it should be by a fifth."""
    want, got = (_middle(rows, "grain_correlation") for rows in (wanted, have))
    at = QUALITIES.index(settings.jpeg_quality) if settings.jpeg_quality in QUALITIES else 0
    return QUALITIES[min(at + (want > 1.2 * got), len(QUALITIES) - 1)]


def _moved(knob: Knob, limits: tuple[float, float], want: Array, got: Array) -> tuple[float, float]:
    """A range a step on: shifted by what the figure lacks, widened by how far it spreads."""
    least, most = LIMITS[knob.key]
    least = max(least, LEAST.get(knob.key, 0.0))
    ends = np.clip(limits, max(least, LEAST.get(knob.key, 0.02)), most)
    wanted, found = (max(mean_of(knob.figure, rows), 1e-3) for rows in (want, got))
    if knob.by == "factor":
        ends *= (wanted / found) ** knob.gain
    elif knob.by == "lost":
        ends = 1 - (1 - ends) * (wanted / found) ** knob.gain
    else:
        ends = np.sqrt(np.maximum(ends**2 + knob.gain * (wanted**2 - found**2), 0.0))
    if knob.by == "factor":
        want, got = np.log(np.maximum(want, 1e-3)), np.log(np.maximum(got, 1e-3))
    spread = float(want.std() / max(got.std(), 1e-3))
    middle, half = ends.mean(), np.ptp(ends) / 2 * np.clip(spread, 0.8, 1.15)
    low, high = np.clip([middle - half, middle + half], least, most)
    return float(low), float(high)


def _column(rows: Array, figure: str) -> Array:
    """Finite values of a figure; 0 where there is none."""
    values = rows[:, FIGURES.index(figure)]
    found = values[np.isfinite(values)]
    return found if len(found) else np.zeros(1)


def _middle(rows: Array, figure: str) -> float:
    return mean_of(figure, _column(rows, figure))
