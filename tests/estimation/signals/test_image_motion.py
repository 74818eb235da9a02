"""Shifts between images, and the rates that follow from them."""

import numpy as np
import pytest

from dmrl.estimation.signals.image_motion import estimate_shift, shift_rates, shrink_image

RNG = np.random.default_rng(2)


def draw_scene(right: float, down: float) -> np.ndarray:
    """Return a (56, 80) crop of a random texture with all spatial scales, shifted in pixels."""
    world = np.fft.fft2(np.random.default_rng(7).normal(size=(112, 160)))
    v, u = np.meshgrid(np.fft.fftfreq(112), np.fft.fftfreq(160), indexing="ij")
    size = 1 / np.maximum(np.hypot(u, v), 0.01)
    moved = world * size * np.exp(-2j * np.pi * (u * right + v * down))
    return np.asarray(np.fft.ifft2(moved).real[28:84, 40:120])


@pytest.mark.parametrize("moved", [(0.0, 0.0), (3.4, -1.7), (-12.3, 5.5), (0.2, 9.0)])
def test_a_shift_is_found_to_a_fifth_of_a_pixel(moved: tuple[float, float]) -> None:
    noise = RNG.normal(0, 0.2, (2, 56, 80))
    found = estimate_shift(draw_scene(0, 0) + noise[0], draw_scene(*moved) + noise[1])
    assert found == pytest.approx(moved, abs=0.2)


def test_unrelated_images_have_no_shift() -> None:
    assert estimate_shift(*RNG.normal(size=(2, 56, 80))) is None
    assert estimate_shift(np.zeros((56, 80)), np.zeros((56, 80))) is None
    assert estimate_shift(np.zeros((56, 80)), np.zeros((56, 81))) is None


def test_pictures_are_shrunk_by_means_whatever_their_size() -> None:
    assert shrink_image(np.full((244, 324, 3), 7, np.uint8)).shape == (61, 81)
    picture = RNG.integers(0, 256, (224, 320), np.uint8)
    assert shrink_image(picture)[3, 5] == picture[12:16, 20:24].mean()
    assert shrink_image(np.zeros((10, 12), np.uint8)).shape == (10, 12)


def test_image_rates_omit_gaps_and_unmatched_images() -> None:
    time = np.array([0.0, 0.1, 0.2, 0.3, 2.0])
    moved = np.array([[1.0, 2.0], [np.nan, np.nan], [-1.0, 0.0], [5.0, 5.0]])
    middle, speed = shift_rates(time, moved)
    np.testing.assert_allclose(middle, [0.05, 0.25])
    np.testing.assert_allclose(speed, [[10, 20], [-10, 0]])
