"""Write a small recording, and read the records and indexes of any recording."""

from collections.abc import Iterator
from pathlib import Path

from mcap.reader import make_reader
from mcap.records import ChunkIndex

from dmrl.messages import message_class
from dmrl.recording import (
    Provenance,
    RecordingWriter,
    read_raw,
)

TOPICS = ("/cf1/height", "/cf1/range/cf2")


def write_small_recording(path: Path) -> Path:
    """Write seven messages on two topics in three chunks, with metadata and an attachment."""
    with RecordingWriter(path, Provenance("test", {"level": 1}, seed=3)) as sink:
        for k in range(4):
            sink.write(10 * k, TOPICS[0], message_class("Height")(height_m=k))
            if k:
                sink.write(10 * k + 5, TOPICS[1], message_class("UwbRange")(range_m=k))
            if k % 2:
                sink.flush()
        sink.add_metadata("dmrl.split", {"train": "[[0, 10]]"})
        sink.add_attachment("note.txt", "text/plain", b"seven")
    return path


def iter_records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of every record of a file, as byte offsets."""
    at = 8
    while at < len(data) - 8:
        end = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        yield data[at], at, end
        at = end


def read_chunk_indexes(path: Path) -> list[ChunkIndex]:
    """Return the chunk indexes of the summary."""
    with path.open("rb") as stream:
        found = make_reader(stream).get_summary()
    assert found is not None
    return found.chunk_indexes


def read_chunk_records(path: Path) -> list[bytes]:
    """Return the record of each chunk, in file order and without its message indexes."""
    data = path.read_bytes()
    found = sorted(read_chunk_indexes(path), key=lambda c: c.chunk_start_offset)
    return [data[c.chunk_start_offset : c.chunk_start_offset + c.chunk_length] for c in found]


def assert_messages_unchanged(before: Path, after: Path, topics: list[str]) -> None:
    """Assert that messages on these topics are equal, by dmrl's reader and by mcap's."""
    for topic in topics:
        assert list(read_raw(after, topic)) == list(read_raw(before, topic))
    with after.open("rb") as stream:
        theirs = make_reader(stream, validate_crcs=True).iter_messages(topics)
        got = [(c.topic, m.log_time, m.publish_time, m.data) for _, c, m in theirs]
    ours = [(r.topic, r.time_ns, r.publish_ns, r.data) for r in read_raw(before, *topics)]
    assert sorted(got) == sorted(ours)


def read_channel_topics(path: Path) -> dict[int, str]:
    """Return the topic of each channel ID in the summary."""
    with path.open("rb") as stream:
        found = make_reader(stream).get_summary()
    assert found is not None
    return {number: channel.topic for number, channel in found.channels.items()}
