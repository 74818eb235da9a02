"""The simulated sensor: mosaic, blur, exposure, vignetting and noise."""

import numpy as np
import pytest

from dmrl.images.bayer import to_bayer
from dmrl.rendering.camera.sensor import (
    Sensor,
    _tabulate_levels,
    demosaic,
    expose,
    gaussian_blur,
)


def make_rng() -> np.random.Generator:
    """Return a new generator that always starts from the same seed."""
    return np.random.default_rng(0)


def test_demosaicing_restores_uniform_colour() -> None:
    picture = np.broadcast_to(np.array([0.2, 0.5, 0.8], np.float32), (8, 10, 3))
    assert np.allclose(demosaic(to_bayer(picture)), picture)


def test_mosaic_keeps_measured_pixel_values() -> None:
    picture = make_rng().random((8, 10, 3), np.float32)
    back = demosaic(to_bayer(picture))
    assert np.array_equal(back[::2, ::2, 0], picture[::2, ::2, 0])
    assert np.array_equal(back[1::2, 1::2, 2], picture[1::2, 1::2, 2])
    assert np.array_equal(back[::2, 1::2, 1], picture[::2, 1::2, 1])


def test_lens_blur_keeps_brightness_and_centroid() -> None:
    picture = np.zeros((31, 31, 1), np.float32)
    picture[15, 15] = 1
    out = gaussian_blur(picture, 1.5)
    v, u = np.mgrid[:31, :31]
    assert out.sum() == pytest.approx(1, abs=1e-5)
    assert (out[..., 0] * u).sum() == pytest.approx(15, abs=1e-4)
    spread = (out[..., 0] * (v - 15) ** 2).sum() ** 0.5
    assert spread == pytest.approx(1.5, rel=0.05)


def test_exposure_gives_the_configured_mean_brightness() -> None:
    light = np.full((20, 20, 3), 7.0, np.float32)
    rgb = expose(light, Sensor(brightness=0.4), make_rng())
    assert rgb.dtype == np.uint8
    assert np.abs(rgb.astype(int) - 102).max() <= 1


def test_corners_are_darker_under_vignetting() -> None:
    light = np.ones((20, 20, 3), np.float32)
    rgb = expose(light, Sensor(brightness=0.5, contrast_gamma=1.0, vignetting=0.8), make_rng())
    assert rgb[0, 0, 1] < 0.4 * rgb[10, 10, 1]


def test_noise_has_the_configured_std() -> None:
    light = np.ones((200, 200, 3), np.float32)
    sensor = Sensor(brightness=0.5, contrast_gamma=1.0, shot_noise=0.002, read_noise=0.01)
    rgb = expose(light, sensor, make_rng()) / 255
    assert rgb.std() == pytest.approx((0.002 * 0.5 + 0.01**2) ** 0.5, rel=0.05)


def test_the_same_seed_gives_the_same_noise() -> None:
    light = make_rng().random((20, 20, 3), np.float32)
    sensor = Sensor(bayer=True, shot_noise=0.01, saturation=0.5)
    assert np.array_equal(expose(light, sensor, make_rng()), expose(light, sensor, make_rng()))


def test_without_saturation_the_three_channels_are_equal() -> None:
    light = np.random.default_rng(0).random((16, 24, 3), np.float32)
    sensor = Sensor(saturation=0.0, shot_noise=0.01, read_noise=0.02)
    rgb = expose(light, sensor, np.random.default_rng(1))
    assert (rgb == rgb[..., :1]).all()
    assert len(np.unique(rgb)) > 20


@pytest.mark.parametrize("gamma", [0.5, 1.0, 1.2, 2.2, 3.0])
def test_levels_are_powers_of_the_light(gamma: float) -> None:
    light = make_rng().random((100, 200, 3)).astype(np.float32) ** 3
    light[0, :2] = [[0, 0, 0], [1, 1, 1]]
    rgb = expose(light, Sensor(brightness=None, contrast_gamma=gamma), make_rng())
    exact = 255 * light.astype(float) ** (1 / gamma)
    assert np.abs(rgb - exact).max() < 0.5 + 1e-4
    assert rgb[0, :2].tolist() == [[0, 0, 0], [255, 255, 255]]


def test_every_bin_of_light_has_at_most_one_threshold() -> None:
    for gamma in np.linspace(0.5, 3, 101):
        _, thresholds = _tabulate_levels(float(gamma))
        assert np.isfinite(thresholds).sum() == 255
