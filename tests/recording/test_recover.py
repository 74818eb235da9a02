"""Losses reported by recover."""

from math import sin
from pathlib import Path

import pytest
from mcap.writer import Writer

from dmrl.errors import RecordingError
from dmrl.messages import message_class, serialize_schema
from dmrl.recording import Provenance, RecordingWriter, read_raw, recover
from dmrl.stages.recover import describe_losses

from .records import read_chunk_indexes

TOPICS = ("/cf1/height", "/cf2/height")


@pytest.fixture
def damaged_recording(tmp_path: Path) -> tuple[Path, int]:
    """Write three chunks and damage the second; return the file and the number of its messages."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(2700):
            if k in (900, 1800):
                sink.flush()
            height = message_class("Height")(height_m=sin(k))
            sink.write(k, TOPICS[k % 3 == 0], height)
    middle = read_chunk_indexes(path)[1]
    data = bytearray(path.read_bytes())
    data[middle.chunk_start_offset + middle.chunk_length // 2] ^= 255
    path.write_bytes(data)
    return path, 900


def test_messages_lost_in_a_damaged_chunk_are_counted_by_topic(
    damaged_recording: tuple[Path, int], tmp_path: Path
) -> None:
    path, lost = damaged_recording
    found = recover(path, tmp_path / "b.mcap")
    assert found.missing == {TOPICS[0]: lost * 2 // 3, TOPICS[1]: lost // 3}
    assert (found.messages, found.damaged_chunks, found.lost_bytes) == (1800, 1, 0)
    assert (found.counted, found.doubtful, found.whole) == (True, False, False)


def test_truncated_file_reports_indexed_losses_only(
    damaged_recording: tuple[Path, int], tmp_path: Path
) -> None:
    path, lost = damaged_recording
    last = read_chunk_indexes(path)[2]
    cut = last.chunk_start_offset + 1000
    path.write_bytes(path.read_bytes()[:cut])
    found = recover(path, tmp_path / "b.mcap")
    assert found.messages == 900
    assert sum(found.missing.values()) == lost  # messages of the truncated chunk are unknown
    assert (found.counted, found.lost_bytes, found.whole) == (False, 1000, False)


def test_metadata_with_a_wrong_checksum_are_kept_and_doubted(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.write(0, TOPICS[0], message_class("Height")())
        sink.add_metadata("dmrl.split", {"train": "[[0, 10]]"})
    path.write_bytes(path.read_bytes().replace(b"[[0, 10]]", b"[[0, 90]]"))
    found = recover(path, tmp_path / "b.mcap")
    assert (found.doubtful, found.whole, found.missing) == (True, False, {})


def test_messages_beyond_2262_are_left_out_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("dmrl.v1.Height", "protobuf", serialize_schema("Height"))
        channel = writer.register_channel("/cf1/height", "protobuf", schema)
        late = ((2**63, 3), (4, 2**63), (2**63 - 1, 5), (2**63 - 2, 2**63 - 2))
        for log_ns, publish_ns in ((1, 2), *late):
            writer.add_message(channel, log_ns, b"", publish_ns)
        writer.finish()
    found = recover(path, tmp_path / "b.mcap")
    assert (found.messages, found.timeless, found.whole) == (2, 3, False)
    assert found.missing == {}
    assert describe_losses(found) == "3 messages left out whose time is after the year 2262"
    assert [raw.time_ns for raw in read_raw(tmp_path / "b.mcap")] == [1, 2**63 - 2]


def test_recover_refuses_a_file_without_a_whole_chunk(tmp_path: Path) -> None:
    for content, words in ((b"\x89MCAP0\r\n", "holds no whole chunk"), (b"\x89MC", "not begin")):
        (tmp_path / "a.mcap").write_bytes(content)
        with pytest.raises(RecordingError, match=words):
            recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
