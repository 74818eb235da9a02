from pathlib import Path

import pytest

from dmrl.errors import SourceError
from dmrl.geometry.camera_file import camera_named, read_camera, write_camera
from dmrl.geometry.frames import AIDECK, PUBLISHED_RENDER, Camera


@pytest.mark.parametrize("camera", [AIDECK, PUBLISHED_RENDER])
def test_a_camera_comes_back_as_written(camera: Camera, tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(write_camera(camera))
    assert read_camera(path) == camera


def test_a_camera_has_a_name_or_a_file(tmp_path: Path) -> None:
    assert camera_named(Path("published")) == PUBLISHED_RENDER
    path = tmp_path / "camera.toml"
    path.write_text(write_camera(AIDECK))
    assert camera_named(path) == AIDECK


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("fx_px =", "fx =", r"wrong keys fx, fx_px \(missing\)\. Keys: width_px"),
        ("= 320", "= 320.5", "wrong keys width_px"),
        ("= 224", "= 0", "wrong keys height_px"),
        ("= 183.73", "= nan", "wrong keys fx_px"),
        ("= 183.73", "= true", "wrong keys fx_px"),
        ("= [", '= ["a", ', "wrong keys distortion"),
        ("= [", "= [[", "is not a TOML file"),
    ],
)
def test_wrong_keys_are_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(write_camera(AIDECK).replace(old, new, 1))
    with pytest.raises(SourceError, match=message) as e:
        read_camera(path)
    assert "\n" not in str(e.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"no calibration .*a\.toml\. Name a TOML file"):
        read_camera(tmp_path / "a.toml")
