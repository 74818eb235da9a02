"""Received images are decoded, coloured and cropped."""

import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.formats.aideck.cpx import Image
from dmrl.images import bayer, codec
from dmrl.live.image_assembly import encode_image
from dmrl.live.simulated.aideck_server import pad_to_sensor

RNG = np.random.default_rng(4)
SMOOTH = np.clip(
    128 + 60 * np.sin(np.mgrid[:224, :320].sum(axis=0)[..., None] / (20.0, 31.0, 47.0)), 0, 255
).astype(np.uint8)


def test_full_sensor_images_are_cropped_to_the_calibration() -> None:
    raw = bayer.to_bayer(pad_to_sensor(SMOOTH))
    data, kind = encode_image(Image(324, 244, "raw", raw.tobytes()), "colour")
    assert kind == "png"
    difference = np.abs(codec.decode(data).astype(int) - SMOOTH)
    assert difference[1:-1, 1:-1].max() <= 4
    grey, _ = encode_image(Image(324, 244, "raw", raw.tobytes()), "grey")
    assert (codec.decode(grey)[..., 1] == raw[10:234, 2:322]).all()


def test_a_jpeg_of_the_right_size_keeps_its_bytes() -> None:
    jpeg = codec.encode_jpeg(SMOOTH)
    assert encode_image(Image(320, 224, "jpeg", jpeg), "colour") == (jpeg, "jpeg")
    whole = codec.encode_jpeg(pad_to_sensor(SMOOTH))
    data, kind = encode_image(Image(324, 244, "jpeg", whole), "colour", "jpeg")
    assert codec.read_size(data) == (320, 224, kind)


def test_jpeg_size_must_match_its_header() -> None:
    jpeg = codec.encode_jpeg(SMOOTH)
    with pytest.raises(SourceError, match="not 160 x 120 px as in its header"):
        encode_image(Image(160, 120, "jpeg", jpeg), "colour")
