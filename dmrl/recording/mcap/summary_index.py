"""Read the summary section, metadata and attachments of an MCAP file, each verified."""

import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, MetadataIndex
from mcap.records import Metadata as McapMetadata
from mcap.summary import Summary as McapSummary

from dmrl.recording.mcap import checksums
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.file import RECORD, Bounded, damaged, opened
from dmrl.recording.mcap.record_scan import channel_of, walked
from dmrl.recording.mcap.summary_section import Section, section


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """Message type and number of messages of one topic."""

    schema: str
    count: int


SETTLED_NS, MOST_REMEMBERED = 1_000_000_000, 8
"""Age from which the time stamp of a file is trusted, nanoseconds; and entries of the cache."""
_MADE: dict[tuple[Path, str], tuple[tuple[int, int, int], Any]] = {}
Made = TypeVar("Made")


def mcap_summary(path: Path, stream: Bounded) -> Section | None:
    """Read and verify the Summary section; return None if it does not index the messages.

    The result is cached.

    Raises
    ------
    RecordingError
        If the section contradicts itself or the file.
    """
    return remembered("raw", path, stream, lambda: section(path, stream))


def remembered(what: str, path: Path, stream: Bounded, make: Callable[[], Made]) -> Made:
    """Return the result for a file from the cache, or make it with ``make``.

    A result is valid while inode, size and modification time are the same. Local files that are
    less than a second old are not cached: a later write might leave the same time stamp.
    """
    status = stream.status
    stamp = status.st_ino, status.st_size, status.st_mtime_ns
    key = path, what
    if key in _MADE and _MADE[key][0] == stamp:
        made: Made = _MADE[key][1]
        return made
    made = make()
    # Files in a bucket are identified by a tag of their content, so their age does not matter.
    if stream.ranged is not None or time.time_ns() - status.st_mtime_ns > SETTLED_NS:
        while len(_MADE) >= MOST_REMEMBERED:
            del _MADE[next(iter(_MADE))]
        _MADE[key] = stamp, made
    return made


def channel_on(path: Path, topic: str) -> Channel:
    """Return the first channel of a topic."""
    with opened(path) as stream:
        found = mcap_summary(path, stream)
        if found is None:
            channels = walked(path, stream).channels
        else:
            channels = {n: channel_of(n, found.channels, found.schemas) for n in found.channels}
        return channels[min(n for n, channel in channels.items() if channel.topic == topic)]


def metadata_of(path: Path, stream: Bounded, found: McapSummary) -> dict[str, list[dict[str, str]]]:
    """Read the metadata by name, and verify them against the CRC of dmrl's recordings.

    Raises
    ------
    RecordingError
        If the CRC does not match, or a record is not where the Summary section lists it.
    """
    metadata: dict[str, list[dict[str, str]]] = {}
    crc = before = 0
    for place in sorted(found.metadata_indexes, key=lambda place: place.offset):
        body = _record(path, stream, place, Opcode.METADATA)
        record = McapMetadata.read(ReadDataStream(BytesIO(body[RECORD.size :])))
        if record.name != place.name:
            raise damaged(path, f"metadata {place.name} has another name")
        if record.name != checksums.METADATA_NAME or checksums.of_this_file(
            record.metadata, place.offset
        ):
            metadata.setdefault(record.name, []).append(dict(record.metadata))
        before, crc = crc, zlib.crc32(body, crc)
    said = metadata.get(checksums.METADATA_NAME)
    if said and said[-1].get("metadata") != checksums.text(before):
        raise damaged(path, "its metadata fail their CRC")
    return metadata


def read_attachment(path: Path, stream: Bounded, place: AttachmentIndex) -> tuple[str, bytes]:
    """Read the name and content of an attachment, and verify its CRC."""
    body = _record(path, stream, place, Opcode.ATTACHMENT)
    crc = int.from_bytes(body[-4:], "little")
    record = Attachment.read(ReadDataStream(BytesIO(body[RECORD.size :])))
    if record.name != place.name or (crc and zlib.crc32(body[RECORD.size : -4]) != crc):
        raise damaged(path, f"attachment {place.name} fails its CRC")
    return record.name, record.data


def _record(
    path: Path, stream: Bounded, place: MetadataIndex | AttachmentIndex, kind: Opcode
) -> bytes:
    """Read the record that an index points at. mcap's reader would read the whole summary again."""
    stream.seek(place.offset)
    body = stream.read(place.length)
    if len(body) < RECORD.size or RECORD.unpack_from(body) != (kind, len(body) - RECORD.size):
        raise damaged(path, f"no {kind.name.lower()} at byte {place.offset}")
    return body
