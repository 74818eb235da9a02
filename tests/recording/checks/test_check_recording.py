"""Findings of check, from recordings with one fault each."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

from dmrl.images.codec import encode_png
from dmrl.messages import message_class, serialize_schema
from dmrl.recording import Provenance, RecordingWriter, check
from dmrl.recording.checks import check_recording
from dmrl.recording.checks.check_recording import print_findings

STRIPES = np.tile(np.arange(320, dtype=np.uint8) % 200, (224, 1))
PNGS = [encode_png(np.repeat((STRIPES + k)[..., None], 3, 2)) for k in range(2)]
PNG = PNGS[0]
Write = Callable[[int, str, Any], None]


def record_and_check(path: Path, fill: Callable[[Write], None]) -> list[str]:
    """Write a recording with ``fill`` and return its findings, each as "level topic text"."""
    with RecordingWriter(path, Provenance("test")) as sink:
        fill(sink.write)
    return [f"{f.level} {f.topic} {f.text}" for f in check(path)]


def build_calibration(width: int = 320, height: int = 224, **other: Any) -> Any:
    """Build a calibration with the principal point in the middle of the image."""
    numbers = {"K": [180, 0, width / 2, 0, 180, height / 2, 0, 0, 1]} | other
    return message_class("CameraCalibration")(width=width, height=height, **numbers)


def build_image(data: bytes = PNG) -> Any:
    return message_class("CompressedImage")(data=data, format="png")


def build_label(u_px: float, v_px: float, *, source: str = "truth", box: bool = True) -> Any:
    """Build a label of cf2 at 1 m, with a box of 20 x 12 px around its pixel."""
    return message_class("PeerLabel")(
        peer="cf2",
        u_px=u_px,
        v_px=v_px,
        depth_m=1.0,
        source=source,
        box_px=[u_px - 10, v_px - 6, u_px + 10, v_px + 6] if box else [],
    )


def write_labelled_images(write: Write, shift_v_px: float = 0.0) -> None:
    """Write 40 images, each with a true label and one of another source.

    The other label has noise of 1 px and is shifted downwards by ``shift_v_px``.
    """
    write(0, "/cf1/camera/calibration", build_calibration())
    rng = np.random.default_rng(0)
    for k in range(40):
        u_px, v_px = rng.uniform(50, 170, 2)
        true, other = build_label(u_px, v_px), build_label(u_px, v_px, source="published")
        other.u_px += rng.normal(0, 1)
        other.v_px += shift_v_px + rng.normal(0, 1)
        write(k * 10**9, "/cf1/camera/image", build_image(PNGS[k % 2]))
        write(k * 10**9, "/cf1/labels", message_class("PeerLabels")(peers=[true, other]))


def test_valid_recording_has_no_findings(tmp_path: Path) -> None:
    assert record_and_check(tmp_path / "a.mcap", write_labelled_images) == []


def test_label_bias_is_reported_in_one_line(tmp_path: Path) -> None:
    (finding,) = record_and_check(
        tmp_path / "a.mcap", lambda write: write_labelled_images(write, shift_v_px=10.0)
    )
    assert finding.startswith("warning /cf1/labels labels of source 'published' are biased:")
    assert "+10." in finding or "+9." in finding
    assert "\n" not in finding


def test_times_that_go_back_repeat_or_leave_gaps_are_found(tmp_path: Path) -> None:
    times_s = [*range(20), 15, 15, 15, *range(60, 70)]

    def fill(write: Write) -> None:
        for time_s in times_s:
            write(time_s * 10**9, "/cf1/height", message_class("Height")())

    findings = record_and_check(tmp_path / "a.mcap", fill)
    assert "warning /cf1/height 1 messages go back in time, by up to 4.000 s" in findings
    assert "warning /cf1/height 2 messages repeat the time before them" in findings
    assert any("1 gaps, the longest 45.000 s" in f for f in findings)


def test_clocks_that_share_no_time_are_found(tmp_path: Path) -> None:
    def fill(write: Write) -> None:
        for k in range(20):
            write(k * 10**9, "/cf1/height", message_class("Height")())
            write(k * 10**9, "/cf1/velocity", message_class("Velocity")())
            write((k + 56) * 10**9, "/cf2/height", message_class("Height")())
            write((k + 119) * 10**9, "/cf1/range/cf2", message_class("UwbRange")())

    assert record_and_check(tmp_path / "a.mcap", fill) == [
        "warning /cf1/range/cf2 shares no time with the robot's other topics: 100 s between",
    ]

    def write_two_robots(write: Write) -> None:
        for k in range(20):
            write(k * 10**9, "/cf1/height", message_class("Height")())
            write((k + 56) * 10**9, "/cf2/height", message_class("Height")())

    assert record_and_check(tmp_path / "b.mcap", write_two_robots) == [
        "warning /cf1 shares no time with /cf2: 37 s between. Separate clocks? Try: dmrl align"
    ]


def test_times_and_stamps_of_zero_are_found(tmp_path: Path) -> None:
    def fill(write: Write) -> None:
        pose = message_class("PoseInFrame")
        now_s = 1_800_000_000
        for k in range(3):
            moment = {"seconds": now_s + k}
            write((now_s + k) * 10**9, "/cf1/pose", pose(timestamp=moment))
            write((now_s + k) * 10**9, "/cf1/pose/truth", pose(timestamp={}))
        write(0, "/cf1/height", message_class("Height")())

    findings = record_and_check(tmp_path / "a.mcap", fill)
    assert findings == [
        "warning /cf1/height 1 messages are at time 0, others of the recording after 2001",
        "warning /cf1/pose/truth 3 messages have a time stamp of 0",
    ]


@pytest.mark.parametrize(
    ("bad", "complaint"),
    [
        (
            build_label(400.0, 50.0),
            "warning /cf1/labels 1 of 1 labels of source 'truth' lie outside",
        ),
        (
            message_class("PeerLabel")(u_px=5, v_px=5, source="hand"),
            "error /cf1/labels 1 labels of source",
        ),
        (
            build_label(float("nan"), 5.0),
            "error /cf1/labels 1 labels of source 'truth' have no pixel",
        ),
    ],
    ids=["outside", "no depth", "not a number"],
)
def test_impossible_labels_are_found(tmp_path: Path, bad: Any, complaint: str) -> None:
    def fill(write: Write) -> None:
        write(0, "/cf1/camera/calibration", build_calibration())
        write(0, "/cf1/camera/image", build_image())
        write(0, "/cf1/labels", message_class("PeerLabels")(peers=[bad]))

    assert any(f.startswith(complaint) for f in record_and_check(tmp_path / "a.mcap", fill))


def test_labels_without_their_image_are_found(tmp_path: Path) -> None:
    def fill(write: Write) -> None:
        write(0, "/cf1/camera/calibration", build_calibration())
        write(0, "/cf1/camera/image", build_image())
        write(5, "/cf1/labels", message_class("PeerLabels")())

    (finding,) = record_and_check(tmp_path / "a.mcap", fill)
    assert finding == "error /cf1/labels 1 of 1 messages have no image at their time"


def test_an_empty_recording_is_an_error(tmp_path: Path) -> None:
    assert record_and_check(tmp_path / "a.mcap", lambda _: None) == [
        "error  the recording has no messages"
    ]


def test_topic_without_messages_gives_no_finding(tmp_path: Path) -> None:
    """Other writers may define topics on which they never send a message."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, name in (
            ("/cf1/camera/image", "CompressedImage"),
            ("/cf1/camera/calibration", "CameraCalibration"),
            ("/cf1/labels", "PeerLabels"),
        ):
            full = message_class(name).DESCRIPTOR.full_name
            schema = writer.register_schema(full, "protobuf", serialize_schema(name))
            channel = writer.register_channel(topic, "protobuf", schema)
        empty = message_class("PeerLabels")(peers=[build_label(5.0, 5.0)]).SerializeToString()
        writer.add_message(channel, 0, empty, 0)
        writer.finish()
    assert [f.text for f in check(path)] == ["1 of 1 messages have no image at their time"]


@pytest.mark.parametrize(
    ("period_s", "hole_s", "found"),
    [(0.1, 0.95, 0), (0.1, 1.05, 1), (0.01, 0.45, 0), (0.01, 0.55, 1)],
)
def test_a_gap_is_ten_periods_long_and_half_a_second(
    tmp_path: Path, period_s: float, hole_s: float, found: int
) -> None:
    def fill(write: Write) -> None:
        for k in range(40):
            time_s = k * period_s + (hole_s - period_s) * (k >= 20)
            write(round(time_s * 1e9), "/cf1/height", message_class("Height")())

    findings = record_and_check(tmp_path / "a.mcap", fill)
    assert len(findings) == found
    assert all(
        f"1 gaps, the longest {hole_s:.3f} s; the usual period: {period_s:.3f}" in f
        for f in findings
    )


def test_gaps_are_found_from_ten_periods_on(tmp_path: Path) -> None:
    for steps, found in ((9, 0), (10, 1)):
        moments = [*range(steps), steps + 50]

        def fill(write: Write, moments: list[int] = moments) -> None:
            for moment in moments:
                write(moment * 10**9, "/cf1/height", message_class("Height")())

        assert len(record_and_check(tmp_path / f"{steps}.mcap", fill)) == found


def check_shifted_labels(path: Path, off_px: list[tuple[float, float]]) -> list[str]:
    """Write images with labels at these (u, v) offsets from their box centres; return findings."""

    def fill(write: Write) -> None:
        write(0, "/cf1/camera/calibration", build_calibration())
        for k, (u_px, v_px) in enumerate(off_px):
            peer = build_label(100.0, 100.0)
            peer.u_px += u_px
            peer.v_px += v_px
            write(k * 10**9, "/cf1/camera/image", build_image(PNGS[k % 2]))
            write(k * 10**9, "/cf1/labels", message_class("PeerLabels")(peers=[peer]))

    return record_and_check(path, fill)


@pytest.mark.heavy
def test_bias_is_judged_by_its_standard_error(tmp_path: Path) -> None:
    def spread(middle_px: float, by_px: float) -> list[float]:
        return [middle_px + by_px * (-1) ** k for k in range(40)] + [middle_px]

    # MAD = by_px, so the standard error is 1.2533 * 1.4826 * by_px / sqrt(41).
    (finding,) = check_shifted_labels(tmp_path / "a.mcap", [(0.1, v) for v in spread(3, 2)])
    assert "+0.1 px in u and +3.0 px in v" in finding
    assert "(median of 41, standard error 0.00 and 0.58 px)" in finding
    far = [(u, 0.0) for u in spread(3, 2.2)]  # 3 px are less than five standard errors, 3.19 px
    assert check_shifted_labels(tmp_path / "b.mcap", far) == []
    small = [(1.4, -1.4)] * 41
    assert check_shifted_labels(tmp_path / "c.mcap", small) == []
    few = [(9.0, 9.0)] * 19
    assert check_shifted_labels(tmp_path / "d.mcap", few) == []
    assert len(check_shifted_labels(tmp_path / "e.mcap", [(9.0, 9.0)] * 20)) == 1


def test_check_after_writing_skips_images(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.write(0, "/cf1/camera/image", build_image(b"no image"))
        for topic in ("/cf1/height", "/cf1/velocity", "/cf1/attitude"):
            kind = message_class(topic.rpartition("/")[2].title())
            for second in (*range(12), 99):
                sink.write(second * 10**9, topic, kind())
    monkeypatch.setattr(check_recording, "FINDINGS_PRINTED_MAX", 2)
    print_findings(path)
    output = capsys.readouterr().err.splitlines()
    assert len(output) == 3
    assert all("1 gaps, the longest 88.000 s" in line for line in output[:2])
    assert output[-1] == f"1 more: dmrl check {path}"


@pytest.mark.parametrize("topic", ["height", "camera/calibration", "labels", "camera/image"])
def test_check_after_writing_never_fails(
    topic: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The recording is complete by then, so errors of the check are only printed."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema(
            "dmrl.v1.Velocity", "protobuf", serialize_schema("Velocity")
        )
        channel = writer.register_channel(f"/cf2/{topic}", "protobuf", schema)
        writer.add_message(channel, 0, b"", 0)
        writer.finish()
    print_findings(path)
    assert f"/cf2/{topic}" in capsys.readouterr().err


@pytest.mark.heavy
def test_boxes_cut_by_the_image_edge_are_ignored_for_bias(tmp_path: Path) -> None:
    def fill(write: Write, left_px: float, right_px: float) -> None:
        write(0, "/cf1/camera/calibration", build_calibration())
        for k in range(40):
            box = [left_px, 50, right_px, 70]
            peer = message_class("PeerLabel")(
                u_px=100, v_px=60, depth_m=1, source="hand", box_px=box
            )
            write(k * 10**9, "/cf1/camera/image", build_image(PNGS[k % 2]))
            write(k * 10**9, "/cf1/labels", message_class("PeerLabels")(peers=[peer]))

    for k, (left_px, right_px, found) in enumerate(
        [(1.5, 100, 1), (1, 100, 0), (100, 318.5, 1), (100, 319, 0)]
    ):
        filled = partial(fill, left_px=left_px, right_px=right_px)
        assert len(record_and_check(tmp_path / f"{k}.mcap", filled)) == found


def test_unknown_topics_are_not_checked(tmp_path: Path) -> None:
    def fill(write: Write) -> None:
        for k in range(3):
            write(k, "/cf1/own", message_class("Height")())

    assert record_and_check(tmp_path / "a.mcap", fill) == []


def test_zero_stamp_counts_only_if_present_and_different_from_log_time(
    tmp_path: Path,
) -> None:
    def fill(write: Write) -> None:
        pose = message_class("PoseInFrame")
        write(0, "/cf1/pose", pose(timestamp={}))
        write(5, "/cf1/pose", pose())
        write(6, "/cf1/pose", pose(timestamp={"nanos": 6}))
        write(7, "/cf1/pose", pose(timestamp={"seconds": 1}))
        write(8, "/cf1/pose", pose(timestamp={}))

    assert record_and_check(tmp_path / "a.mcap", fill) == [
        "warning /cf1/pose 1 messages have a time stamp of 0"
    ]


def test_maps_of_another_size_than_they_state_are_reported(tmp_path: Path) -> None:
    def fill(write: Write) -> None:
        for k, size in enumerate((48, 48, 44, 0)):
            made = message_class("GridMap")(
                rows=2, cols=3, channels=["a", "b"], data=bytes(size), stride_px=8
            )
            write(k, "/cf1/detections/grid", made)

    (found,) = record_and_check(tmp_path / "a.mcap", fill)
    assert found.startswith("error /cf1/detections/grid 2 maps do not have 4 bytes for each cell")
