"""`dmrl align` by ranges and by steady image rates."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import RecordingError, SettingError
from dmrl.messages import message_class
from dmrl.recording import (
    RecordingWriter,
    build_provenance,
    check,
    read,
    read_raw,
    read_summary,
    read_table,
)
from dmrl.stages.align import METADATA, Settings, run


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Return ranges of two robots over a minute; cf2's clock is off by -29.92 s and 20 ppm fast."""
    path, rng = tmp_path / "in.mcap", np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.03, 0.05, 1500))
    measured = 3 + 0.5 * np.sin(time) + 0.4 * np.sin(1.7 * time) + rng.normal(0, 0.05, len(time))
    with RecordingWriter(path, build_provenance("test")) as sink:
        for moment, value in zip((time + 30).tolist(), measured.tolist(), strict=True):
            other = moment - 30 + 0.080 + 20e-6 * (moment - 60)
            ranged = message_class("UwbRange")(range_m=value)
            sink.write(round(moment * 1e9), "/cf1/range/cf2", ranged)
            sink.write(round(other * 1e9), "/cf2/range/cf1", ranged)
            sink.write(round(other * 1e9), "/cf2/height", message_class("Height")(height_m=moment))
        picture = message_class("CompressedImage")(timestamp={"seconds": 1})
        sink.write(10**9, "/cf2/camera/image", picture)
        frame = {"parent_frame_id": "world", "child_frame_id": "cf2/horizontal"}
        sink.write(10**9, "/tf", message_class("FrameTransforms")(transforms=[frame]))
    return path


@pytest.mark.heavy
def test_all_topics_of_a_robot_are_aligned_to_the_reference_clock(
    recording: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.mcap"
    clocks = run(recording, out, Settings())
    assert clocks["cf2"].offset_s == pytest.approx(29.92, abs=0.002)
    assert clocks["cf2"].drift == pytest.approx(-20e-6, abs=5e-6)
    heights = read_table(out, "/cf2/height")
    error = heights["log_time"].to_numpy() * 1e-9 - heights["height_m"].to_numpy()
    assert np.abs(error).max() < 0.001
    (image,) = read(out, "/cf2/camera/image")
    stamp = image.message.timestamp
    assert stamp.seconds * 10**9 + stamp.nanos == image.time_ns
    (frames,) = read(out, "/tf")
    assert frames.time_ns == image.time_ns
    before = read_table(recording, "/cf1/range/cf2")["log_time"]
    assert read_table(out, "/cf1/range/cf2")["log_time"].equals(before)
    (told,) = read_summary(out).metadata[METADATA]
    assert told.keys() == {"cf1", "cf2"}
    assert not [f for f in check(out) if f.level == "error" and "image" not in f.topic]


def test_all_robots_are_shifted_if_one_would_begin_before_zero(
    recording: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.mcap"
    run(recording, out, Settings(reference="cf2"))
    assert read_summary(out).start_ns >= 0
    ranges = [
        read_table(out, t)["log_time"].to_numpy() for t in ("/cf1/range/cf2", "/cf2/range/cf1")
    ]
    assert np.abs(ranges[0] - ranges[1]).max() < 1_000_000


def test_times_stay_where_no_robot_would_begin_before_zero(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only cf1's times are moved, by 30 s to about 10 s. That is after zero."""
    late = tmp_path / "late.mcap"
    with RecordingWriter(late, build_provenance("test")) as sink:
        sink.write(10**9, "/cf2/height", message_class("Height")())
        for raw in read_raw(recording, "/cf1/range/cf2", "/cf2/range/cf1"):
            sink.write_raw(replace(raw, time_ns=raw.time_ns + 10**10))
    out = tmp_path / "out.mcap"
    clocks = run(late, out, Settings(reference="cf2"))
    assert clocks.keys() == read_summary(out).metadata[METADATA][0].keys() == {"cf1", "cf2"}
    assert capsys.readouterr().err == ""
    before, after = (read_table(p, "/cf2/range/cf1", fields=())["log_time"] for p in (late, out))
    assert after.equals(before)


@pytest.mark.heavy
def test_shift_of_all_times_is_reported_and_recorded(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with RecordingWriter(tmp_path / "early.mcap", build_provenance("test")) as sink:
        for raw in read_raw(recording):
            sink.write_raw(raw)
        sink.write(0, "/cf1/height", message_class("Height")())
    out = tmp_path / "out.mcap"
    clocks = run(tmp_path / "early.mcap", out, Settings(reference="cf2"))
    assert clocks["*"].offset_s == pytest.approx(29.92, abs=0.01)
    assert "all times are moved by 29.9" in capsys.readouterr().err
    told = json.loads(read_summary(out).metadata[METADATA][0]["*"])
    assert told["offset_s"] == clocks["*"].offset_s
    assert read_summary(out).start_ns == 0


def test_recording_that_cannot_be_aligned_gives_one_line_error(
    recording: Path, tmp_path: Path
) -> None:
    with pytest.raises(SettingError, match=r"--reference cf9: no such robot .* Known: cf1"):
        run(recording, tmp_path / "out.mcap", Settings(reference="cf9"))
    alone = tmp_path / "alone.mcap"
    with RecordingWriter(alone, build_provenance("test")) as sink:
        for k in range(30):
            sink.write(k * 10**9, "/cf1/range/cf2", message_class("UwbRange")(range_m=1.0))
    with pytest.raises(RecordingError, match="in common with cf1"):
        run(alone, tmp_path / "out.mcap", Settings())
    assert not (tmp_path / "out.mcap").exists()


def test_pictures_stamped_on_arrival_get_even_times(tmp_path: Path) -> None:
    path, out, rng = tmp_path / "in.mcap", tmp_path / "out.mcap", np.random.default_rng(1)
    sent = 10**10 + np.arange(400) * 50_000_000
    arrival = sent + rng.exponential(2e6, 400).astype(int)
    with RecordingWriter(path, build_provenance("test")) as sink:
        for moment in arrival.tolist():
            sink.write(moment, "/cf1/camera/image", message_class("CompressedImage")(data=b"x"))
    assert run(path, out, Settings(steady_cameras=True)) == {}
    table = read_table(out, "/cf1/camera/image", fields=[])
    assert np.abs(table["log_time"].to_numpy() - sent).max() < 100_000
    assert table["publish_time"].to_pylist() == arrival.tolist()


def test_labelled_pictures_keep_their_times(tmp_path: Path) -> None:
    path = tmp_path / "in.mcap"
    with RecordingWriter(path, build_provenance("test")) as sink:
        sink.write(1, "/cf1/camera/image", message_class("CompressedImage")(data=b"x"))
        sink.write(1, "/cf1/labels", message_class("PeerLabels")())
    with pytest.raises(SettingError, match=r"has labels already\. Align before that"):
        run(path, tmp_path / "out.mcap", Settings(steady_cameras=True))
