"""Checks of images and their camera calibration."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl.images.codec import encode_png
from dmrl.recording import check

from .test_check_recording import Write, build_calibration, build_image, record_and_check


def test_images_without_calibration_or_of_another_size_are_found(tmp_path: Path) -> None:
    assert record_and_check(
        tmp_path / "a.mcap", lambda write: write(0, "/cf1/camera/image", build_image())
    ) == ["warning /cf1/camera/image no calibration on /cf1/camera/calibration"]

    def fill(write: Write) -> None:
        write(0, "/cf1/camera/calibration", build_calibration(324, 244))
        write(0, "/cf1/camera/image", build_image())
        write(1, "/cf1/camera/image", build_image(b"no image"))

    findings = record_and_check(tmp_path / "b.mcap", fill)
    assert (
        "error /cf1/camera/image images of 320x224, but the calibration is for 324x244" in findings
    )
    assert "error /cf1/camera/image 1 messages contain no readable image: 1 ns" in findings


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        ([(320, 224)], []),
        ([(320, 224), (160, 112)], ["warning /cf1/camera/image images of 2 sizes: 160x112, "]),
        ([(160, 112)], ["error /cf1/camera/image images of 160x112, but the calibration is for "]),
    ],
)
def test_images_of_other_sizes_than_the_calibration_are_found(
    tmp_path: Path, sizes: list[tuple[int, int]], said: list[str]
) -> None:
    def fill(write: Write) -> None:
        write(0, "/cf1/camera/calibration", build_calibration())
        for k, (width, height) in enumerate(sizes):
            data = encode_png(np.zeros((height, width, 3), np.uint8))
            write(k, "/cf1/camera/image", build_image(data))

    found = record_and_check(tmp_path / "a.mcap", fill)
    assert len(found) == len(said)
    assert all(one.startswith(words) for one, words in zip(found, said, strict=True))
    assert all("320x224" in one for one in found)
    quick = check(tmp_path / "a.mcap", quick=True, values=True)
    assert [f"{f.level} {f.topic} {f.text}" for f in quick] == [f for f in found if "error" in f]


@pytest.mark.parametrize(
    ("numbers", "finding"),
    [
        ({"K": []}, "warning /cf1/camera/calibration is not calibrated: K is zero or missing"),
        ({"K": [0] * 9}, "warning /cf1/camera/calibration is not calibrated: K is zero or missing"),
        ({"K": [1, 2]}, "error /cf1/camera/calibration has 2 numbers in K, not 9"),
        (
            {"D": [float("nan")]},
            "error /cf1/camera/calibration has numbers in K or D that are not finite or too large",
        ),
        (
            {"K": [180, 0, 1e300, 0, 180, 112, 0, 0, 1]},
            "error /cf1/camera/calibration has numbers in K or D that are not finite or too large",
        ),
        (
            {"K": [180, 0, 160, 0, -180, 112, 0, 0, 1]},
            "error /cf1/camera/calibration has a focal length that is not above 0",
        ),
        (
            {"K": [180, 0, 0, 0, 180, 0, 160, 112, 1]},
            "error /cf1/camera/calibration has a skew in K, or K is transposed",
        ),
        (
            {"K": [0.6, 0, 160, 0, 0.6, 112, 0, 0, 1]},
            "warning /cf1/camera/calibration has a focal length of 0.6 px for images 320 px wide. "
            "Is it in mm, or a share?",
        ),
        ({"height": 0}, "error /cf1/camera/calibration has images of 320 x 0 px"),
        (
            {"distortion_model": "equidistant", "D": [0.1] * 4},
            "warning /cf1/camera/calibration has a lens of model 'equidistant' with 4 "
            "coefficients, dmrl knows plumb_bob with 5",
        ),
    ],
)
def test_implausible_calibration_is_found(
    tmp_path: Path, numbers: dict[str, Any], finding: str
) -> None:
    def fill(write: Write) -> None:
        write(0, "/cf1/camera/calibration", build_calibration())
        write(1, "/cf1/camera/calibration", build_calibration(**numbers))

    assert record_and_check(tmp_path / "a.mcap", fill) == [finding]
