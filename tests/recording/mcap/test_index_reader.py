"""Reading the message indexes of many chunks at a time."""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from mcap.writer import CompressionType, Writer

from dmrl.errors import RecordingError
from dmrl.recording.log_times import iter_sorted_times, read_log_times, read_time_spans
from dmrl.recording.mcap import index_reader
from dmrl.recording.mcap.file import open_mcap
from dmrl.recording.mcap.index_reader import iter_index_times
from dmrl.recording.mcap.summary_section import read_summary_section

MESSAGES = 12
HEAD_BYTES = 15  # opcode, length, channel and size of a Message Index record


def write(path: Path, order: Sequence[int] = range(MESSAGES)) -> list[ChunkIndex]:
    """Write messages of two topics in turn, at 0, 10, 20 ... ns, and return the chunks."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, chunk_size=80)
        writer.start()
        schema = writer.register_schema("x", "", b"")
        channels = [writer.register_channel(name, "json", schema) for name in ("/a", "/b")]
        for k in order:
            writer.add_message(channels[k % 2], 10 * k, b"{}", 10 * k)
        writer.finish()
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and len(summary.chunk_indexes) > 3
    return summary.chunk_indexes


def overwrite(path: Path, at: int, values: bytes) -> None:
    with path.open("r+b") as stream:
        stream.seek(at)
        stream.write(values)


def read_indexes(path: Path) -> None:
    """Read every message index of a file."""
    with open_mcap(path) as stream:
        section = read_summary_section(stream)
        assert section is not None
        list(iter_index_times(stream, section))


def test_times_are_read_from_every_chunk(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap")
    assert read_time_spans(tmp_path / "a.mcap") == {"/a": (0, 100), "/b": (10, 110)}
    found = read_log_times(tmp_path / "a.mcap", ["/b"])
    assert found["/b"].tolist() == np.arange(10, 120, 20).tolist()


@pytest.mark.parametrize(
    "order", [range(12), [1, 0, 5, 2, 4, 3, 8, 6, 11, 10, 7, 9], [*range(11, -1, -1)]]
)
def test_times_are_sorted_and_held_only_while_earlier_ones_may_follow(
    tmp_path: Path, order: Sequence[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(index_reader, "GROUP_BYTES", 1)
    chunks = write(tmp_path / "a.mcap", order)
    found = list(iter_sorted_times(tmp_path / "a.mcap", frozenset(["/a", "/b"])))
    assert len(found) == 2 * len(chunks)
    for topic, first in (("/a", 0), ("/b", 10)):
        parts = [times for name, times in found if name == topic]
        assert np.concatenate(parts).tolist() == [*range(first, 120, 20)]
        at_once = sum(len(times) > 0 for times in parts) == 1
        assert at_once == (order[0] == 11)


def test_a_time_of_another_chunk_is_refused(tmp_path: Path) -> None:
    chunk = write(tmp_path / "a.mcap")[1]
    first = min(chunk.message_index_offsets.values()) + HEAD_BYTES
    overwrite(tmp_path / "a.mcap", first, struct.pack("<Q", chunk.message_end_time + 10))
    with pytest.raises(RecordingError, match="has times of another chunk"):
        read_indexes(tmp_path / "a.mcap")


def test_a_message_index_must_end_with_its_chunk(tmp_path: Path) -> None:
    chunk = write(tmp_path / "a.mcap")[1]
    last = max(chunk.message_index_offsets.values())
    # The record is 4 bytes longer, as if a later version of MCAP had added a field.
    overwrite(tmp_path / "a.mcap", last + 1, struct.pack("<Q", 6 + 16 + 4))
    with pytest.raises(RecordingError, match="a message index is cut"):
        read_indexes(tmp_path / "a.mcap")
