"""What a recording holds, from its summary, without reading its messages."""

import os
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Attachment, AttachmentIndex, MetadataIndex
from mcap.records import Channel as McapChannel
from mcap.records import Message as McapMessage
from mcap.records import Metadata as McapMetadata
from mcap.records import Schema as McapSchema
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.summary import Summary as McapSummary

from dmrl.errors import RecordingError
from dmrl.recording.provenance import METADATA_NAME, Provenance
from dmrl.recording.writer import Channel

MAGIC = b"\x89MCAP0\r\n"
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
Record = TypeVar("Record", Attachment, McapMetadata)


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """The file, open for reading, known to begin and end as a recording does.

    Raises
    ------
    RecordingError
        If it is absent, not MCAP, cut short, or turns out to be damaged inside the block.
    """
    if path.is_dir():
        raise RecordingError(f"{path} is a folder, not a recording. Name a .mcap file")
    try:
        with path.open("rb") as stream:
            _check_ends(path, stream)
            yield stream
    except FileNotFoundError:
        raise RecordingError(f"no recording {path}. Check the name") from None
    except PermissionError:
        raise RecordingError(f"{path} may not be read. Check its permissions") from None
    except (
        McapError,
        CRCValidationError,
        struct.error,
        OSError,
        MemoryError,
        ValueError,
        KeyError,
    ) as e:
        # mcap leaks all of these on damaged lengths and strings.
        raise damaged(path, e) from e


def damaged(path: Path, cause: object) -> RecordingError:
    """The error for a file that begins as a recording but does not go on as one."""
    return RecordingError(
        f"{path} is damaged ({cause or type(cause).__name__}). "
        f"Try: dmrl recover {path} recovered.mcap"
    )


def _check_ends(path: Path, stream: BinaryIO) -> None:
    start = stream.read(len(MAGIC))
    if not start:
        raise RecordingError(f"{path} is empty. Make it again")
    if start != MAGIC:
        raise RecordingError(
            f"{path} is not an MCAP file: it begins with {start!r}. To import other formats, "
            "see: dmrl convert --help"
        )
    size = stream.seek(0, 2)
    stream.seek(max(0, size - len(MAGIC)))
    if size < 2 * len(MAGIC) or stream.read() != MAGIC:
        raise RecordingError(
            f"{path} is cut short: its writer may have died. "
            f"Try: dmrl recover {path} recovered.mcap"
        )
    stream.seek(0)


def mcap_summary(path: Path, stream: BinaryIO) -> McapSummary | None:
    """The summary section of an opened recording, or None where it has none."""
    return _remembered("raw", path, stream, lambda: _summary_of(SeekingReader(stream)))


def _remembered(what: str, path: Path, stream: BinaryIO, make: Callable[[], Made]) -> Made:
    """What was made of a file, without making it again as long as it is the same file.

    A file that was written in the last second is read again: its time stamp might not tell
    it from one that is written after it.
    """
    status = os.fstat(stream.fileno())
    stamp = status.st_ino, status.st_size, status.st_mtime_ns
    key = path, what
    if key in _MADE and _MADE[key][0] == stamp:
        made: Made = _MADE[key][1]
        return made
    made = make()
    if time.time_ns() - status.st_mtime_ns > SETTLED_NS:
        while len(_MADE) >= MOST_REMEMBERED:
            del _MADE[next(iter(_MADE))]
        _MADE[key] = stamp, made
    return made


def _summary_of(reader: SeekingReader) -> McapSummary | None:
    found = reader.get_summary()
    if found is not None and found.statistics is None and not found.channels:
        return None
    return found


def channel_of(
    number: int, channels: dict[int, McapChannel], schemas: dict[int, McapSchema]
) -> Channel:
    """Topic and schema of a channel number.

    Raises
    ------
    McapError
        If the channel's schema is not among them.
    """
    channel = channels[number]
    schema = schemas.get(channel.schema_id)
    if schema is None and channel.schema_id != 0:
        raise McapError(f"no schema for {channel.topic}")
    metadata = tuple(sorted(channel.metadata.items()))
    if schema is None:
        return Channel(channel.topic, "", b"", "", channel.message_encoding, metadata)
    return Channel(
        channel.topic, schema.name, schema.data, schema.encoding, channel.message_encoding, metadata
    )


def channel_on(path: Path, topic: str) -> Channel:
    """The first channel of a topic that an indexed recording has."""
    with opened(path) as stream:
        found = SeekingReader(stream).get_summary()
        assert found is not None
        number = min(n for n, channel in found.channels.items() if channel.topic == topic)
        return channel_of(number, found.channels, found.schemas)


def summary(path: Path) -> Summary:
    """What a recording holds; reads its summary, metadata and attachments only.

    Raises
    ------
    RecordingError
        If the file is absent, not MCAP, cut short or damaged.
    """
    with opened(path) as stream:
        return _remembered("summary", path, stream, lambda: _summary(path, stream))


def _summary(path: Path, stream: BinaryIO) -> Summary:
    found = mcap_summary(path, stream)
    if found is None:
        return _scanned(path, stream)
    metadata: dict[str, list[dict[str, str]]] = {}
    for record in _records(stream, found.metadata_indexes, McapMetadata):
        metadata.setdefault(record.name, []).append(dict(record.metadata))
    attachments = {a.name: a.data for a in _records(stream, found.attachment_indexes, Attachment)}
    statistics = found.statistics
    counts = statistics.channel_message_counts if statistics else {}
    topics: dict[str, TopicInfo] = {}
    for number in sorted(found.channels):
        channel = channel_of(number, found.channels, found.schemas)
        before = topics[channel.topic].count if channel.topic in topics else 0
        topics[channel.topic] = TopicInfo(channel.schema_name, before + counts.get(number, 0))
    return Summary(
        topics=dict(sorted(topics.items())),
        start_ns=statistics.message_start_time if statistics else 0,
        end_ns=statistics.message_end_time if statistics else 0,
        metadata=metadata,
        attachments=attachments,
        provenance=_provenance(path, metadata),
    )


def _records(
    stream: BinaryIO, places: Sequence[MetadataIndex | AttachmentIndex], kind: type[Record]
) -> Iterator[Record]:
    """The records that an index names. mcap's reader would read the whole summary again."""
    for place in places:
        stream.seek(place.offset)
        record = next(StreamReader(stream, skip_magic=True).records)
        if not isinstance(record, kind):
            raise McapError(f"no {kind.__name__} at byte {place.offset}")
        yield record


def _scanned(path: Path, stream: BinaryIO) -> Summary:
    """The summary of a complete file that was written without one."""
    stream.seek(0)
    schemas: dict[int, str] = {0: ""}
    channels: dict[int, tuple[str, str]] = {}
    counts: Counter[int] = Counter()
    times: list[int] = []
    metadata: dict[str, list[dict[str, str]]] = {}
    for record in StreamReader(stream, validate_crcs=True).records:
        match record:
            case McapSchema():
                schemas[record.id] = record.name
            case McapChannel():
                channels[record.id] = record.topic, schemas[record.schema_id]
            case McapMessage():
                counts[record.channel_id] += 1
                times = [min([record.log_time, *times]), max([record.log_time, *times])]
            case McapMetadata():
                metadata.setdefault(record.name, []).append(dict(record.metadata))
    topics = {t: TopicInfo(s, counts[n]) for n, (t, s) in channels.items()}
    start_ns, end_ns = times or (0, 0)
    return Summary(topics, start_ns, end_ns, metadata, {}, _provenance(path, metadata))


def _provenance(path: Path, metadata: dict[str, list[dict[str, str]]]) -> Provenance | None:
    if METADATA_NAME not in metadata:
        return None
    try:
        return Provenance.from_metadata(metadata[METADATA_NAME][-1])
    except (ValueError, KeyError, TypeError, AttributeError) as e:
        raise RecordingError(f"{path}: its provenance is damaged ({e}). Make it again") from e
