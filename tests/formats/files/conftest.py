"""Small folders of images."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.images.codec import encode_jpeg, encode_png

from .boxes import format_yolo, make_boxes, write_picture


@pytest.fixture
def yolo_set(tmp_path: Path) -> Path:
    """Return a YOLO set of two labelled images."""
    for k in (1, 2):
        write_picture(tmp_path / "images" / f"{k}.png", k)
        (tmp_path / "labels").mkdir(exist_ok=True)
        (tmp_path / "labels" / f"{k}.txt").write_text(format_yolo(make_boxes(k)))
    (tmp_path / "classes.txt").write_text("drone\nquad copter\n")
    return tmp_path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder of three images of 64 x 48 pixels, as PNG, JPEG and PPM, and a text file."""
    path = tmp_path / "pictures"
    path.mkdir()
    rgb = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    (path / "a.png").write_bytes(encode_png(rgb))
    (path / "b.JPG").write_bytes(encode_jpeg(rgb))
    (path / "c.ppm").write_bytes(b"P6\n# hi\n64 48\n255\n" + rgb.tobytes() + b"junk")
    (path / "notes.txt").write_text("no picture")
    return path
