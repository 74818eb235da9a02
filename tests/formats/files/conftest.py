"""Fixtures of the tests of files."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.images.codec import encode_jpeg, encode_png

from .boxes import boxes_of, write_picture, yolo_lines


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Two labelled pictures of a YOLO set."""
    for k in (1, 2):
        write_picture(tmp_path / "images" / f"{k}.png", k)
        (tmp_path / "labels").mkdir(exist_ok=True)
        (tmp_path / "labels" / f"{k}.txt").write_text(yolo_lines(boxes_of(k)))
    (tmp_path / "classes.txt").write_text("drone\nquad copter\n")
    return tmp_path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three pictures of 64 x 48: PNG, JPEG and PPM."""
    path = tmp_path / "pictures"
    path.mkdir()
    rgb = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    (path / "a.png").write_bytes(encode_png(rgb))
    (path / "b.JPG").write_bytes(encode_jpeg(rgb))
    (path / "c.ppm").write_bytes(b"P6\n# hi\n64 48\n255\n" + rgb.tobytes() + b"junk")
    (path / "notes.txt").write_text("no picture")
    return path
