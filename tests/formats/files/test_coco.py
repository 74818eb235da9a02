"""COCO sets become labels within 0.01 px."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dmrl.errors import SourceError
from dmrl.formats.base import Options
from dmrl.formats.registry import find_format
from dmrl.images.codec import decode
from dmrl.terminal.left_out import count_left_out

from .boxes import HEIGHT, WIDTH, assert_boxes, make_boxes, read_samples, write_picture


def make_coco_document(folder: str, ks: range, name: str) -> dict[str, Any]:
    """Return a COCO document of the images ``name`` + k of a folder, with their boxes."""
    return {
        "categories": [{"id": 7, "name": "drone"}, {"id": 9, "name": "quad copter"}],
        "images": [
            {"id": 100 + k, "file_name": f"{folder}{name}{k}.png", "width": WIDTH, "height": HEIGHT}
            for k in ks
        ],
        "annotations": [
            {
                "id": 10 * k + n,
                "image_id": 100 + k,
                "category_id": {"drone": 7, "quad copter": 9}[kind],
                "bbox": [a, b, c - a, d - b],
                "area": (c - a) * (d - b),
                "iscrowd": 0,
            }
            for k in ks
            for n, (kind, (a, b, c, d)) in enumerate(make_boxes(k))
        ],
    }


@pytest.mark.parametrize(
    ("pictures", "file", "prefix"),
    [
        ("{split}2017/", "annotations/instances_{split}2017.json", ""),
        ("images/{split}2017/", "annotations/instances_{split}2017.json", ""),
        ("{split}/", "{split}/_annotations.coco.json", ""),
        ("data/{split}/", "{split}.json", "{split}/"),
    ],
)
def test_coco_with_splits(pictures: str, file: str, prefix: str, tmp_path: Path) -> None:
    # Both splits have images of the same names.
    for split, ks in (("train", range(6)), ("val", range(6, 9))):
        for k in ks:
            write_picture(tmp_path / pictures.format(split=split) / f"p{k % 6}.png", k)
        told = make_coco_document(prefix.format(split=split), ks, "p")
        for k, image in zip(ks, told["images"], strict=True):
            image["file_name"] = f"{prefix.format(split=split)}p{k % 6}.png"
        path = tmp_path / file.format(split=split)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(told))
    if "annotations" in file and "_anno" not in file:
        (tmp_path / "annotations/captions_train2017.json").write_text(
            '{"images": [], "annotations": []}'
        )
    assert_boxes(samples := read_samples(tmp_path, "coco"), list(range(9)))
    pixels = [decode(s.fields["data"]) for s in samples if s.message == "CompressedImage"]
    assert [int(rgb[0, 0, 0]) for rgb in pixels] == list(range(9))
    content = find_format(tmp_path).content(tmp_path, Options())
    assert content.split == {"train": [(0, 500_000_000)], "val": [(600_000_000, 800_000_000)]}


def test_unusable_coco_annotations_are_omitted(tmp_path: Path) -> None:
    for k in range(1, 6):
        write_picture(tmp_path / f"p{k}.png", k)
    told = make_coco_document("", range(1, 5), "p")
    told["images"].append({"id": 1, "file_name": "gone.png"})
    told["images"][0]["width"] = 640
    told["annotations"].append({"id": 500, "image_id": 104, "category_id": 7, "iscrowd": 1})
    next(a for a in told["annotations"] if a["image_id"] == 102)["bbox"] = [1, 2, 0, 3]
    (tmp_path / "set.json").write_text(json.dumps(told))
    with count_left_out() as counted:
        samples = read_samples(tmp_path, "coco")
    assert sum(s.message == "CompressedImage" for s in samples) == 4
    assert_boxes(samples, [3, 4])
    assert counted.counts == {
        "pictures of a JSON file that are not there": 1,
        "pictures with labels for another size": 1,
        "boxes around crowds (iscrowd)": 1,
        "pictures with a box that cannot be read": 1,
        "pictures that no JSON file names": 1,
    }
    with count_left_out():
        assert_boxes(
            list(
                find_format(tmp_path / "set.json").content(tmp_path / "set.json", Options()).samples
            ),
            [3, 4],
        )


@pytest.mark.parametrize(
    "text", ['{"images": [{}], ', '{"images": [{"id": 1}]}', '[{"images": []}]', '{"images": [3]}']
)
def test_invalid_coco_file_gives_one_line_error(text: str, tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png", 1)
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(SourceError, match=r"a\.json is not a COCO file: .*Restore"):
        read_samples(tmp_path, "coco")


@pytest.mark.parametrize("place", ["bbox", "attributes"])
def test_numbers_with_underscores_are_invalid(place: str, tmp_path: Path) -> None:
    document = make_coco_document("", [1], "")
    for annotation in document["annotations"]:
        annotation[place] = {"depth_m": "1_0"} if place == "attributes" else ["1_0", 2, 3, 4]
    (tmp_path / "a.json").write_text(json.dumps(document))
    write_picture(tmp_path / "1.png", 1)
    with count_left_out() as left:
        assert [s.message for s in read_samples(tmp_path, "coco")] == ["CompressedImage"]
    assert left.counts == {"pictures with a box that cannot be read": 1}


def test_labels_without_exactly_one_image_are_left_out(tmp_path: Path) -> None:
    document = make_coco_document("", range(3), "")
    document["images"][2]["id"] = document["images"][1]["id"]
    (tmp_path / "a.json").write_text(json.dumps(document))
    for k in range(3):
        write_picture(tmp_path / f"{k}.png", k)
    with count_left_out() as left:
        found = list(find_format(tmp_path, None).content(tmp_path, Options()).samples)
    labels = [sample for sample in found if sample.topic.endswith("/labels")]
    assert len(found) - len(labels) == 3 and [one.time_ns for one in labels] == [0]
    assert left.counts == {
        "boxes of no picture in the file": len(make_boxes(2)),
        "labels of pictures that share an id": 2,
    }


@pytest.mark.parametrize("kind", [str, float])
def test_ids_may_be_numbers_or_strings(kind: Callable[[int], object], tmp_path: Path) -> None:
    document = make_coco_document("", [1, 2], "")
    for annotation in document["annotations"]:
        annotation |= {name: kind(annotation[name]) for name in ("image_id", "category_id")}
    (tmp_path / "a.json").write_text(json.dumps(document))
    for k in (1, 2):
        write_picture(tmp_path / f"{k}.png", k)
    assert_boxes(read_samples(tmp_path, "coco"), [1, 2])


def test_a_picture_of_several_files_counts_once_and_in_its_split(tmp_path: Path) -> None:
    for k in range(4):
        write_picture(tmp_path / f"{k}.png", k)
    for name, ks in (("all", (0, 1, 2, 3)), ("test", (0, 1)), ("train", (1, 2))):
        (tmp_path / f"instances_{name}.json").write_text(
            json.dumps(make_coco_document("", list(ks), ""))
        )
    with count_left_out() as left:
        content = find_format(tmp_path).content(tmp_path, Options())
        assert_boxes(list(content.samples), [2, 0, 1, 3])
    assert content.split == {"train": [(0, 0)], "test": [(100_000_000, 200_000_000)]}
    assert left.counts == {"pictures named again, in another JSON file or the same": 4}


def test_foreign_attributes_do_not_change_peer_and_source(tmp_path: Path) -> None:
    document = make_coco_document("", [1], "")
    for annotation in document["annotations"]:
        annotation["attributes"] = {"peer": "", "source": "manual"}
    (tmp_path / "a.json").write_text(json.dumps(document))
    write_picture(tmp_path / "1.png", 1)
    samples = list(find_format(tmp_path).content(tmp_path, Options()).samples)
    assert_boxes(samples, [1])
    assert [s.fields["sources"] for s in samples if s.message == "PeerLabels"] == [["hand"]]
