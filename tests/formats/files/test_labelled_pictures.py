"""In sets of labelled images, classes become peers and boxes give depths."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import SettingError
from dmrl.formats.base import Options
from dmrl.formats.files.labelled_pictures import name_peers
from dmrl.geometry.camera_file import format_camera
from dmrl.geometry.frames import AIDECK, Camera

from .boxes import HEIGHT, WIDTH, find_labels, read_samples


def test_classes_become_peers() -> None:
    classes = ["drone", "cf", "drone", "drone", "quad copter", ""]
    names = {"cf": "cf2"}
    want = ["drone", "cf2", "drone-2", "drone-3", "quad_copter", "_"]
    assert name_peers(classes, names) == want


def make_camera(width: int = WIDTH, height: int = HEIGHT) -> Camera:
    """Return a camera without distortion and with a focal length of 200 px."""
    return Camera(width, height, 200.0, 200.0, width / 2, height / 2)


def test_the_calibration_in_the_folder_of_a_set_is_its_camera(yolo_set: Path) -> None:
    (yolo_set / "calibration.toml").write_text(format_camera(make_camera()))
    found = read_samples(yolo_set, "yolo", Options(robot_width_m=0.12))
    assert found[0].fields["K"][0] == 200
    assert all(peer["depth_m"] > 0 for peers in find_labels(found) for peer in peers)
    (given,) = (
        s for s in read_samples(yolo_set, "yolo", Options(camera=AIDECK)) if "K" in s.fields
    )
    assert given.fields["K"][0] == AIDECK.fx_px


@pytest.mark.parametrize(("share", "said"), [(1.01, False), (1.14, True)])
def test_given_camera_that_differs_from_the_folder_s_is_reported(
    share: float, said: bool, yolo_set: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (yolo_set / "calibration.toml").write_text(format_camera(make_camera()))
    read_samples(yolo_set, "yolo", Options(camera=replace(make_camera(), fx_px=200 * share)))
    line = "calibration.toml: doubt: its fx_px is 200.0, that of --camera 228.0, which is used"
    assert (line in capsys.readouterr().err) == said


def test_the_width_of_a_robot_gives_the_depth_of_its_box(yolo_set: Path) -> None:
    (yolo_set / "labels/1.txt").write_text("0 0.5 0.5 0.25 0.1\n1 0.05 0.5 0.1 0.1\n")
    options = Options(camera=make_camera(), robot_width_m=0.12)
    whole, cut = find_labels(read_samples(yolo_set, "yolo", options))[0]
    assert whole["depth_m"] == pytest.approx(200 * 0.12 / 80)
    assert whole["sigma_depth_m"] / whole["depth_m"] == pytest.approx(0.0996, abs=1e-3)
    assert whole["depth_from_box"]
    assert (cut["depth_m"], cut["sigma_depth_m"]) == (0, np.inf)
    with pytest.raises(SettingError, match="--robot-width-m needs the focal length"):
        read_samples(yolo_set, "yolo", Options(robot_width_m=0.12))


def test_width_sigma_matches_a_square_at_random_yaw() -> None:
    yaw = np.random.default_rng(0).uniform(0, 2 * np.pi, 1_000_000)
    width = np.abs(np.cos(yaw)) + np.abs(np.sin(yaw))
    assert width.std() / width.mean() == pytest.approx(0.098, abs=1e-3)


def test_the_depth_of_a_box_follows_the_crop(yolo_set: Path) -> None:
    (yolo_set / "labels/1.txt").write_text("0 0.5 0.5 0.25 0.1\n")
    options = Options(camera=make_camera(), robot_width_m=0.12, size_px=(160, 112))
    (peer,) = find_labels(read_samples(yolo_set, "yolo", options))[0]
    assert peer["depth_m"] == pytest.approx(200 * 0.12 / 80)


def test_the_size_of_the_camera_is_checked(yolo_set: Path) -> None:
    with pytest.raises(SettingError, match="its camera 64x48"):
        read_samples(yolo_set, "yolo", Options(camera=make_camera(64, 48)))
    assert AIDECK.width_px == WIDTH
