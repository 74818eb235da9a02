"""The camera of a robot is read from its recording or from a file."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import topics
from dmrl.errors import RecordingError, SettingError
from dmrl.geometry.camera_file import format_camera
from dmrl.geometry.frames import AIDECK, Camera
from dmrl.images.codec import encode_png
from dmrl.labelling.flight_log import read_flight
from dmrl.labelling.recorded_camera import find_recorded_camera, read_robot_camera
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter


def write_flight(path: Path, **lens: Any) -> Path:
    """Write a calibration and two images at 5 and 9 ns; return the path."""
    fields = {"width": 320, "height": 224, "K": [181, 0, 150, 0, 182, 100, 0, 0, 1], **lens}
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.write(0, topics.CALIBRATION("cf1"), message_class("CameraCalibration")(**fields))
        data = encode_png(np.zeros((224, 320, 3), np.uint8))
        for time_ns in (5, 9):
            picture = message_class("CompressedImage")(data=data, format="png")
            sink.write(time_ns, topics.CAMERA_IMAGE("cf1"), picture)
    return path


@pytest.mark.parametrize("model", ["", "plumb_bob", "rational_polynomial"])
def test_recorded_camera_equals_written_calibration(tmp_path: Path, model: str) -> None:
    path = write_flight(
        tmp_path / "a.mcap", D=[0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0], distortion_model=model
    )
    lens = (0.1, 0.2, 0.3, 0.4, 0.5)
    assert find_recorded_camera(read_flight(path), "cf1") == Camera(
        320, 224, 181, 182, 150, 100, lens
    )
    assert find_recorded_camera(read_flight(path), "cf2") is None


@pytest.mark.parametrize(
    "lens", [{"D": [0] * 4, "distortion_model": "equidistant"}, {"D": [0, 0, 0, 0, 0, 0.1]}]
)
def test_a_lens_that_dmrl_does_not_know_is_refused(tmp_path: Path, lens: dict[str, Any]) -> None:
    path = write_flight(tmp_path / "a.mcap", **lens)
    with pytest.raises(RecordingError, match=r"coefficients, dmrl knows plumb_bob with 5"):
        find_recorded_camera(read_flight(path), "cf1")


@pytest.mark.parametrize("lens", [{"K": []}, {"K": [1, 2]}, {"D": [float("inf")]}, {"width": 0}])
def test_invalid_calibrations_are_refused(tmp_path: Path, lens: dict[str, Any]) -> None:
    path = write_flight(tmp_path / "a.mcap", **lens)
    with pytest.raises(
        RecordingError, match=r"a.mcap: /cf1/camera/calibration (has|is) .*dmrl cali"
    ):
        find_recorded_camera(read_flight(path), "cf1")


def test_images_have_their_log_times(tmp_path: Path) -> None:
    path = write_flight(tmp_path / "a.mcap")
    found = read_flight(path).images_ns
    assert {robot: times.tolist() for robot, times in found.items()} == {"cf1": [5, 9]}


def test_a_file_for_images_of_another_size_is_refused(tmp_path: Path) -> None:
    path, file = write_flight(tmp_path / "a.mcap"), tmp_path / "camera.toml"
    file.write_text(format_camera(AIDECK))
    assert read_robot_camera(read_flight(path, sizes_of=["cf1"]), "cf1", file) == AIDECK
    file.write_text(format_camera(replace(AIDECK, width_px=224, height_px=320)))
    with pytest.raises(SettingError, match=r"for images of 224x320, those of cf1 .* are 320x224"):
        read_robot_camera(read_flight(path, sizes_of=["cf1"]), "cf1", file)
    assert read_robot_camera(read_flight(path, sizes_of=["cf2"]), "cf2", file).width_px == 224
