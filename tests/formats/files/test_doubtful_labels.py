"""Labels that are readable, but probably in another format than they seem."""

import json
from pathlib import Path

import pytest

from dmrl.terminal.left_out import count_left_out

from .boxes import HEIGHT, WIDTH, find_labels, read_samples, write_picture

OUTSIDE = "labels are centred outside their picture: corners for width and height"
OVER = "labels have a box that reaches out of its picture: corners for centre and size"


def write_yolo(path: Path, boxes: list[list[float]]) -> Path:
    """Write a YOLO set of one image with these boxes; return its folder."""
    write_picture(path / "images/1.png", 1)
    (path / "labels").mkdir()
    lines = "".join(f"0 {' '.join(map(str, box))}\n" for box in boxes)
    (path / "labels/1.txt").write_text(lines)
    return path


def write_coco(path: Path, boxes: list[list[float]]) -> Path:
    """Write a COCO set of one image with these boxes; return its folder."""
    write_picture(path / "1.png", 1)
    told = {
        "images": [{"id": 1, "file_name": "1.png", "width": WIDTH, "height": HEIGHT}],
        "categories": [{"id": 1, "name": "drone"}],
        "annotations": [{"image_id": 1, "category_id": 1, "bbox": box} for box in boxes],
    }
    (path / "a.json").write_text(json.dumps(told))
    return path


@pytest.mark.parametrize(
    ("kind", "box", "doubt"),
    [
        ("coco", [200, 150, 260, 200], OUTSIDE),  # right and bottom in place of width and height
        ("coco", [100, 100, 40, 30], ""),
        ("coco", [290, 100, 32, 30], ""),  # 2 px beyond the right edge
        ("yolo", [0.1, 0.2, 0.3, 0.6], OVER),  # corners in place of centre and size
        ("yolo", [0.5, 0.5, 0.2, 0.2], ""),
        ("yolo", [-0.1, 0.5, 0.2, 0.2], OUTSIDE),
    ],
)
def test_labels_outside_their_image_are_reported(
    kind: str, box: list[float], doubt: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    read_samples({"coco": write_coco, "yolo": write_yolo}[kind](tmp_path, [box]), kind)
    told = [line for line in capsys.readouterr().err.splitlines() if "doubt" in line]
    assert [doubt in line for line in told] == [True] * bool(doubt)


@pytest.mark.parametrize("kind", ["coco", "yolo"])
def test_a_box_that_is_there_twice_is_one_peer(kind: str, tmp_path: Path) -> None:
    box = [0.5, 0.5, 0.25, 0.25] if kind == "yolo" else [10, 10, 30, 30]
    source = {"coco": write_coco, "yolo": write_yolo}[kind](tmp_path, [box, box])
    with count_left_out() as left:
        (peers,) = find_labels(read_samples(source, kind))
    assert len(peers) == 1
    assert left.counts == {"boxes that repeat another of their picture": 1}


def test_classes_count_blank_lines(tmp_path: Path) -> None:
    source = write_yolo(tmp_path, [[0.5, 0.5, 0.25, 0.25]])
    (source / "classes.txt").write_text("\ndrone\n")
    (source / "labels/1.txt").write_text("1 0.5 0.5 0.25 0.25\n")
    assert find_labels(read_samples(source, "yolo"))[0][0]["peer"] == "drone"
