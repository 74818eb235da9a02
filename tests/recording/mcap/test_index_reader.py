"""Message indexes of many chunks at a time."""

import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from mcap.writer import CompressionType, Writer

from dmrl.errors import RecordingError
from dmrl.recording.log_times import read_log_times, read_time_spans
from dmrl.recording.mcap.file import open_mcap
from dmrl.recording.mcap.index_reader import iter_index_times
from dmrl.recording.mcap.summary_section import read_summary_section

MESSAGES = 12
HEAD_BYTES = 15  # opcode, length, channel and size of a Message Index


def write(path: Path) -> list[ChunkIndex]:
    """Write messages of two topics in turn, at 0, 10, 20 ... ns, and return the chunks."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, chunk_size=80)
        writer.start()
        schema = writer.register_schema("x", "", b"")
        channels = [writer.register_channel(name, "json", schema) for name in ("/a", "/b")]
        for k in range(MESSAGES):
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
    with open_mcap(path) as stream:
        section = read_summary_section(stream)
        assert section is not None
        list(iter_index_times(stream, section))


def test_every_chunk_gives_its_times(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap")
    assert read_time_spans(tmp_path / "a.mcap") == {"/a": (0, 100), "/b": (10, 110)}
    found = read_log_times(tmp_path / "a.mcap", ["/b"])
    assert found["/b"].tolist() == np.arange(10, 120, 20).tolist()


def test_a_time_of_another_chunk_is_refused(tmp_path: Path) -> None:
    chunk = write(tmp_path / "a.mcap")[1]
    first = min(chunk.message_index_offsets.values()) + HEAD_BYTES
    overwrite(tmp_path / "a.mcap", first, struct.pack("<Q", chunk.message_end_time + 10))
    with pytest.raises(RecordingError, match="has times of another chunk"):
        read_indexes(tmp_path / "a.mcap")


def test_a_message_index_must_end_with_its_chunk(tmp_path: Path) -> None:
    chunk = write(tmp_path / "a.mcap")[1]
    last = max(chunk.message_index_offsets.values())
    # The record claims the bytes behind it, as if a later version had added a field.
    overwrite(tmp_path / "a.mcap", last + 1, struct.pack("<Q", 6 + 16 + 4))
    with pytest.raises(RecordingError, match="a message index is cut"):
        read_indexes(tmp_path / "a.mcap")
