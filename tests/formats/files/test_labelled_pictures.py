"""Classes become peers, and boxes give depths."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import SettingError
from dmrl.formats.base import Options
from dmrl.formats.files.labelled_pictures import name_peers
from dmrl.geometry.camera_file import format_camera
from dmrl.geometry.frames import AIDECK, Camera

from .boxes import HEIGHT, WIDTH, labels_of, read


def test_classes_become_peers() -> None:
    classes = ["drone", "cf", "drone", "drone", "quad copter", ""]
    names = {"cf": "cf2"}
    want = ["drone", "cf2", "drone-2", "drone-3", "quad_copter", "_"]
    assert name_peers(classes, names) == want


def camera(width: int = WIDTH, height: int = HEIGHT) -> Camera:
    return Camera(width, height, 200.0, 200.0, width / 2, height / 2)


def test_the_calibration_in_the_folder_of_a_set_is_its_camera(small: Path) -> None:
    (small / "calibration.toml").write_text(format_camera(camera()))
    found = read(small, "yolo", Options(robot_width_m=0.12))
    assert found[0].fields["K"][0] == 200
    assert all(peer["depth_m"] > 0 for peers in labels_of(found) for peer in peers)
    (given,) = (s for s in read(small, "yolo", Options(camera=AIDECK)) if "K" in s.fields)
    assert given.fields["K"][0] == AIDECK.fx_px


@pytest.mark.parametrize(("share", "said"), [(1.01, False), (1.14, True)])
def test_a_given_camera_of_another_lens_than_the_folders_is_doubted(
    share: float, said: bool, small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (small / "calibration.toml").write_text(format_camera(camera()))
    read(small, "yolo", Options(camera=replace(camera(), fx_px=200 * share)))
    line = "calibration.toml: doubt: its fx_px is 200.0, that of --camera 228.0, which is used"
    assert (line in capsys.readouterr().err) == said


def test_the_width_of_a_robot_gives_the_depth_of_its_box(small: Path) -> None:
    (small / "labels/1.txt").write_text("0 0.5 0.5 0.25 0.1\n1 0.05 0.5 0.1 0.1\n")
    options = Options(camera=camera(), robot_width_m=0.12)
    whole, cut = labels_of(read(small, "yolo", options))[0]
    assert whole["depth_m"] == pytest.approx(200 * 0.12 / 80)
    assert whole["sigma_depth_m"] / whole["depth_m"] == pytest.approx(0.0996, abs=1e-3)
    assert whole["depth_from_box"]
    assert (cut["depth_m"], cut["sigma_depth_m"]) == (0, np.inf)
    with pytest.raises(SettingError, match="--robot-width-m needs the focal length"):
        read(small, "yolo", Options(robot_width_m=0.12))


def test_width_sigma_matches_a_square_at_random_yaw() -> None:
    yaw = np.random.default_rng(0).uniform(0, 2 * np.pi, 1_000_000)
    width = np.abs(np.cos(yaw)) + np.abs(np.sin(yaw))
    assert width.std() / width.mean() == pytest.approx(0.098, abs=1e-3)


def test_the_depth_of_a_box_follows_the_crop(small: Path) -> None:
    (small / "labels/1.txt").write_text("0 0.5 0.5 0.25 0.1\n")
    options = Options(camera=camera(), robot_width_m=0.12, size_px=(160, 112))
    (peer,) = labels_of(read(small, "yolo", options))[0]
    assert peer["depth_m"] == pytest.approx(200 * 0.12 / 80)


def test_the_size_of_the_camera_is_checked(small: Path) -> None:
    with pytest.raises(SettingError, match="its camera 64x48"):
        read(small, "yolo", Options(camera=camera(64, 48)))
    assert AIDECK.width_px == WIDTH
