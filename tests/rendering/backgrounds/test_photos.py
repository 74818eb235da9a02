"""Photos that are backgrounds of robots."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import SettingError
from dmrl.geometry.frames import AIDECK
from dmrl.images.codec import encode_jpeg, encode_png
from dmrl.rendering.backgrounds.photos import (
    SRGB_TO_LINEAR,
    apply_motion_blur,
    open_photos,
)

CAMERA = replace(AIDECK, distortion=())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder of a whole photo, a truncated one, a file that is no photo, and a text."""
    photo = np.random.default_rng(0).integers(0, 255, (300, 400, 3), np.uint8)
    data = encode_jpeg(photo)
    (tmp_path / "a.jpg").write_bytes(data[: len(data) // 2])
    (tmp_path / "b.jpg").write_bytes(data)
    (tmp_path / "c.jpg").write_bytes(b"no photo")
    (tmp_path / "licence.txt").write_text("free")
    return tmp_path


def test_broken_photos_are_skipped_and_counted(folder: Path) -> None:
    photos = open_photos(folder)
    for seed in range(6):
        backdrop = photos.random_backdrop(np.random.default_rng(seed), CAMERA, zoom=1.5)
        assert backdrop.shape == (224, 320, 3)
    assert photos.broken == 2


def test_photo_is_area_averaged_or_point_sampled(tmp_path: Path) -> None:
    stripes = np.zeros((448, 640, 3), np.uint8)
    stripes[:, 1::4] = 252
    (tmp_path / "stripes.png").write_bytes(encode_png(stripes))
    photos, levels = open_photos(tmp_path), []
    for averaged in (True, False):
        rng = np.random.default_rng(0)
        light = photos.random_backdrop(rng, CAMERA, zoom=1.0, averaged=averaged)
        levels.append(
            np.unique(np.round(np.interp(light[:, 8:-8], SRGB_TO_LINEAR, np.arange(256))))
        )
    # A pixel is two columns wide, and every other pixel has a stripe.
    assert levels[1].tolist() == [0, 252]
    assert levels[0].min() > 0


def test_a_folder_without_a_photo_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        SettingError, match=r"contains no readable photo .*Use another --backgrounds"
    ):
        open_photos(tmp_path)
    with pytest.raises(SettingError, match="no folder"):
        open_photos(tmp_path / "none")


def test_photo_is_converted_from_srgb_to_linear_light() -> None:
    assert SRGB_TO_LINEAR[[0, 255]].tolist() == [0, 1]
    assert SRGB_TO_LINEAR[188] == pytest.approx(0.5, abs=0.01)


def test_motion_blur_keeps_brightness_and_centroid() -> None:
    picture = np.zeros((11, 21, 3), np.float32)
    picture[5, 10] = 1
    out = apply_motion_blur(picture, (6.0, 0.0))
    assert out.sum() == pytest.approx(3, abs=1e-4)
    assert np.flatnonzero(out[5, :, 0]).tolist() == list(range(7, 14))
    assert apply_motion_blur(picture, (0.0, 0.0)) is picture
