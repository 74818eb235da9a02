"""YOLO sets, written by other programs, become labels within 0.01 px."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.formats.base import Options
from dmrl.formats.registry import find_format
from dmrl.guards import limits
from dmrl.terminal.left_out import count_left_out

from .boxes import (
    HEIGHT,
    WIDTH,
    assert_boxes,
    find_labels,
    format_yolo,
    make_boxes,
    read_samples,
    write_picture,
)

DATA_YAML = "path: /content/elsewhere/set\ntrain: {}\nval: {}\nnc: 2\nnames: {}\n"


@pytest.mark.parametrize(
    ("places", "stated", "names"),
    [
        (("images/train", "images/val"), ("images/train", "images/val"), "[drone, 'quad copter']"),
        (
            ("train/images", "valid/images"),
            ("../train/images", "../valid/images"),
            "{0: drone, 1: quad copter}",
        ),
        (("images/a", "images/b"), ("images/a", "./images/b"), "[drone, quad copter]"),
        (
            ("images/a/deep", "images/b"),
            ("[images/a, images/c]", "images/b"),
            "['drone', quad copter]",
        ),
        (("images/a", "images/b"), ("train.txt", "lists/val.txt"), "[drone, quad copter]"),
    ],
)
def test_yolo_with_splits(
    places: tuple[str, str], stated: tuple[str, str], names: str, tmp_path: Path
) -> None:
    source = tmp_path / "set"
    pictures: dict[str, list[Path]] = {"train": [], "val": []}
    for k in range(11):
        split = "val" if k in (3, 4, 8) else "train"
        folder = source / places[split == "val"]
        write_picture(folder / f"img{k}.png", k)
        pictures[split].append(folder / f"img{k}.png")
        label = Path(str(folder).replace("/images", "/labels")) / f"img{k}.txt"
        label.parent.mkdir(parents=True, exist_ok=True)
        label.write_text(format_yolo(make_boxes(k)))
    for split, text in zip(pictures, stated, strict=True):
        if text.endswith(".txt"):
            (source / text).parent.mkdir(exist_ok=True)
            lines = [f"./{path.relative_to(source)}\n" for path in pictures[split]]
            (source / text).write_text("".join(lines))
    (source / "data.yaml").write_text(DATA_YAML.format(*stated, names))
    train, val = [k for k in range(11) if k not in (3, 4, 8)], [3, 4, 8]
    assert_boxes(read_samples(source, "yolo"), train + val)
    content = find_format(source).content(source, Options())
    assert content.split == {"train": [(0, 700_000_000)], "val": [(800_000_000, 1_000_000_000)]}


@pytest.mark.parametrize("classes", ["classes.txt", "obj.names", "labels/classes.txt"])
@pytest.mark.parametrize("beside", [False, True])
def test_yolo_without_splits(classes: str, beside: bool, tmp_path: Path) -> None:
    (tmp_path / "labels").mkdir()
    for k in range(11):
        write_picture(tmp_path / "images" / f"{k}.png", k)
        folder = tmp_path / ("images" if beside else "labels")
        (folder / f"{k}.txt").write_text(format_yolo(make_boxes(k)))
    (tmp_path / classes).write_text("drone\nquad copter\n")
    samples = read_samples(tmp_path, "yolo")
    assert_boxes(samples, list(range(11)))
    assert not find_format(tmp_path).content(tmp_path, Options()).split


@pytest.mark.heavy
def test_yolo_as_supervision_writes_it(tmp_path: Path) -> None:
    sv = pytest.importorskip("supervision")
    paths = []
    annotations = {}
    for k in range(6):
        write_picture(tmp_path / "from" / f"{k}.png", k)
        paths.append(str(tmp_path / "from" / f"{k}.png"))
        boxes = np.array([box for _, box in make_boxes(k)], np.float32).reshape(-1, 4)
        numbers = np.arange(len(boxes))
        annotations[paths[-1]] = sv.Detections(xyxy=boxes, class_id=numbers)
    made = sv.DetectionDataset(["drone", "quad copter"], paths, annotations)
    out = tmp_path / "set"
    made.as_yolo(str(out / "images"), str(out / "labels"), str(out / "data.yaml"))
    assert_boxes(read_samples(out, "yolo"), list(range(6)))
    made.as_coco(str(out / "c/images"), str(out / "c/annotations/all.json"))
    assert_boxes(read_samples(out / "c", "coco"), list(range(6)))


@pytest.mark.parametrize(
    ("line", "box"),
    [
        ("0 0.5 0.5 0.25 0.5 0.93", (0.375, 0.25, 0.625, 0.75)),
        ("0 0.1 0.2 0.5 0.2 0.3 0.7", (0.1, 0.2, 0.5, 0.7)),
        ("0 0.1 0.2 0.5 0.2 0.5 0.7 0.1 0.7", (0.1, 0.2, 0.5, 0.7)),
    ],
)
def test_confidences_and_polygons_give_boxes(
    line: str, box: tuple[float, ...], yolo_set: Path
) -> None:
    (yolo_set / "labels/1.txt").write_text(line + "\n\n")
    (peer,) = find_labels(read_samples(yolo_set, "yolo"))[0]
    want = np.array(box) * (WIDTH, HEIGHT, WIDTH, HEIGHT)
    np.testing.assert_allclose(peer["box_px"], want)


def test_keypoints_are_ignored_where_they_are_stated(yolo_set: Path) -> None:
    (yolo_set / "labels/1.txt").write_text("0 0.5 0.5 0.25 0.5 0.4 0.4 2 0.6 0.6 2\n")
    (yolo_set / "data.yaml").write_text("names: [drone]\nkpt_shape: [2, 3]\n")
    (peer,) = find_labels(read_samples(yolo_set, "yolo"))[0]
    assert peer["box_px"] == [120, 56, 200, 168]


@pytest.mark.parametrize(
    "line",
    [
        "0 0.5 0.5 0.25",
        "0 160 112 40 30",
        "drone 0.5 0.5 0.1 0.1",
        "0.93 0.5 0.5 0.1 0.1",  # the confidence comes first
        "0 0.5 0.5 0 0.1",
        "0 nan 0.5 0.1 0.1",
        "0 0.1 0.2 0.5 0.2 0.3 0.7 0.4",
        "0 0.5 0.5 0.25 0.5 0.87 1",  # a confidence and a track number
        "0 0.5 0.5 0.25 0.5 0.4 0.4 2 0.6 0.6 2",  # keypoints that data.yaml does not state
        "\xff",
    ],
)
def test_a_label_file_that_is_broken_leaves_its_picture(line: str, yolo_set: Path) -> None:
    (yolo_set / "labels/1.txt").write_bytes(f"0 0.5 0.5 0.1 0.1\n{line}\n".encode("latin-1"))
    with count_left_out() as counted:
        samples = read_samples(yolo_set, "yolo")
    assert sum(s.message == "CompressedImage" for s in samples) == 2
    assert_boxes(samples, [2])
    (count,) = counted.counts.values()
    assert count == 1
    assert "1.txt" in next(iter(counted.first.values()))


def test_a_huge_label_file_leaves_its_picture(
    yolo_set: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (yolo_set / "labels/1.txt").write_bytes(bytes(2_000))
    monkeypatch.setattr(limits, "TEXT_BYTES", 1_000)
    with count_left_out() as counted:
        assert_boxes(read_samples(yolo_set, "yolo"), [2])
    assert "Split it" in next(iter(counted.first.values()))


def test_a_set_in_pixels_is_refused(yolo_set: Path) -> None:
    for k in (1, 2):
        (yolo_set / f"labels/{k}.txt").write_text("0 160 112 40 30\n")
    with pytest.raises(SourceError, match=r"no label file is YOLO's"), count_left_out():
        read_samples(yolo_set, "yolo")


@pytest.mark.parametrize("unlabelled", [False, True])
def test_image_without_label_file_is_empty_unless_unlabelled_is_set(
    unlabelled: bool, yolo_set: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_picture(yolo_set / "images/0.png", 0)
    write_picture(yolo_set / "images/._0.png", 0)
    (yolo_set / "labels/7.txt").write_text(format_yolo(make_boxes(1)))
    with count_left_out() as counted:
        assert_boxes(
            read_samples(yolo_set, "yolo", Options(unlabelled=unlabelled)),
            [1, 2] if unlabelled else [0, 1, 2],
        )
    assert counted.counts == {"label files without a picture": 1}
    assert ("1 pictures have no label file" in capsys.readouterr().err) != unlabelled


@pytest.mark.parametrize(
    "text",
    [
        "names: [",
        "- a\n",
        "names: {a: b}",
        "names: 7",
        "names: [x]\ntrain: 5",
        "names: &a [x]\ntrain: *a\n",
        "!!python/object/apply:os.system [ls]",
    ],
)
def test_invalid_description_gives_one_line_error(text: str, yolo_set: Path) -> None:
    (yolo_set / "data.yaml").write_text(text)
    with pytest.raises(SourceError, match=r"data\.yaml does not describe a YOLO set: .*Fix") as e:
        read_samples(yolo_set, "yolo")
    assert "\n" not in str(e.value)


def test_a_picture_of_another_size_follows_the_crop(yolo_set: Path) -> None:
    for peers, k in zip(
        find_labels(read_samples(yolo_set, "yolo", Options(size_px=(160, 112)))),
        (1, 2),
        strict=True,
    ):
        for peer, (_, box) in zip(peers, make_boxes(k), strict=True):
            np.testing.assert_allclose(peer["box_px"], np.array(box) / 2, atol=0.01)


@pytest.mark.parametrize("folder", ["", "train/"])
def test_label_files_beside_the_pictures_are_enough(folder: str, tmp_path: Path) -> None:
    for k in range(5):
        write_picture(tmp_path / f"{folder}{k}.png", k)
        (tmp_path / f"{folder}{k}.txt").write_text(format_yolo(make_boxes(k)))
    found = find_labels(read_samples(tmp_path, "yolo"))
    assert [[peer["peer"] for peer in peers] for peers in found] == [
        [f"class{n}" for n in range(k % 3)] for k in range(5)
    ]


def test_texts_beside_pictures_are_not_always_labels(tmp_path: Path) -> None:
    write_picture(tmp_path / "0.png", 0)
    for text in ("1.5 2 3 4 5\n", "0 a b c d\n", "taken on Monday", "0 1 2 3 4"):
        (tmp_path / "0.txt").write_text(text)
        assert find_format(tmp_path).name == "images"
