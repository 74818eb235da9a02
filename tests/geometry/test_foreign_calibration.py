"""Reading of camera calibration files that ROS, Kalibr, EuRoC and OpenCV write."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.geometry.camera_file import read_camera
from dmrl.geometry.frames import Camera
from dmrl.geometry.lens import distort

K = np.array([[210.0, 0, 160], [0, 211, 119], [0, 0, 1]])
D = (-0.1, 0.02, 0.001, -0.002, 0.0)
WANTED = Camera(320, 240, 210.0, 211.0, 160.5, 119.5, D)

ROS = """image_width: 320
image_height: 240
camera_name: cam
camera_matrix:
  rows: 3
  cols: 3
  data: [210, 0.0, 160.0, 0.0, 211.0, 119.0, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 0.02, 0.001, -0.002, 0.0]
rectification_matrix: {rows: 3, cols: 3, data: [1,0,0,0,1,0,0,0,1]}
projection_matrix: {rows: 3, cols: 4, data: [210,0,160,0,0,211,119,0,0,0,1,0]}
"""
KALIBR = """cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [210.0, 211.0, 160.0, 119.0]
  resolution: [320, 240]
  rostopic: /cam0/image_raw
"""
MESSAGE = """header: {stamp: {sec: 1, nanosec: 0}, frame_id: c}
height: 240
width: 320
distortion_model: plumb_bob
d: [-0.1, 0.02, 0.001, -0.002, 0.0]
k: [210.0, 0.0, 160.0, 0.0, 211.0, 119.0, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [210.0, 0.0, 160.0, 0.0, 0.0, 211.0, 119.0, 0.0, 0.0, 0.0, 1.0, 0.0]
"""


def write_text(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize("text", [ROS, MESSAGE, f"{MESSAGE}---\n", f"---\n{MESSAGE}---\n{MESSAGE}"])
def test_ros_files_are_read(text: str, tmp_path: Path) -> None:
    assert read_camera(write_text(tmp_path / "camera.yaml", text)) == WANTED


def test_a_file_of_kalibr_has_four_coefficients(tmp_path: Path) -> None:
    found = read_camera(write_text(tmp_path / "camchain.yaml", KALIBR))
    assert found == Camera(320, 240, 210.0, 211.0, 160.5, 119.5, D[:4])
    two = KALIBR + KALIBR.replace("cam0", "cam1")
    with pytest.raises(SourceError, match="it has cam0, cam1; keep one"):
        read_camera(write_text(tmp_path / "two.yaml", two))


def test_euroc_sensor_file_is_read(tmp_path: Path) -> None:
    lines = [line.strip() for line in KALIBR.splitlines()[2:]]
    text = "sensor_type: camera\n" + "\n".join(lines).replace("radtan", "radial-tangential")
    text = text.replace("distortion_coeffs", "distortion_coefficients")
    found = read_camera(write_text(tmp_path / "sensor.yaml", text))
    assert found == Camera(320, 240, 210.0, 211.0, 160.5, 119.5, D[:4])


@pytest.mark.parametrize("suffix", ["yml", "json", "xml"])
@pytest.mark.parametrize("coefficients", [4, 5, 8, 14])
def test_opencv_files_are_read(suffix: str, coefficients: int, tmp_path: Path) -> None:
    path = tmp_path / f"camera.{suffix}"
    d = np.zeros(coefficients)
    d[:4] = D[:4]
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 320)
    storage.write("image_height", 240)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", d)
    storage.release()
    assert read_camera(path) == Camera(320, 240, 210.0, 211.0, 160.5, 119.5, tuple(d[:5]))


def test_number_with_an_underscore_is_refused(tmp_path: Path) -> None:
    matrix = "<camera_matrix><data>1_0 0 2 0 10 2 0 0 1</data></camera_matrix>"
    size = "<image_width>4</image_width><image_height>4</image_height>"
    text = f"<opencv_storage>{size}{matrix}</opencv_storage>"
    assert read_camera(write_text(tmp_path / "a.xml", text.replace("1_0", "10"))).fx_px == 10
    with pytest.raises(SourceError, match=r"camera\.xml"):
        read_camera(write_text(tmp_path / "camera.xml", text))


def test_projection_differs_from_opencv_by_half_a_pixel(tmp_path: Path) -> None:
    found = read_camera(write_text(tmp_path / "camera.yaml", ROS))
    point = np.array([[0.3, -0.2, 1.0]])
    (pixel,), _ = cv2.projectPoints(point, np.zeros(3), np.zeros(3), K, np.array(D))
    bent, _ = distort(point[:, :2], found.distortion)
    ours = bent * [found.fx_px, found.fy_px] + [found.cx_px, found.cy_px]
    assert ours[0] == pytest.approx(pixel[0] + 0.5, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (KALIBR.replace("radtan", "equidistant"), "its lens model is equidistant, not plumb_bob"),
        (KALIBR.replace("pinhole", "omni"), "its camera_model is omni"),
        (f"{ROS}camera_model: fisheye", "its camera_model is fisheye"),
        (KALIBR.replace("[320, 240]", "[320]"), "its size has no 2 numbers"),
        (ROS.replace("image_width: 320", ""), "it has no image_width"),
        (ROS.replace("-0.002, 0.0]", "-0.002, 0.0, 0.1, 0.2, 0.3]"), "has 8 coefficients, not 5"),
        (ROS.replace("[210, 0.0", "[.nan, 0.0"), "its matrix has no 9 numbers"),
        (ROS.replace("[210, 0.0", "[210, 3.0"), "has a skew"),
        (ROS.replace("160.0, 0.0, 211.0, 119.0, 0.0, 0.0", "0, 0, 211, 0, 160, 119"), "transposed"),
        (ROS.replace("[210, 0.0", "[210, a"), "'a' is no number"),
        (ROS.replace("[210,", "[-210,"), "must be over 0"),
        (f"{MESSAGE}binning_x: 999\n", "must be over 0"),
        (f"{MESSAGE}roi: [1, 2, 3, 4]\n", "its roi is no table"),
        (f"{MESSAGE}roi: {{x_offset: wide}}\n", "'wide' is no number"),
        ("- 1\n- 2\n", "it is not a table"),
        ("a: *b\n", "no calibration of ROS"),
    ],
)
def test_unsupported_calibration_gives_one_line_error(text: str, why: str, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=why) as e:
        read_camera(write_text(tmp_path / "camera.yaml", text))
    assert "\n" not in str(e.value) and "dmrl calibrate, or write the camera as TOML" in str(
        e.value
    )


def test_other_json_gives_one_line_error(tmp_path: Path) -> None:
    for document in ({"a": 1}, [1, 2], {"K": 3}):
        with pytest.raises(SourceError, match="is no calibration of ROS, Kalibr or OpenCV"):
            read_camera(write_text(tmp_path / "camera.json", json.dumps(document)))


def test_third_party_calibration_file_is_read(data: Path) -> None:
    found = read_camera(data / "strangers" / "camera-ros" / "ros.yaml")
    assert (found.width_px, found.height_px, found.fx_px, found.cx_px) == (320, 240, 210.0, 160.5)


def test_a_file_without_known_coefficients_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = {"image_width": 320, "image_height": 240, "camera_matrix": K.tolist()}
    path = write_text(tmp_path / "a.json", json.dumps({**given, "my_lens": [D]}))
    assert read_camera(path).distortion == ()
    assert "no distortion coefficients found" in capsys.readouterr().err
    path = write_text(tmp_path / "b.json", json.dumps({**given, "dist_coeff": [D]}))
    assert read_camera(path) == WANTED
    read_camera(write_text(tmp_path / "c.yaml", KALIBR.replace("radtan", "none")))
    assert "no distortion coefficients" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "said"), [({}, True), ({"fisheye_model": 0}, False), ({"D": D}, False)]
)
def test_four_coefficients_without_a_model_are_named_as_plumb_bob(
    more: dict[str, object], said: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = {"image_width": 320, "image_height": 240, "K": K.tolist(), "D": D[:4]}
    path = write_text(tmp_path / "a.json", json.dumps({**given, **more}))
    assert read_camera(path).distortion[:4] == D[:4]
    assert ("read as k1, k2, p1, p2 of plumb bob" in capsys.readouterr().err) == said
    path.write_text(
        json.dumps({**given, "distortion_model": "fisheye"})
    )  # the advice of the warning
    with pytest.raises(SourceError, match="its lens model is fisheye"):
        read_camera(path)


def test_camera_info_is_adapted_to_its_region_and_binning(tmp_path: Path) -> None:
    roi = "{x_offset: 100, y_offset: 40, height: 180, width: 200, do_rectify: true}"
    told = f"{MESSAGE}binning_x: 2\nbinning_y: 3\nroi: {roi}\n"
    found = read_camera(write_text(tmp_path / "camera.yaml", told))
    assert found == Camera(100, 60, 105.0, 211 / 3, 30.25, 26.5, D)
    none = "{x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}"
    whole = f"{MESSAGE}binning_x: 0\nbinning_y: 0\nroi: {none}\n"
    assert read_camera(write_text(tmp_path / "whole.yaml", whole)) == WANTED


def test_a_file_without_a_size_names_the_key(tmp_path: Path) -> None:
    path = write_text(tmp_path / "a.json", json.dumps({"camera_matrix": K.tolist()}))
    with pytest.raises(SourceError, match="it has no image_width"):
        read_camera(path)
