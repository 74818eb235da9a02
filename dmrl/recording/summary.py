"""Read the summary of a recording: topics, times, metadata, attachments and provenance."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from mcap.records import Attachment, Schema
from mcap.records import Channel as McapChannel

from dmrl.errors import RecordingError
from dmrl.guards.bounded_parsing import parse_json
from dmrl.guards.safe_names import check_split_name
from dmrl.recording.mcap import checksums
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.extra_records import read_attachment, read_metadata
from dmrl.recording.mcap.file import BoundedReader, open_mcap
from dmrl.recording.mcap.file_cache import get_cached
from dmrl.recording.mcap.message_count import count_recording, count_scanned
from dmrl.recording.mcap.record_scan import scan_file
from dmrl.recording.mcap.summary_section import read_summary_section
from dmrl.recording.provenance import METADATA_NAME, Provenance

SPLIT_METADATA = "dmrl.split"
"""Metadata record with the split that the source defines."""


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """Message type, number and encoding of the messages of one topic."""

    schema: str
    count: int
    encoding: str = "protobuf"


@dataclass(frozen=True, slots=True)
class Definitions:
    """Schemas and channels of a recording.

    Parameters
    ----------
    schemas, channel_records, channels
        By id.
    unused
        Ids of the channels without messages.
    """

    schemas: Mapping[int, Schema] = field(default_factory=dict)
    channel_records: Mapping[int, McapChannel] = field(default_factory=dict)
    channels: Mapping[int, Channel] = field(default_factory=dict)
    unused: Collection[int] = ()


@dataclass(frozen=True, slots=True)
class Summary:
    """Topics, times, metadata, attachments and provenance of a recording.

    Parameters
    ----------
    topics
        Type and message count by topic.
    start_ns, end_ns
        First and last log time, nanoseconds; both 0 without messages.
    metadata
        Strings by name. A name may occur several times.
    attachments
        Files in the order of the recording. A name may occur several times.
    provenance
        Origin of the recording, or None if dmrl did not write it.
    definitions
        Schemas and channels.
    contradiction
        How times in its statistics differ from those of its messages; empty if they agree.
    """

    topics: dict[str, TopicInfo]
    start_ns: int
    end_ns: int
    metadata: dict[str, list[dict[str, str]]] = field(default_factory=dict)
    attachments: Sequence[Attachment] = ()
    provenance: Provenance | None = None
    definitions: Definitions = field(default_factory=Definitions)
    contradiction: str = ""

    @property
    def count(self) -> int:
        """Number of messages."""
        return sum(topic.count for topic in self.topics.values())


def read_summary(path: Path) -> Summary:
    """Read the summary of a recording, its metadata and its attachments.

    Raises
    ------
    RecordingError
        If the file is absent, not MCAP, truncated or corrupt, or it states another number of
        messages than it has; see `count_recording`.
    """
    with open_mcap(path) as stream:
        return get_cached("summary", stream, lambda: _build_summary(path, stream))


def _build_summary(path: Path, stream: BoundedReader) -> Summary:
    section = read_summary_section(stream)
    if section is None:
        scanned = scan_file(stream)
        count = count_scanned(scanned)
        metadata, attachments = scanned.metadata, scanned.attachments
        definitions = Definitions(scanned.schemas, scanned.channel_records, scanned.channels)
    else:
        count = count_recording(stream, section)
        metadata = read_metadata(stream, section)
        places = sorted(section.attachment_indexes, key=lambda place: place.offset)
        attachments = [read_attachment(stream, at) for at in places]
        definitions = Definitions(section.schemas, section.channels, section.channels_by_id)
    metadata.pop(checksums.METADATA_NAME, None)
    topics: dict[str, TopicInfo] = {}
    for number, channel in sorted(definitions.channels.items()):
        before = topics[channel.topic].count if channel.topic in topics else 0
        topics[channel.topic] = TopicInfo(
            channel.schema_name, before + count.by_channel[number], channel.encoding
        )
    return Summary(
        dict(sorted(topics.items())),
        count.start_ns,
        count.end_ns,
        metadata,
        attachments,
        _parse_provenance(path, metadata),
        replace(definitions, unused=definitions.channels.keys() - (+count.by_channel).keys()),
        count.contradiction,
    )


def read_channel(path: Path, topic: str) -> Channel:
    """Return the first channel of a topic."""
    channels = read_summary(path).definitions.channels
    return channels[min(n for n, channel in channels.items() if channel.topic == topic)]


def _parse_provenance(path: Path, metadata: dict[str, list[dict[str, str]]]) -> Provenance | None:
    if METADATA_NAME not in metadata:
        return None
    try:
        return Provenance.from_metadata(metadata[METADATA_NAME][-1])
    except (ValueError, KeyError, TypeError, AttributeError) as e:
        raise RecordingError(f"{path}: its provenance is damaged ({e}). Make it again") from e


def read_splits(path: Path, summary: Summary) -> dict[str, list[tuple[int, int]]]:
    """Return the split that the source defines: name to log times in [first, last], nanoseconds.

    Parameters
    ----------
    path
        The recording, for errors.
    found
        Summary of the recording.

    Raises
    ------
    RecordingError
        If the metadata is malformed.
    UnsafeName
        If the name of a split cannot be a folder name.
    """
    out: dict[str, list[tuple[int, int]]] = {}
    try:
        for record in summary.metadata.get(SPLIT_METADATA, []):
            for name, ranges in record.items():
                check_split_name(name, f"{path}: a split")
                out.setdefault(name, []).extend((int(a), int(b)) for a, b in parse_json(ranges))
    except (ValueError, TypeError) as e:
        raise RecordingError(
            f"{path}: its split is not a list of [start_ns, end_ns] ({e}). "
            "Convert it again, or ignore it with --split recordings"
        ) from None
    return out
