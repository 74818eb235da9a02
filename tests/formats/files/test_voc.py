"""Pascal VOC sets become labels. VOC counts whole pixels from 1."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.formats.base import Options
from dmrl.formats.registry import find_format
from dmrl.terminal.left_out import count_left_out

from .boxes import (
    HEIGHT,
    WIDTH,
    Boxes,
    assert_boxes,
    find_labels,
    make_boxes,
    read_samples,
    write_picture,
)


def make_voc_document(boxes: Boxes, width: int = WIDTH) -> str:
    """Return an XML document; VOC counts whole pixels from 1 and includes the last."""
    objects = "".join(
        f"<object><name>{name}</name><bndbox><xmin>{int(a) + 1}</xmin><ymin>{int(b) + 1}</ymin>"
        f"<xmax>{int(c)}</xmax><ymax>{int(d)}</ymax></bndbox></object>"
        for name, (a, b, c, d) in boxes
    )
    size = f"<size><width>{width}</width><height>{HEIGHT}</height><depth>3</depth></size>"
    return f"<annotation><filename>x.jpg</filename>{size}{objects}</annotation>"


def test_voc_with_its_folders(tmp_path: Path) -> None:
    (tmp_path / "Annotations").mkdir()
    (tmp_path / "ImageSets/Main").mkdir(parents=True)
    for k in range(11):
        write_picture(tmp_path / "JPEGImages" / f"{k}.png", k)
        (tmp_path / "Annotations" / f"{k}.xml").write_text(make_voc_document(make_boxes(k)))
    (tmp_path / "ImageSets/Main/train.txt").write_text("".join(f"{k}\n" for k in range(7)))
    (tmp_path / "ImageSets/Main/val.txt").write_text("".join(f"{k}\n" for k in range(7, 11)))
    (tmp_path / "ImageSets/Main/trainval.txt").write_text("".join(f"{k}\n" for k in range(11)))
    samples = read_samples(tmp_path, "voc")
    assert_boxes(samples, list(range(11)), apart_px=1)
    edges = [edge for peers in find_labels(samples) for p in peers for edge in p["box_px"]]
    assert edges == [float(int(e)) for k in range(11) for _, box in make_boxes(k) for e in box]
    content = find_format(tmp_path).content(tmp_path, Options())
    assert content.split == {"train": [(0, 600_000_000)], "val": [(700_000_000, 1_000_000_000)]}


@pytest.mark.heavy
def test_voc_as_supervision_reads_it(tmp_path: Path) -> None:
    sv = pytest.importorskip("supervision")
    for k in (1, 2):
        write_picture(tmp_path / "JPEGImages" / f"{k}.png", k)
        (tmp_path / "Annotations").mkdir(exist_ok=True)
        (tmp_path / "Annotations" / f"{k}.xml").write_text(make_voc_document(make_boxes(k)))
    theirs = sv.DetectionDataset.from_pascal_voc(
        str(tmp_path / "JPEGImages"), str(tmp_path / "Annotations")
    )
    want = [box for path in sorted(theirs.image_paths) for box in theirs.annotations[path].xyxy]
    ours = [p["box_px"] for peers in find_labels(read_samples(tmp_path, "voc")) for p in peers]
    np.testing.assert_allclose(ours, want)
    theirs.as_pascal_voc(str(tmp_path / "back/images"), str(tmp_path / "back/labels"))
    again = [
        p["box_px"] for peers in find_labels(read_samples(tmp_path / "back", "voc")) for p in peers
    ]
    np.testing.assert_allclose(again, want)


@pytest.mark.parametrize(
    "text",
    [
        "<annotation><object>",
        "<!DOCTYPE a [<!ENTITY b 'c'>]><annotation>&b;</annotation>",
        "<annotation><object><name>drone</name></object></annotation>",
        make_voc_document([("drone", (5, 5, 5, 9))]),
        make_voc_document(make_boxes(1)).replace("<xmin>", "<xmin>0_"),
    ],
)
def test_an_xml_file_that_is_broken_leaves_its_picture(text: str, tmp_path: Path) -> None:
    for k in (1, 2):
        write_picture(tmp_path / f"{k}.png", k)
        (tmp_path / f"{k}.xml").write_text(make_voc_document(make_boxes(k)) if k == 2 else text)
    (tmp_path / "3.xml").write_text(make_voc_document([]))
    with count_left_out() as counted:
        samples = read_samples(tmp_path, "voc")
    assert sum(s.message == "CompressedImage" for s in samples) == 2
    assert_boxes(samples, [2], apart_px=1)
    unreadable = "XML files that are not VOC's; their pictures have no labels"
    assert counted.counts == {unreadable: 1, "XML files without a picture": 1}


def test_pictures_of_one_name_have_the_labels_of_their_own_folders(tmp_path: Path) -> None:
    for k, (pictures, labels) in enumerate((("P/x", "Annotations/x"), ("P/y", "Annotations/y"))):
        write_picture(tmp_path / pictures / "1.png", k)
        (tmp_path / labels).mkdir(parents=True)
        (tmp_path / labels / "1.xml").write_text(make_voc_document(make_boxes(k)))
    write_picture(tmp_path / "P/z" / "1.png", 2)  # has no label file
    samples = read_samples(tmp_path, "voc")
    assert sum(s.message == "CompressedImage" for s in samples) == 3
    assert_boxes(samples, [0, 1], apart_px=1)
