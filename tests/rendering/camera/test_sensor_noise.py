"""Noise estimates that are independent of texture and brightness."""

import numpy as np
import pytest
from numpy.typing import NDArray

from dmrl.rendering.camera.distortion import FloatImage
from dmrl.rendering.camera.sensor import gaussian_blur
from dmrl.rendering.camera.sensor_noise import (
    BLOCK_PX,
    NoiseEstimate,
    estimate_noise,
    measure_blocks,
    white_noise_correlation,
)

SHAPE = (240, 320)


def draw_light(level: float, rng: np.random.Generator, textured: float = 0.0) -> FloatImage:
    """Return light (240, 320) of a wall at a level, with blurred texture in a share of it."""
    ramp = np.linspace(0.85, 1.15, SHAPE[1]) * level
    street = gaussian_blur(rng.standard_normal((*SHAPE, 1), np.float32), 1.0)[..., 0] * 0.2 * level
    street[int(textured * SHAPE[0]) :] = 0
    return np.asarray(ramp + street, np.float32)


def take_blocks(light: FloatImage, rng: np.random.Generator) -> NDArray[np.float32]:
    """Measure blocks of a picture with noise whose variance is 0.0225 times the light."""
    noise = rng.standard_normal(SHAPE, np.float32) * np.sqrt(0.0225 * np.maximum(light, 0))
    return measure_blocks(np.asarray(np.clip(np.round(light + noise), 0, 255), np.float32))


def estimate_from_pictures(levels: tuple[float, ...], textured: float) -> NoiseEstimate:
    """Estimate the noise from eight pictures of each level, with a share of texture."""
    rng = np.random.default_rng(0)
    shots = [take_blocks(draw_light(level, rng, textured), rng) for level in levels * 8]
    return estimate_noise(np.concatenate(shots))


def test_white_noise_has_no_correlation_and_its_own_spread() -> None:
    rng = np.random.default_rng(0)
    noise = np.asarray(128 + 2 * rng.standard_normal((800, 800), np.float32))
    grain = estimate_noise(measure_blocks(noise))
    assert grain.grain == pytest.approx(2, rel=0.03)
    assert grain.grain_correlation == pytest.approx(0, abs=0.01)
    # Subtracting a plane from each block makes white noise negatively correlated.
    assert white_noise_correlation() < -0.04


def test_correlation_of_demosaiced_noise_is_measured() -> None:
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((800, 800), np.float32)
    both = 128 + noise + 0.5 * (np.roll(noise, 1, 0) + np.roll(noise, 1, 1))
    found = estimate_noise(measure_blocks(both)).grain_correlation
    # Subtracting a plane removes more of coarse noise than of white noise.
    assert 0.28 < found < 0.5 / 1.5


@pytest.mark.heavy
def test_noise_estimate_is_independent_of_texture_in_most_of_the_picture() -> None:
    plain, street = (estimate_from_pictures((60.0, 120.0, 180.0), share) for share in (0.0, 0.85))
    assert street.grain == pytest.approx(plain.grain, rel=0.05)
    assert street.grain_correlation == pytest.approx(plain.grain_correlation, abs=0.03)


@pytest.mark.heavy
def test_noise_estimate_is_independent_of_brightness() -> None:
    dim, bright = (
        estimate_from_pictures((40.0, 180.0), 0.0),
        estimate_from_pictures((40.0, 180.0, 180.0, 180.0), 0.0),
    )
    assert bright.grain == pytest.approx(dim.grain, rel=0.03)


def test_constant_images_have_no_noise_estimate() -> None:
    for level in (0.0, 255.0):
        grain = estimate_noise(measure_blocks(np.full(SHAPE, level, np.float32)))
        assert np.isnan(grain.grain) and np.isnan(grain.grain_correlation)


def test_noise_blocks_are_ranked_by_their_neighbours() -> None:
    blocks = measure_blocks(np.random.default_rng(0).random((64, 8 * 5), np.float32) * 9 + 100)
    assert blocks.shape == (64 // BLOCK_PX * 4, 4)  # The fifth block of a row has no neighbour.
    assert np.array_equal(blocks[0::2, 3], blocks[1::2, 1])
    assert np.array_equal(blocks[1::2, 3], blocks[0::2, 1])
