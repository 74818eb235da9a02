"""Boxes of labels and detections, scored by COCO's rules."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import topics
from dmrl.errors import MissingExtra, MissingTopic
from dmrl.evaluation.detection_report import describe_evaluation, judge_boxes, print_evaluation
from dmrl.evaluation.detections import join_by_image
from dmrl.images.codec import encode_png
from dmrl.learn.inference.box_precision import BoxPrecision
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter
from dmrl.stages.evaluate import Settings, run

WIDTH_M = 0.2
PICTURE = message_class("CompressedImage")(
    data=encode_png(np.zeros((48, 64, 3), np.uint8)), format="png"
)
CAMERA = message_class("CameraCalibration")(width=64, height=48, K=[50, 0, 32, 0, 50, 24, 0, 0, 1])
Point = tuple[float, float, float]


Images = list[tuple[list[Point], list[Point]]]


def write_recording(path: Path, images: Images, calibrated: bool = True) -> Path:
    """Write a recording of images with (u, v, depth) of their labels and detections."""
    with RecordingWriter(path, Provenance("test")) as sink:
        if calibrated:
            sink.write(0, topics.CALIBRATION("cf1"), CAMERA)
        for k, sides in enumerate(images):
            peers, found = (
                [dict(zip(("u_px", "v_px", "depth_m"), point, strict=True)) for point in side]
                for side in sides
            )
            labels = [{**one, "source": "truth"} for one in peers]
            sink.write(k, topics.CAMERA_IMAGE("cf1"), PICTURE)
            sink.write(k, topics.LABELS("cf1"), message_class("PeerLabels")(peers=labels))
            seen = [{**one, "confidence": 0.9 - 0.1 * n} for n, one in enumerate(found)]
            sink.write(k, topics.DETECTIONS("cf1"), message_class("Detections")(detections=seen))
    return path


def judge(path: Path, images: Images, calibrated: bool = True) -> BoxPrecision:
    """Record and score images with (u, v, depth) of their labels and detections."""
    return judge_boxes(join_by_image([write_recording(path, images, calibrated)], "truth"), WIDTH_M)


def test_equal_boxes_have_full_precision(tmp_path: Path) -> None:
    point = (30.0, 20.0, 1.0)
    got = judge(tmp_path / "a.mcap", [([point], [point]), ([], [])])
    assert got.figures == {
        **dict.fromkeys(("ap", "ap50", "ap75", "ap_small", "ar"), pytest.approx(1)),
        **dict.fromkeys(("ap_medium", "ap_large")),
    }
    assert got.to_json() == {"robot_width_m": WIDTH_M, "images": 2, "left_out": 0, **got.figures}


def test_a_wrong_depth_shrinks_the_box(tmp_path: Path) -> None:
    # Intersection over union is (1 / 1.2)^2 = 0.69, which passes 0.5, 0.55, 0.6 and 0.65.
    got = judge(tmp_path / "a.mcap", [([(30.0, 20.0, 1.0)], [(30.0, 20.0, 1.2)])])
    assert (got.figures["ap"], got.figures["ar"]) == (pytest.approx(0.4), pytest.approx(0.4))
    assert (got.figures["ap50"], got.figures["ap75"]) == (pytest.approx(1), 0)


def test_boxes_end_at_the_border_of_the_image(tmp_path: Path) -> None:
    # Both boxes are 10 px wide; 5 and 2.5 px of them are in the image.
    got = judge(tmp_path / "a.mcap", [([(0.0, 20.0, 1.0)], [(-2.5, 20.0, 1.0)])])
    assert (got.figures["ap50"], got.figures["ap75"]) == (pytest.approx(1), 0)


def test_a_false_detection_in_an_empty_image_counts(tmp_path: Path) -> None:
    point = (30.0, 20.0, 1.0)
    images = [([point], [(5.0, 5.0, 1.0), point]), ([], [point])]
    assert judge(tmp_path / "a.mcap", images).figures["ap"] == pytest.approx(1 / 3, abs=0.01)


def test_without_detections_the_precision_is_zero(tmp_path: Path) -> None:
    got = judge(tmp_path / "a.mcap", [([(30.0, 20.0, 1.0)], [])])
    assert (got.figures["ap"], got.figures["ar"]) == (0, 0)


def test_an_image_with_a_label_without_depth_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    point, flat = (30.0, 20.0, 1.0), (10.0, 10.0, float("nan"))
    got = judge(tmp_path / "a.mcap", [([point], [point]), ([point, flat], [])])
    assert (got.images, got.left_out, got.figures["ap"]) == (1, 1, pytest.approx(1))
    got.print("seen.mcap")
    said = capsys.readouterr().out
    assert "seen.mcap: 1 images, boxes 0.2 m wide" in said
    assert "left out: images with a label without a depth: 1" in said


def test_a_recording_without_calibration_is_refused(tmp_path: Path) -> None:
    point = (30.0, 20.0, 1.0)
    with pytest.raises(MissingTopic, match="/cf1/camera/calibration"):
        judge(tmp_path / "a.mcap", [([point], [point])], calibrated=False)


def test_a_missing_package_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    none: Any = None
    monkeypatch.setitem(sys.modules, "pycocotools.coco", none)
    point = (30.0, 20.0, 1.0)
    with pytest.raises(MissingExtra, match=r"pip install 'dmrl\[coco\]'"):
        judge(tmp_path / "a.mcap", [([point], [point])])


@pytest.mark.heavy
def test_boxes_of_two_models_are_scored_separately(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    label = (30.0, 20.0, 1.0)
    paths = [
        write_recording(tmp_path / f"{depth_m}.mcap", [([label], [(30.0, 20.0, depth_m)])])
        for depth_m in (1.0, 1.2)
    ]
    settings = Settings(draws=5, robot_width_m=WIDTH_M)
    both = describe_evaluation(paths, run(paths, None, settings))
    assert [one["ap"] for one in both["boxes"]] == pytest.approx([1.0, 0.4])
    alone = describe_evaluation(paths[1:], run(paths[1:], None, settings))
    assert [one["ap"] for one in alone["boxes"]] == pytest.approx([0.4])
    assert "boxes" not in describe_evaluation(paths, run(paths, None, Settings(draws=5)))
    print_evaluation(paths, run(paths, None, settings))
    printed = capsys.readouterr().out.replace("\n", "")
    assert all(f"{path}: 1 images, boxes 0.2 m wide" in printed for path in paths)
