"""Labels and detections are joined by image; images with uncertain labels do not count."""

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


def build_label(
    u_px: float, v_px: float = 20.0, source: str = "truth", status: int = STATUS_OK
) -> Any:
    """Return the label of a peer 1 m away."""
    fields = {"u_px": u_px, "v_px": v_px, "depth_m": 1.0, "source": source, "status": status}
    return message_class("PeerLabel")(**fields)


def build_detection(u_px: float, confidence: float) -> Any:
    """Return a detection 2 m away."""
    return {"u_px": u_px, "v_px": 20.0, "depth_m": 2.0, "confidence": confidence}


def write_and_join(path: Path, images: Sequence[Image], **options: Any) -> LabelledDetections:
    """Write images with labels, detections and labelling sources, 1 ns apart, and join them."""
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
        (
            [build_label(10)],
            [build_detection(1, 0.2), build_detection(2, 0.9), build_detection(3, 0.5)],
            (),
        ),
        ([build_label(30)], [build_detection(5, 0.1), build_detection(4, 0.8)], ()),
    ]
    pairs = write_and_join(tmp_path / "a.mcap", images)
    assert pairs.detections.image.tolist() == [0, 0, 0, 1, 1]
    assert pairs.detections.u_px.tolist() == [2, 3, 1, 4, 5]
    assert pairs.detections.confidence == pytest.approx([0.9, 0.5, 0.2, 0.8, 0.1])
    assert (pairs.labels.image.tolist(), pairs.labels.u_px.tolist()) == ([0, 1], [10, 30])
    assert pairs.labels.confidence.tolist() == [1, 1]
    assert pairs.threshold == pytest.approx(0.4)


def test_image_counts_if_the_source_labelled_it_and_all_labels_are_ok(tmp_path: Path) -> None:
    images: list[Image] = [
        ([build_label(1)], [], ()),
        ([build_label(2, source="hand")], [], ()),  # it is unknown whether truth labelled it
        ([build_label(3, source="hand")], [], ("truth",)),  # truth labelled it: no peer
        ([], [], ()),  # no label and no sources: an image without a peer
        ([build_label(5), build_label(6, status=STATUS_AMBIGUOUS)], [], ()),
        ([build_label(7), build_label(8, source="hand", status=STATUS_AMBIGUOUS)], [], ()),
        (
            [
                build_label(64),
                build_label(63.9),
                build_label(-0.1),
                build_label(9, v_px=48),
                build_label(0, v_px=0),
            ],
            [],
            (),
        ),
    ]
    pairs = write_and_join(tmp_path / "a.mcap", images)
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
    images: list[Image] = [([build_label(k + 1)], [], ()) for k in range(6)]
    pairs = write_and_join(tmp_path / "a.mcap", images, split=split)
    assert [at.time_ns for at in pairs.at] == times


def join_with_second_message(
    path: Path, topic: str, kind: str, **fields: Any
) -> LabelledDetections:
    """Write an image with a label and a detection, and a second message on a topic; join them."""
    first = {"peer": "cf2", "u_px": 10.0, "v_px": 20.0, "depth_m": 1.0, "source": "truth"}
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.write(1, topics.CAMERA_IMAGE("cf1"), PICTURE)
        sink.write(1, topics.LABELS("cf1"), message_class("PeerLabels")(peers=[first]))
        seen = message_class("Detections")(detections=[build_detection(10, 0.9)])
        sink.write(1, topics.DETECTIONS("cf1"), seen)
        sink.write(1, topic, message_class(kind)(**fields))
    return join_by_image([path], "truth")


def test_labels_duplicated_by_a_merge_count_once(tmp_path: Path) -> None:
    same = {"peer": "cf2", "u_px": 10.0, "v_px": 20.0, "depth_m": 1.0, "source": "truth"}
    more = [same, same | {"peer": "cf3", "u_px": 40.0}, same | {"source": "estimate"}]
    pairs = join_with_second_message(tmp_path / "a.mcap", "/cf1/labels", "PeerLabels", peers=more)
    assert pairs.labels.u_px.tolist() == [10, 40]
    with pytest.raises(RecordingError, match="at 1 ns has different labels of cf2 from truth"):
        join_with_second_message(
            tmp_path / "b.mcap", "/cf1/labels", "PeerLabels", peers=[same | {"u_px": 11.0}]
        )


def test_two_messages_of_detections_of_an_image_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="/cf1/detections has two messages at 1 ns"):
        join_with_second_message(
            tmp_path / "a.mcap",
            "/cf1/detections",
            "Detections",
            detections=[build_detection(40, 0.5)],
        )
