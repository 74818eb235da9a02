"""What a recording holds, from its summary, without reading its messages."""

import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, MetadataIndex
from mcap.records import Metadata as McapMetadata
from mcap.summary import Summary as McapSummary

from dmrl.errors import RecordingError
from dmrl.recording.mcap import checksums
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.file import RECORD, Bounded, damaged, opened
from dmrl.recording.mcap.record_scan import channel_of, walked
from dmrl.recording.mcap.summary_section import Section, section
from dmrl.recording.provenance import METADATA_NAME, Provenance

SPLIT_METADATA = "dmrl.split"


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """One topic of a recording: message type and number of messages."""

    schema: str
    count: int


@dataclass(frozen=True, slots=True)
class Summary:
    """What a recording holds.

    Parameters
    ----------
    topics
        By name.
    start_ns, end_ns
        First and last log time, nanoseconds; both 0 where there are no messages.
    metadata
        Named strings; a name may occur more than once.
    attachments
        Named files.
    provenance
        How it was made, or None for a recording that dmrl did not write.
    """

    topics: dict[str, TopicInfo]
    start_ns: int
    end_ns: int
    metadata: dict[str, list[dict[str, str]]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    provenance: Provenance | None = None

    @property
    def count(self) -> int:
        """Number of messages."""
        return sum(topic.count for topic in self.topics.values())


SETTLED_NS, MOST_REMEMBERED = 1_000_000_000, 8
_MADE: dict[tuple[Path, str], tuple[tuple[int, int, int], Any]] = {}
Made = TypeVar("Made")


def mcap_summary(path: Path, stream: Bounded) -> Section | None:
    """The verified summary section of a recording; None where messages are not found with it.

    Raises
    ------
    RecordingError
        If it contradicts itself or the file.
    """
    return _remembered("raw", path, stream, lambda: section(path, stream))


def _remembered(what: str, path: Path, stream: Bounded, make: Callable[[], Made]) -> Made:
    """What was made of a file, without making it again as long as it is the same file.

    A file that was written in the last second is read again: its time stamp might not tell
    it from one that is written after it.
    """
    status = stream.status
    stamp = status.st_ino, status.st_size, status.st_mtime_ns
    key = path, what
    if key in _MADE and _MADE[key][0] == stamp:
        made: Made = _MADE[key][1]
        return made
    made = make()
    # What is in a bucket has a tag of its content, so its time does not matter.
    if stream.ranged is not None or time.time_ns() - status.st_mtime_ns > SETTLED_NS:
        while len(_MADE) >= MOST_REMEMBERED:
            del _MADE[next(iter(_MADE))]
        _MADE[key] = stamp, made
    return made


def channel_on(path: Path, topic: str) -> Channel:
    """The first channel of a topic that a recording has."""
    with opened(path) as stream:
        found = mcap_summary(path, stream)
        if found is None:
            channels = walked(path, stream).channels
        else:
            channels = {n: channel_of(n, found.channels, found.schemas) for n in found.channels}
        return channels[min(n for n, channel in channels.items() if channel.topic == topic)]


def summary(path: Path) -> Summary:
    """What a recording holds; reads its summary, metadata and attachments only.

    Raises
    ------
    RecordingError
        If the file is absent, not MCAP, cut short or damaged.
    """
    with opened(path) as stream:
        return _remembered("summary", path, stream, lambda: _summary(path, stream))


def _summary(path: Path, stream: Bounded) -> Summary:
    found = mcap_summary(path, stream)
    if found is None or found.statistics is None:
        return _scanned(path, stream)
    metadata = metadata_of(path, stream, found)
    metadata.pop(checksums.METADATA_NAME, None)
    statistics = found.statistics
    topics: dict[str, TopicInfo] = {}
    for number in sorted(found.channels):
        channel = channel_of(number, found.channels, found.schemas)
        before = topics[channel.topic].count if channel.topic in topics else 0
        count = statistics.channel_message_counts.get(number, 0)
        topics[channel.topic] = TopicInfo(channel.schema_name, before + count)
    return Summary(
        topics=dict(sorted(topics.items())),
        start_ns=statistics.message_start_time,
        end_ns=statistics.message_end_time,
        metadata=metadata,
        attachments=dict(_attachment(path, stream, at) for at in found.attachment_indexes),
        provenance=_provenance(path, metadata),
    )


def metadata_of(path: Path, stream: Bounded, found: McapSummary) -> dict[str, list[dict[str, str]]]:
    """Metadata by name, held against its sum where the recording has one of its own.

    Raises
    ------
    RecordingError
        If it fails its sum, or does not stand where the summary says.
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


def _attachment(path: Path, stream: Bounded, place: AttachmentIndex) -> tuple[str, bytes]:
    """Name and content of an attachment, held against its CRC."""
    body = _record(path, stream, place, Opcode.ATTACHMENT)
    crc = int.from_bytes(body[-4:], "little")
    record = Attachment.read(ReadDataStream(BytesIO(body[RECORD.size :])))
    if record.name != place.name or (crc and zlib.crc32(body[RECORD.size : -4]) != crc):
        raise damaged(path, f"attachment {place.name} fails its CRC")
    return record.name, record.data


def _record(
    path: Path, stream: Bounded, place: MetadataIndex | AttachmentIndex, kind: Opcode
) -> bytes:
    """A whole record that an index names. mcap's reader would read the whole summary again."""
    stream.seek(place.offset)
    body = stream.read(place.length)
    if len(body) < RECORD.size or RECORD.unpack_from(body) != (kind, len(body) - RECORD.size):
        raise damaged(path, f"no {kind.name.lower()} at byte {place.offset}")
    return body


def _scanned(path: Path, stream: Bounded) -> Summary:
    """The summary of a complete file that was written without one."""
    walk = walked(path, stream)
    walk.metadata.pop(checksums.METADATA_NAME, None)
    counts = walk.counts()
    topics: dict[str, TopicInfo] = {}
    for number, channel in walk.channels.items():
        before = topics[channel.topic].count if channel.topic in topics else 0
        topics[channel.topic] = TopicInfo(channel.schema_name, before + counts[number])
    held = [block.time_ns for block in walk.blocks if len(block)]
    return Summary(
        dict(sorted(topics.items())),
        min((int(times.min()) for times in held), default=0),
        max((int(times.max()) for times in held), default=0),
        walk.metadata,
        walk.attachments,
        _provenance(path, walk.metadata),
    )


def _provenance(path: Path, metadata: dict[str, list[dict[str, str]]]) -> Provenance | None:
    if METADATA_NAME not in metadata:
        return None
    try:
        return Provenance.from_metadata(metadata[METADATA_NAME][-1])
    except (ValueError, KeyError, TypeError, AttributeError) as e:
        raise RecordingError(f"{path}: its provenance is damaged ({e}). Make it again") from e
