"""Messages are rewritten at the times of corrected clocks."""

from pathlib import Path
from typing import Any

import pytest

from dmrl import topics
from dmrl.estimation.signals.clock_estimation import Clock
from dmrl.labelling.clocks.retiming import MOCAP, Corrected
from dmrl.messages import message_class
from dmrl.recording import LoadedRecording, Provenance, RecordingWriter, read, read_raw

SECOND = 1_000_000_000
IMAGE, POSE, TRUTH = topics.CAMERA_IMAGE("cf1"), topics.POSE("cf1"), topics.TRUE_POSE("cf1")


def build_transforms(child: str) -> Any:
    """Return a message with the transform of one child frame."""
    return message_class("FrameTransforms")(transforms=[{"child_frame_id": child}])


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Write topics of two robots from 10 s, one message per second, published 7 ns later."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in (10, 11, 12):
            stamp = {"seconds": 1}
            for topic, made in (
                (topics.HEIGHT("cf1"), message_class("Height")(height_m=k)),
                (topics.HEIGHT("cf2"), message_class("Height")(height_m=k)),
                (IMAGE, message_class("CompressedImage")(timestamp=stamp, format="png")),
                (POSE, message_class("PoseInFrame")(timestamp=stamp)),
                (TRUTH, message_class("PoseInFrame")(timestamp=stamp)),
                (topics.TRANSFORMS, build_transforms("cf2/horizontal")),
            ):
                sink.write(k * SECOND, topic, made, publish_ns=k * SECOND + 7)
    return path


def read_times(path: Path, topic: str) -> list[int]:
    """Return the log times of a topic in ns."""
    return [raw.time_ns for raw in read_raw(path, topic)]


def write_corrected(held: Corrected, out: Path) -> Path:
    """Write a recording with corrected times; return its path."""
    with RecordingWriter(out, Provenance("test")) as sink:
        held.write(sink)
    return out


def test_each_clock_corrects_its_own_by_offset_and_drift(recording: Path, tmp_path: Path) -> None:
    clocks = {
        "cf1": Clock(0.5, 0.1, at_s=1.0),  # adds 0.5 s at 11 s, and 0.6 s at 12 s
        "cf1/camera": Clock(-0.25),
        MOCAP: Clock(2.0),
    }
    held = Corrected(LoadedRecording(recording), clocks, {})
    out = write_corrected(held, tmp_path / "b.mcap")
    own = [10_400_000_000, 11_500_000_000, 12_600_000_000]
    assert read_times(out, topics.HEIGHT("cf1")) == read_times(out, POSE) == own
    assert read_times(out, topics.HEIGHT("cf2")) == [10 * SECOND, 11 * SECOND, 12 * SECOND]
    assert read_times(out, IMAGE) == [9_750_000_000, 10_750_000_000, 11_750_000_000]
    assert read_times(out, TRUTH) == read_times(out, topics.TRANSFORMS)
    assert read_times(out, TRUTH) == [12 * SECOND, 13 * SECOND, 14 * SECOND]
    assert all(raw.publish_ns == raw.time_ns + 7 for raw in read_raw(out))
    for topic in (IMAGE, POSE, TRUTH):  # these messages also hold their own time
        for stamped in read(out, topic):
            said = stamped.message.timestamp
            assert said.seconds * SECOND + said.nanos == stamped.time_ns
    assert held.earliest_ns() == 9_750_000_000


def test_transforms_are_on_the_clock_of_their_robot(recording: Path, tmp_path: Path) -> None:
    held = Corrected(LoadedRecording(recording), {"cf2": Clock(-3.0)}, {})
    out = write_corrected(held, tmp_path / "b.mcap")
    assert read_times(out, topics.TRANSFORMS) == [7 * SECOND, 8 * SECOND, 9 * SECOND]
    assert read_times(out, topics.HEIGHT("cf1"))[0] == 10 * SECOND
    (first, *_) = read(out, topics.TRANSFORMS)
    assert first.message.transforms[0].timestamp.seconds == 7
    assert held.earliest_ns() == 7 * SECOND


def test_even_times_are_applied_before_clocks_and_a_common_shift(
    recording: Path, tmp_path: Path
) -> None:
    even = {IMAGE: {10 * SECOND: 9_900_000_000, 11 * SECOND: 10_900_000_000}}
    held = Corrected(LoadedRecording(recording), {"cf1": Clock(1.0)}, even, later_ns=5 * SECOND)
    out = write_corrected(held, tmp_path / "b.mcap")
    assert read_times(out, IMAGE) == [15_900_000_000, 16_900_000_000, 18 * SECOND]
    assert read_times(out, topics.HEIGHT("cf1"))[0] == 16 * SECOND
    assert read_times(out, topics.HEIGHT("cf2"))[0] == 15 * SECOND
    assert read_times(out, topics.TRANSFORMS)[0] == 15 * SECOND
    assert held.earliest_ns() == 15 * SECOND
