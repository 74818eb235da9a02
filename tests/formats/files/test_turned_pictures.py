"""Images that EXIF rotates, with labels or a camera that may refer to either orientation."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from dmrl.errors import SettingError
from dmrl.formats.base import Options
from dmrl.formats.registry import find_format
from dmrl.geometry.frames import AIDECK
from dmrl.images.codec import decode

ROW = "a.png,cf2,10,20,,4,15,16,25\n"
LABELS = "file,peer,u_px,v_px,depth_m,left_px,top_px,right_px,bottom_px\n"


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    """Return a folder with an image of 64 x 48 pixels that EXIF rotates to 48 x 64."""
    exif = PIL.Image.Exif()
    exif[0x0112] = 6
    PIL.Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(tmp_path / "a.png", exif=exif)
    return tmp_path


def read_shapes(source: Path, options: Options) -> list[tuple[int, ...]]:
    """Return the shape of each image and the edges of each box, pixels."""
    found = []
    for sample in find_format(source).content(source, options).samples:
        if sample.message == "CompressedImage":
            found.append(decode(sample.fields["data"]).shape)
        found += [tuple(peer["box_px"]) for peer in sample.fields.get("peers", ())]
    return found


@pytest.mark.parametrize("what", ["labels", "yolo", "camera"])
def test_orientation_of_labels_and_camera_must_be_stated(what: str, photo: Path) -> None:
    options = Options()
    if what == "labels":
        (photo / "labels.csv").write_text(LABELS + ROW)
    elif what == "yolo":
        (photo / "a.txt").write_text("0 0.5 0.5 0.25 0.25\n")
    else:
        options = replace(options, camera=replace(AIDECK, width_px=48, height_px=64))
    with pytest.raises(SettingError, match=r"a\.png is turned by EXIF.*--upright.*--as-stored"):
        read_shapes(photo, options)
    assert read_shapes(photo, replace(options, as_stored=False))[0] == (64, 48, 3)
    stored = replace(options, as_stored=True)
    if options.camera:
        with pytest.raises(SettingError, match="is 64x48 px, its camera 48x64"):
            read_shapes(photo, stored)
        stored = replace(stored, camera=replace(AIDECK, width_px=64, height_px=48))
    assert read_shapes(photo, stored)[0] == (48, 64, 3)


def test_labels_are_unchanged_for_either_stated_orientation(photo: Path) -> None:
    (photo / "labels.csv").write_text(LABELS + ROW)
    for as_stored, shape in ((True, (48, 64, 3)), (False, (64, 48, 3))):
        assert read_shapes(photo, Options(as_stored=as_stored)) == [shape, (4.0, 15.0, 16.0, 25.0)]


def test_rotated_images_without_labels_are_turned_upright(photo: Path) -> None:
    assert read_shapes(photo, Options()) == [(64, 48, 3)]
    (photo / "labels.csv").write_text(f"{LABELS}a.png,{',' * 7}\n")
    assert read_shapes(photo, Options()) == [(64, 48, 3)]
