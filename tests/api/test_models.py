"""The Python interface to networks: the same detections as ``dmrl predict``."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dmrl
from dmrl.errors import ModelError, SettingError


@pytest.mark.heavy
def test_detections_equal_dmrl_predict(flight: Path, tmp_path: Path) -> None:
    model = dmrl.load("dmrl-nano")
    images = dmrl.open(flight).images("cf1")
    found = model.detect(images, threshold=0.05)
    predicted = dmrl.predict("dmrl-nano", flight, min_confidence=0.05)
    said = predicted.detections("cf1")
    said = said[said["confidence"] >= 0.05]
    assert len(found) == len(images)
    # predict batches the images differently, so its sums are rounded differently.
    for name, most in (("u_px", 1e-3), ("depth_m", 1e-4), ("confidence", 1e-4)):
        ours = [getattr(d, name) for image in found for d in image]
        assert np.allclose(ours, said[name], rtol=0, atol=most)
    assert all(d.confidence >= model.threshold for image in model.detect(images) for d in image)


@pytest.mark.heavy
def test_one_image_is_treated_as_a_batch_of_one(flight: Path) -> None:
    model = dmrl.load("dmrl-nano")
    images = dmrl.open(flight).images("cf1")
    assert model.detect(images[0], threshold=0.01) == model.detect(images[:1], threshold=0.01)
    assert model.grids(images[:2].to_numpy()).confidence.shape == (2, 28, 40)


@pytest.mark.parametrize(
    "images",
    [
        np.zeros((2, 224, 320), np.uint8),
        np.zeros((1, 224, 320, 3), np.float32),
        np.zeros((0, 0, 3), np.uint8),
        np.zeros((1, 0, 64, 3), np.uint8),
        ["no image"],
        [None],
    ],
)
def test_invalid_images_are_reported(images: Any) -> None:
    with pytest.raises(SettingError, match="RGB"):
        dmrl.load("dmrl-nano").detect(images)


def test_sizes_not_divisible_by_the_stride_are_reported() -> None:
    with pytest.raises(SettingError, match="--width-px 320 --height-px 224"):
        dmrl.load("dmrl-nano").detect(np.zeros((1, 225, 320, 3), np.uint8))


@pytest.mark.parametrize("settings", [{"threshold": 2.0}, {"threshold": float("nan")}, {"most": 0}])
def test_settings_out_of_range_are_reported(settings: dict[str, Any]) -> None:
    with pytest.raises(SettingError, match="Give"):
        dmrl.load("dmrl-nano").detect(np.zeros((1, 224, 320, 3), np.uint8), **settings)


def test_unknown_model_name_is_reported() -> None:
    with pytest.raises(ModelError, match="dmrl-nano"):
        dmrl.load("dmrl-mini")


def test_unknown_backend_name_is_reported() -> None:
    with pytest.raises(SettingError, match=r"no backend cuda\. There are: torch, onnx"):
        dmrl.load("dmrl-nano", backend="cuda")  # type: ignore[arg-type]


def test_a_path_is_refused_as_images() -> None:
    with pytest.raises(SettingError, match="RGB"):
        dmrl.load("dmrl-nano").detect("flight.mcap")  # type: ignore[arg-type]
