"""Camera files: round trip, and refusal of wrong keys and numbers."""

from pathlib import Path

import pytest

from dmrl.errors import SourceError
from dmrl.geometry.camera_file import find_camera, format_camera, read_camera
from dmrl.geometry.frames import AIDECK, PUBLISHED_RENDER, Camera


@pytest.mark.parametrize("camera", [AIDECK, PUBLISHED_RENDER])
def test_camera_file_round_trips(camera: Camera, tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(format_camera(camera))
    assert read_camera(path) == camera


def test_camera_is_found_by_name_or_file(tmp_path: Path) -> None:
    assert find_camera(Path("published")) == PUBLISHED_RENDER
    path = tmp_path / "camera.toml"
    path.write_text(format_camera(AIDECK))
    assert find_camera(path) == AIDECK


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
    path.write_text(format_camera(AIDECK).replace(old, new, 1))
    with pytest.raises(SourceError, match=message) as e:
        read_camera(path)
    assert "\n" not in str(e.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"no calibration .*a\.toml\. Use a TOML file"):
        read_camera(tmp_path / "a.toml")


@pytest.mark.parametrize(
    ("key", "value", "good"),
    [
        ("fx_px", "-183.0", False),
        ("cx_px", "-183.0", True),  # outside the image, as in a cropped one
        ("cy_px", "inf", False),
        ("delay_s", "-inf", False),
        ("delay_s", "-0.1", True),
        ("mount_rad", "[0.1, 0.2]", False),
        ("mount_rad", "[0.1, 0.2, nan]", False),
        ("mount_rad", "[0.1, 0.2, 0.3, 0.4]", False),
        ("distortion", "[0.1, 0.2, 0.3, 0.4, 0.5]", True),
        ("distortion", "[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]", False),
        ("distortion", "[]", True),
    ],
)
def test_numbers_that_no_camera_has_are_refused(
    tmp_path: Path, key: str, value: str, good: bool
) -> None:
    path = tmp_path / "camera.toml"
    lines = format_camera(AIDECK).splitlines()
    path.write_text("\n".join(f"{key} = {value}" if key in line else line for line in lines))
    if good:
        read_camera(path)
        return
    with pytest.raises(SourceError, match=f"wrong keys {key}"):
        read_camera(path)
