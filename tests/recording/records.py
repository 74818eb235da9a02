"""A small recording, and where its records lie."""

from collections.abc import Iterator
from pathlib import Path

from dmrl.messages import message
from dmrl.recording import (
    Provenance,
    RecordingWriter,
)

TOPICS = ("/cf1/height", "/cf1/range/cf2")


def small(path: Path) -> Path:
    """Seven messages on two topics in three chunks, with metadata and an attachment."""
    with RecordingWriter(path, Provenance("test", {"level": 1}, seed=3)) as sink:
        for k in range(4):
            sink.write(10 * k, TOPICS[0], message("Height")(height_m=k))
            if k:
                sink.write(10 * k + 5, TOPICS[1], message("UwbRange")(range_m=k))
            if k % 2:
                sink.flush()
        sink.add_metadata("dmrl.split", {"train": "[[0, 10]]"})
        sink.add_attachment("note.txt", "text/plain", b"seven")
    return path


def records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of every record of a file."""
    at = 8
    while at < len(data) - 8:
        end = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        yield data[at], at, end
        at = end
