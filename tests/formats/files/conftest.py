"""Fixtures of the tests of files."""

from pathlib import Path

import pytest

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
