"""Read the summary of a recording: topics, times, metadata, attachments and provenance."""

from dataclasses import dataclass, field
from pathlib import Path

from dmrl.errors import RecordingError
from dmrl.recording.mcap import checksums
from dmrl.recording.mcap.file import BoundedReader, open_mcap
from dmrl.recording.mcap.record_scan import build_channel, scan_file
from dmrl.recording.mcap.summary_index import (
    TopicInfo,
    get_cached,
    read_attachment,
    read_metadata,
    read_summary_section,
)
from dmrl.recording.provenance import METADATA_NAME, Provenance

SPLIT_METADATA = "dmrl.split"
"""Metadata record with the split that the source defines."""


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
        Files by name.
    provenance
        Origin of the recording, or None if dmrl did not write it.
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


def read_summary(path: Path) -> Summary:
    """Read the summary of a recording, its metadata and its attachments.

    Raises
    ------
    RecordingError
        If the file is absent, not MCAP, truncated or corrupt.
    """
    with open_mcap(path) as stream:
        return get_cached("summary", path, stream, lambda: _build_summary(path, stream))


def _build_summary(path: Path, stream: BoundedReader) -> Summary:
    section = read_summary_section(path, stream)
    if section is None or section.statistics is None:
        return _build_summary_by_scan(path, stream)
    metadata = read_metadata(path, stream, section)
    metadata.pop(checksums.METADATA_NAME, None)
    statistics = section.statistics
    topics: dict[str, TopicInfo] = {}
    for number in sorted(section.channels):
        channel = build_channel(number, section.channels, section.schemas)
        before = topics[channel.topic].count if channel.topic in topics else 0
        count = statistics.channel_message_counts.get(number, 0)
        topics[channel.topic] = TopicInfo(channel.schema_name, before + count)
    return Summary(
        topics=dict(sorted(topics.items())),
        start_ns=statistics.message_start_time,
        end_ns=statistics.message_end_time,
        metadata=metadata,
        attachments=dict(read_attachment(path, stream, at) for at in section.attachment_indexes),
        provenance=_parse_provenance(path, metadata),
    )


def _build_summary_by_scan(path: Path, stream: BoundedReader) -> Summary:
    """Build the summary of a complete file that has no Summary section."""
    scanned = scan_file(path, stream)
    scanned.metadata.pop(checksums.METADATA_NAME, None)
    counts = scanned.count_messages()
    topics: dict[str, TopicInfo] = {}
    for number, channel in scanned.channels.items():
        before = topics[channel.topic].count if channel.topic in topics else 0
        topics[channel.topic] = TopicInfo(channel.schema_name, before + counts[number])
    held = [batch.time_ns for batch in scanned.batches if len(batch)]
    return Summary(
        dict(sorted(topics.items())),
        min((int(times.min()) for times in held), default=0),
        max((int(times.max()) for times in held), default=0),
        scanned.metadata,
        scanned.attachments,
        _parse_provenance(path, scanned.metadata),
    )


def _parse_provenance(path: Path, metadata: dict[str, list[dict[str, str]]]) -> Provenance | None:
    if METADATA_NAME not in metadata:
        return None
    try:
        return Provenance.from_metadata(metadata[METADATA_NAME][-1])
    except (ValueError, KeyError, TypeError, AttributeError) as e:
        raise RecordingError(f"{path}: its provenance is damaged ({e}). Make it again") from e
