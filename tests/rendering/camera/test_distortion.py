"""Lens distortion and resampling."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.errors import SettingError
from dmrl.geometry.frames import AIDECK
from dmrl.rendering.camera.distortion import (
    image_from_pinhole,
    pinhole_canvas,
    pinhole_from_image,
    sample_bilinear,
)


def test_undistorting_inverts_distortion() -> None:
    uv = np.random.default_rng(0).uniform((0, 0), (320, 224), (200, 2))
    assert np.allclose(image_from_pinhole(pinhole_from_image(uv, AIDECK), AIDECK), uv, atol=1e-6)


def test_distortion_follows_the_plumb_bob_model_on_the_axis() -> None:
    uv = np.array([[AIDECK.cx_px + 0.5 * AIDECK.fx_px, AIDECK.cy_px]])
    radial = 1 - 0.0957 * 0.25 + 0.0211 * 0.0625
    assert np.allclose(
        image_from_pinhole(uv, AIDECK),
        [[AIDECK.cx_px + 0.5 * radial * AIDECK.fx_px, AIDECK.cy_px]],
    )


def test_sampling_at_pixel_centres_gives_the_picture() -> None:
    picture = np.random.default_rng(0).random((5, 7, 4), np.float32)
    v, u = np.mgrid[:5, :7] + 0.5
    places = np.stack([u, v], axis=-1).astype(np.float32)
    assert np.allclose(sample_bilinear(picture, places), picture)
    assert np.allclose(sample_bilinear(picture, places - 100), 0)


def test_the_canvas_covers_all_pixels_of_the_image() -> None:
    canvas = pinhole_canvas(AIDECK)
    assert canvas.places_px is not None
    assert canvas.places_px.min() > 0
    assert (canvas.places_px.max(axis=(0, 1)) < canvas.inside.shape[::-1]).all()
    straight = pinhole_canvas(replace(AIDECK, distortion=()))
    assert straight.places_px is None
    assert straight.inside.all()


def test_oversized_image_is_refused() -> None:
    with pytest.raises(SettingError, match="100000x224 px are too large to render"):
        pinhole_canvas(replace(AIDECK, width_px=100_000, height_px=224))
