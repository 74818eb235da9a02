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
from dmrl.recording.mcap.file import RECORD_STRUCT, BoundedReader, corrupt_error, open_mcap
from dmrl.recording.mcap.record_scan import build_channel, scan_file
from dmrl.recording.mcap.summary_section import SummarySection, read_verified_section


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """Message type and number of messages of one topic."""

    schema: str
    count: int


CACHED_AGE_MIN_NS, CACHE_ENTRIES_MAX = 1_000_000_000, 8
"""Age from which the time stamp of a file is trusted, nanoseconds; and entries of the cache."""
_CACHE: dict[tuple[Path, str], tuple[tuple[int, int, int], Any]] = {}
Made = TypeVar("Made")


def read_summary_section(path: Path, stream: BoundedReader) -> SummarySection | None:
    """Read and verify the Summary section; return None if it does not index the messages.

    The result is cached.

    Raises
    ------
    RecordingError
        If the section contradicts itself or the file.
    """
    return get_cached("verified section", path, stream, lambda: read_verified_section(path, stream))


def get_cached(kind: str, path: Path, stream: BoundedReader, make: Callable[[], Made]) -> Made:
    """Return the result for a file from the cache, or make it with ``make``.

    A result is valid while inode, size and modification time are the same. Local files that are
    less than a second old are not cached: a later write might leave the same time stamp.
    """
    status = stream.status
    stamp = status.st_ino, status.st_size, status.st_mtime_ns
    key = path, kind
    if key in _CACHE and _CACHE[key][0] == stamp:
        cached: Made = _CACHE[key][1]
        return cached
    cached = make()
    # Files in a bucket are identified by a tag of their content, so their age does not matter.
    if stream.remote_stream is not None or time.time_ns() - status.st_mtime_ns > CACHED_AGE_MIN_NS:
        while len(_CACHE) >= CACHE_ENTRIES_MAX:
            del _CACHE[next(iter(_CACHE))]
        _CACHE[key] = stamp, cached
    return cached


def read_channel(path: Path, topic: str) -> Channel:
    """Return the first channel of a topic."""
    with open_mcap(path) as stream:
        section = read_summary_section(path, stream)
        if section is None:
            channels = scan_file(path, stream).channels
        else:
            channels = {
                n: build_channel(n, section.channels, section.schemas) for n in section.channels
            }
        return channels[min(n for n, channel in channels.items() if channel.topic == topic)]


def read_metadata(
    path: Path, stream: BoundedReader, section: McapSummary
) -> dict[str, list[dict[str, str]]]:
    """Read the metadata by name, and verify them against the CRC of dmrl's recordings.

    Raises
    ------
    RecordingError
        If the CRC does not match, or a record is not where the Summary section lists it.
    """
    metadata: dict[str, list[dict[str, str]]] = {}
    crc = before = 0
    for place in sorted(section.metadata_indexes, key=lambda place: place.offset):
        body = _read_record(path, stream, place, Opcode.METADATA)
        record = McapMetadata.read(ReadDataStream(BytesIO(body[RECORD_STRUCT.size :])))
        if record.name != place.name:
            raise corrupt_error(path, f"metadata {place.name} has another name")
        if record.name != checksums.METADATA_NAME or checksums.belongs_to_file(
            record.metadata, place.offset
        ):
            metadata.setdefault(record.name, []).append(dict(record.metadata))
        before, crc = crc, zlib.crc32(body, crc)
    stored = metadata.get(checksums.METADATA_NAME)
    if stored and stored[-1].get("metadata") != checksums.format_crc(before):
        raise corrupt_error(path, "its metadata fail their CRC")
    return metadata


def read_attachment(path: Path, stream: BoundedReader, place: AttachmentIndex) -> tuple[str, bytes]:
    """Read the name and content of an attachment, and verify its CRC."""
    body = _read_record(path, stream, place, Opcode.ATTACHMENT)
    crc = int.from_bytes(body[-4:], "little")
    record = Attachment.read(ReadDataStream(BytesIO(body[RECORD_STRUCT.size :])))
    if record.name != place.name or (crc and zlib.crc32(body[RECORD_STRUCT.size : -4]) != crc):
        raise corrupt_error(path, f"attachment {place.name} fails its CRC")
    return record.name, record.data


def _read_record(
    path: Path, stream: BoundedReader, place: MetadataIndex | AttachmentIndex, kind: Opcode
) -> bytes:
    """Read the record that an index points at. mcap's reader would read the whole summary again."""
    stream.seek(place.offset)
    body = stream.read(place.length)
    if len(body) < RECORD_STRUCT.size or RECORD_STRUCT.unpack_from(body) != (
        kind,
        len(body) - RECORD_STRUCT.size,
    ):
        raise corrupt_error(path, f"no {kind.name.lower()} at byte {place.offset}")
    return body
