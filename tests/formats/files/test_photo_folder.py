"""Single images, photos of a phone, and images that are too large for the commands."""

from pathlib import Path

import pytest

from dmrl.errors import SourceError
from dmrl.formats.base import Options
from dmrl.formats.registry import find_format
from dmrl.terminal.left_out import count_left_out

from .test_image_folder import read_samples


def test_a_single_picture_is_a_folder_of_one(folder: Path) -> None:
    assert find_format(folder / "b.JPG").name == "images"
    (image,) = read_samples(folder / "b.JPG", "CompressedImage")
    assert image.fields["data"] == (folder / "b.JPG").read_bytes()


def test_photos_and_videos_of_other_kinds_are_named_with_the_way_out(
    folder: Path, tmp_path: Path
) -> None:
    (folder / "IMG_1.HEIC").write_bytes(b"photo")
    with count_left_out() as tally:
        assert len(read_samples(folder, "CompressedImage")) == 3
    assert [(n, "save photos as JPEG" in why) for why, n in tally.counts.items()] == [(1, True)]
    (only := tmp_path / "videos").mkdir()
    (only / "a.MOV").write_bytes(b"video")
    with pytest.raises(SourceError, match="no image"), count_left_out():
        find_format(only).content(only, Options())


def test_a_link_to_a_picture_that_is_not_there_is_counted(folder: Path) -> None:
    (folder / "d.png").symlink_to(folder / "gone.png")
    with count_left_out() as tally:
        assert len(read_samples(folder, "CompressedImage")) == 3
    assert tally.counts == {"links to pictures that are not there": 1}


def test_a_picture_that_no_command_could_read_is_left_out_with_the_flags_that_scale_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("dmrl.guards.limits.FRAME_PIXELS", 64 * 48 - 1)
    assert read_samples(folder, "CompressedImage") == []
    assert "a.png is 64 x 48 px" in (said := capsys.readouterr().err)
    assert "--width-px 640" in said
    assert len(read_samples(folder, "CompressedImage", Options(size_px=(32, 24)))) == 3
