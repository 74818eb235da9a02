"""Pairing of labels and detections, and which images count."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import topics
from dmrl.errors import RecordingError
from dmrl.evaluation.detections import LabelledDetections, join_by_image
from dmrl.images.codec import encode_png
from dmrl.messages import STATUS_AMBIGUOUS, STATUS_OK, message_class
from dmrl.recording import SPLIT_METADATA, Provenance, RecordingWriter

PICTURE = message_class("CompressedImage")(
    data=encode_png(np.zeros((48, 64, 3), np.uint8)), format="png"
)
Image = tuple[Sequence[Any], Sequence[Any], Sequence[str]]


def label(u_px: float, v_px: float = 20.0, source: str = "truth", status: int = STATUS_OK) -> Any:
    fields = {"u_px": u_px, "v_px": v_px, "depth_m": 1.0, "source": source, "status": status}
    return message_class("PeerLabel")(**fields)


def found(u_px: float, confidence: float) -> Any:
    return {"u_px": u_px, "v_px": 20.0, "depth_m": 2.0, "confidence": confidence}


def joined(path: Path, images: Sequence[Image], **options: Any) -> LabelledDetections:
    """Images with their labels, detections and who looked, one a nanosecond."""
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.add_metadata(SPLIT_METADATA, {"train": "[[0, 1]]", "test": "[[2, 2], [4, 9]]"})
        for k, (peers, detections, looked) in enumerate(images):
            sink.write(k, topics.CAMERA_IMAGE("cf1"), PICTURE)
            labels = message_class("PeerLabels")(peers=peers, sources=looked)
            sink.write(k, topics.LABELS("cf1"), labels)
            seen = message_class("Detections")(detections=detections, threshold=0.4)
            sink.write(k, topics.DETECTIONS("cf1"), seen)
    return join_by_image([path], "truth", **options)


def test_detections_come_best_first_however_they_were_written(tmp_path: Path) -> None:
    images: list[Image] = [
        ([label(10)], [found(1, 0.2), found(2, 0.9), found(3, 0.5)], ()),
        ([label(30)], [found(5, 0.1), found(4, 0.8)], ()),
    ]
    pairs = joined(tmp_path / "a.mcap", images)
    assert pairs.detections.image.tolist() == [0, 0, 0, 1, 1]
    assert pairs.detections.u_px.tolist() == [2, 3, 1, 4, 5]
    assert pairs.detections.confidence == pytest.approx([0.9, 0.5, 0.2, 0.8, 0.1])
    assert (pairs.labels.image.tolist(), pairs.labels.u_px.tolist()) == ([0, 1], [10, 30])
    assert pairs.labels.confidence.tolist() == [1, 1]
    assert pairs.threshold == pytest.approx(0.4)


def test_image_counts_if_the_source_labelled_it_and_all_labels_are_ok(tmp_path: Path) -> None:
    images: list[Image] = [
        ([label(1)], [], ()),
        ([label(2, source="hand")], [], ()),  # nobody knows whether truth looked
        ([label(3, source="hand")], [], ("truth",)),  # it looked, and saw nobody
        ([], [], ()),  # nobody said who looked: an image without anybody
        ([label(5), label(6, status=STATUS_AMBIGUOUS)], [], ()),
        ([label(7), label(8, source="hand", status=STATUS_AMBIGUOUS)], [], ()),
        ([label(64), label(63.9), label(-0.1), label(9, v_px=48), label(0, v_px=0)], [], ()),
    ]
    pairs = joined(tmp_path / "a.mcap", images)
    assert [at.time_ns for at in pairs.at] == [0, 2, 3, 5, 6]
    assert pairs.labels.image.tolist() == [0, 3, 4, 4]
    assert pairs.labels.u_px == pytest.approx([1, 7, 63.9, 0])
    assert pairs.left_out == {
        "images with labels from other sources only": 1,
        "images with a label that is not OK": 1,
        "labels outside their image": 3,
    }


@pytest.mark.parametrize(("split", "times"), [("train", [0, 1]), ("test", [2, 4, 5])])
def test_split_spans_include_both_ends(tmp_path: Path, split: str, times: list[int]) -> None:
    images: list[Image] = [([label(k + 1)], [], ()) for k in range(6)]
    pairs = joined(tmp_path / "a.mcap", images, split=split)
    assert [at.time_ns for at in pairs.at] == times


def with_second_message(path: Path, topic: str, kind: str, **fields: Any) -> LabelledDetections:
    """One image with one label and one detection, and a second message on a topic."""
    first = {"peer": "cf2", "u_px": 10.0, "v_px": 20.0, "depth_m": 1.0, "source": "truth"}
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.write(1, topics.CAMERA_IMAGE("cf1"), PICTURE)
        sink.write(1, topics.LABELS("cf1"), message_class("PeerLabels")(peers=[first]))
        seen = message_class("Detections")(detections=[found(10, 0.9)])
        sink.write(1, topics.DETECTIONS("cf1"), seen)
        sink.write(1, topic, message_class(kind)(**fields))
    return join_by_image([path], "truth")


def test_labels_that_a_merge_doubled_count_once(tmp_path: Path) -> None:
    same = {"peer": "cf2", "u_px": 10.0, "v_px": 20.0, "depth_m": 1.0, "source": "truth"}
    more = [same, same | {"peer": "cf3", "u_px": 40.0}, same | {"source": "estimate"}]
    pairs = with_second_message(tmp_path / "a.mcap", "/cf1/labels", "PeerLabels", peers=more)
    assert pairs.labels.u_px.tolist() == [10, 40]
    with pytest.raises(RecordingError, match="at 1 ns has different labels of cf2 from truth"):
        with_second_message(
            tmp_path / "b.mcap", "/cf1/labels", "PeerLabels", peers=[same | {"u_px": 11.0}]
        )


def test_two_messages_of_detections_of_an_image_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="/cf1/detections has two messages at 1 ns"):
        with_second_message(
            tmp_path / "a.mcap", "/cf1/detections", "Detections", detections=[found(40, 0.5)]
        )
