"""Copying by chunk: which chunks are copied as they are, sliced, or refused."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import RecordingError
from dmrl.messages import message_class
from dmrl.recording import (
    Provenance,
    RecordingWriter,
    merge,
    read_raw,
    read_summary,
    recover,
    rewrite,
    trim,
)
from dmrl.recording.mcap.batch_reader import iter_batches_in_file_order
from dmrl.recording.mcap.chunks import chunk_reader
from dmrl.samples.sample import Sample

from ..records import (
    assert_messages_unchanged,
    read_channel_topics,
    read_chunk_indexes,
    read_chunk_records,
)

pytestmark = pytest.mark.heavy

MADE = Provenance("test")
MOMENTS = 6000


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write attitude and height of two robots, and an image of 3 kB at every tenth moment."""
    path = tmp_path_factory.mktemp("copying") / "flight.mcap"
    rng = np.random.default_rng(0)
    with RecordingWriter(path, MADE) as sink:
        sink.write(0, "/cf1/camera/calibration", message_class("CameraCalibration")(width=320))
        for k in range(MOMENTS):
            for robot in ("cf1", "cf2"):
                turn = message_class("Attitude")(roll_rad=rng.normal(), pitch_rad=rng.normal())
                sink.write(k, f"/{robot}/attitude", turn, publish_ns=k + 3)
                sink.write(k, f"/{robot}/height", message_class("Height")(height_m=rng.normal()))
            if k % 10 == 0:
                picture = message_class("CompressedImage")(data=rng.bytes(3000), format="jpeg")
                sink.write(k, "/cf1/camera/image", picture)
        sink.add_metadata("dmrl.split", {"train": "[[0, 10]]"})
    return path


def test_rewrite_copies_whole_chunks_in_one_pass(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[int] = []
    unpacked = chunk_reader.decompress
    monkeypatch.setattr(
        chunk_reader, "decompress", lambda c, at: opened.append(at) or unpacked(c, at)
    )
    fresh = [Sample(k * 100, "/cf1/labels", "PeerLabels", {}) for k in range(20)]
    out = tmp_path / "out.mcap"
    rewrite(flight, out, MADE, without=(), fresh=[fresh])
    assert len(opened) == len(set(opened)) == len(read_chunk_indexes(flight)) > 8
    assert (
        len(set(read_chunk_records(flight)) & set(read_chunk_records(out)))
        >= len(read_chunk_indexes(flight)) - 2
    )
    assert_messages_unchanged(flight, out, list(read_summary(flight).topics))
    assert [r for r in read_raw(out) if r.topic != "/cf1/labels"] == list(read_raw(flight))
    assert [raw.time_ns for raw in read_raw(out, "/cf1/labels")] == [m.time_ns for m in fresh]


def test_omitting_a_topic_keeps_the_rest_bit_for_bit(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    rewrite(flight, out, MADE, without=["/cf2/attitude"], fresh=())
    kept = [topic for topic in read_summary(flight).topics if topic != "/cf2/attitude"]
    assert list(read_summary(out).topics) == kept
    assert_messages_unchanged(flight, out, kept)


def test_trim_copies_whole_chunks_within_the_span(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    assert trim(flight, out, start_ns=1000, end_ns=3000) == 2000 * 4 + 201
    ours = [r for r in read_raw(flight) if 1000 <= r.time_ns < 3000]
    assert list(read_raw(out))[1:] == ours
    assert len(set(read_chunk_records(flight)) & set(read_chunk_records(out))) >= 2


def test_span_from_a_chunk_start_includes_channel_definitions(flight: Path, tmp_path: Path) -> None:
    for k, chunk in enumerate(read_chunk_indexes(flight)[2:4]):
        out, start_ns = tmp_path / f"{k}.mcap", chunk.message_start_time
        trim(flight, out, start_ns=start_ns, topics=["/*/attitude", "/*/height"])
        ours = [r for r in read_raw(flight, "/*/attitude", "/*/height") if r.time_ns >= start_ns]
        assert list(read_raw(out)) == ours
        cut = out.with_suffix(".cut.mcap")
        cut.write_bytes(out.read_bytes()[:-100])  # without its summary
        recover(cut, tmp_path / f"{k}.whole.mcap")
        assert read_summary(tmp_path / f"{k}.whole.mcap").count == len(ours)


def test_merging_trimmed_parts_restores_the_recording(flight: Path, tmp_path: Path) -> None:
    parts = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    trim(flight, parts[0], topics=["/cf1/*", "/cf1/camera/*"])
    trim(flight, parts[1], topics=["/cf2/*"])
    out = tmp_path / "out.mcap"
    assert merge(parts, out) == read_summary(flight).count
    assert_messages_unchanged(flight, out, list(read_summary(flight).topics))
    again = tmp_path / "again.mcap"
    merge(parts, again)
    assert again.read_bytes() == out.read_bytes()


def test_message_indexes_of_whole_chunks_are_copied(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    rewrite(flight, out, MADE, without=())
    before, after = (read_message_indexes(path) for path in (flight, out))
    assert len(set(before) & set(after)) >= len(read_chunk_indexes(flight)) - 2
    assert len(after) == len(read_chunk_indexes(out))


def read_message_indexes(path: Path) -> list[bytes]:
    """Return the message indexes of each chunk, as bytes."""
    data, found = path.read_bytes(), read_chunk_indexes(path)
    ends = [(c.chunk_start_offset + c.chunk_length, c.message_index_length) for c in found]
    return [data[at : at + size] for at, size in ends]


@pytest.mark.parametrize("start_ns", [0, 2000, 2001, 5900])
def test_a_trim_cuts_the_chunks_at_both_its_ends(
    flight: Path, tmp_path: Path, start_ns: int
) -> None:
    """The end of the span excludes the last message of a chunk."""
    end_ns = next(
        c.message_end_time for c in read_chunk_indexes(flight) if c.message_end_time > start_ns
    )
    out = tmp_path / "out.mcap"
    trim(flight, out, start_ns=start_ns, end_ns=end_ns, topics=["/cf1/attitude", "/cf2/height"])
    ours = read_raw(flight, "/cf1/attitude", "/cf2/height", start_ns=start_ns, end_ns=end_ns)
    assert list(read_raw(out)) == list(ours)
    assert len(list(read_raw(out))) == 2 * (end_ns - start_ns)


def test_recordings_whose_channels_have_the_same_numbers_are_merged(tmp_path: Path) -> None:
    paths = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    rng = np.random.default_rng(0)
    for path, robot in zip(paths, ("cf1", "cf2"), strict=True):
        with RecordingWriter(path, MADE) as sink:
            heights = {"height_m": rng.normal(size=12_000)}
            sink.write_columns(
                f"/{robot}/height", message_class("Height"), np.arange(12_000), heights
            )
    assert {*read_channel_topics(paths[0])} == {*read_channel_topics(paths[1])}
    out = tmp_path / "out.mcap"
    assert merge(paths, out) == 24_000
    for path, topic in zip(paths, ("/cf1/height", "/cf2/height"), strict=True):
        assert_messages_unchanged(path, out, [topic])
    assert len(read_channel_topics(out)) == 2


def test_message_index_of_a_wrong_channel_is_damage(flight: Path, tmp_path: Path) -> None:
    bad, data = tmp_path / "bad.mcap", bytearray(flight.read_bytes())
    chunk = read_chunk_indexes(flight)[1]
    first, second = sorted(chunk.message_index_offsets.values())[:2]
    for at in range(15, 15 + 16):  # swap the first entries of both indexes
        data[first + at], data[second + at] = data[second + at], data[first + at]
    bad.write_bytes(data)
    with pytest.raises(RecordingError, match=r"index of the chunk at byte \d+ is wrong"):
        rewrite(bad, tmp_path / "out.mcap", MADE, without=())


def test_recovering_copies_undamaged_chunks_unchanged(flight: Path, tmp_path: Path) -> None:
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    last = max(c.chunk_start_offset for c in read_chunk_indexes(flight))
    cut.write_bytes(flight.read_bytes()[:last])
    result = recover(cut, out)
    assert result.messages == read_summary(out).count > MOMENTS
    assert (
        len(set(read_chunk_records(flight)) & set(read_chunk_records(out)))
        >= len(read_chunk_indexes(flight)) - 3
    )


def test_damaged_chunk_is_detected_while_copying(flight: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "a.mcap"
    for chunk in read_chunk_indexes(flight)[2], read_chunk_indexes(flight)[-1]:
        data = bytearray(flight.read_bytes())
        data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 1
        damaged.write_bytes(data)
        with pytest.raises(RecordingError, match="damaged"):
            rewrite(damaged, tmp_path / "out.mcap", MADE, without=(), fresh=())
        with pytest.raises(RecordingError, match="damaged"):
            merge([damaged, flight], tmp_path / "out.mcap")
        assert not (tmp_path / "out.mcap").exists()


def test_small_chunks_of_a_live_recording_are_joined(tmp_path: Path) -> None:
    path, out = tmp_path / "live.mcap", tmp_path / "out.mcap"
    with RecordingWriter(path, MADE) as sink:
        for k in range(500):
            sink.write(k, "/cf1/height", message_class("Height")(height_m=k))
            if k % 10 == 9:
                sink.flush()
    assert len(read_chunk_indexes(path)) == 50
    rewrite(path, out, MADE, without=(), fresh=())
    assert len(read_chunk_indexes(out)) == 1
    assert_messages_unchanged(path, out, ["/cf1/height"])


@pytest.fixture(scope="module")
def by_topic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write heights of three robots, one robot after the other, in many chunks."""
    path = tmp_path_factory.mktemp("by_topic") / "flight.mcap"
    rng = np.random.default_rng(1)
    with RecordingWriter(path, MADE) as sink:
        for robot in ("cf1", "cf2", "cf3"):
            for k in range(4 * MOMENTS):
                sink.write(k, f"/{robot}/height", message_class("Height")(height_m=rng.normal()))
    return path


@pytest.mark.parametrize("copy", ["rewrite", "trim", "merge"])
def test_topics_of_a_recording_written_topic_by_topic_stay_in_order(
    by_topic: Path, flight: Path, tmp_path: Path, copy: str
) -> None:
    out = tmp_path / "out.mcap"
    if copy == "rewrite":
        rewrite(by_topic, out, MADE, without=())
    elif copy == "trim":
        trim(by_topic, out, end_ns=3 * MOMENTS)
    else:
        merge([flight, by_topic], out)
    assert len(read_chunk_indexes(out)) > 3
    times: dict[str, list[int]] = {}
    for batch, known in iter_batches_in_file_order(out):
        for number in batch.list_channel_ids():
            kept = batch.time_ns[batch.mask_channels([number])].tolist()
            times.setdefault(known[number].topic, []).extend(kept)
    assert times["/cf3/height"] == list(range(len(times["/cf3/height"])))
    for topic in times.keys() - ({"/cf1/height", "/cf2/height"} if copy == "merge" else set()):
        assert times[topic] == sorted(times[topic]), topic
