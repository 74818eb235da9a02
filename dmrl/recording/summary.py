"""Read the summary of a recording: topics, times, metadata, attachments and provenance."""

from dataclasses import dataclass, field
from pathlib import Path

from dmrl.errors import RecordingError
from dmrl.recording.mcap import checksums
from dmrl.recording.mcap.file import Bounded, opened
from dmrl.recording.mcap.record_scan import channel_of, walked
from dmrl.recording.mcap.summary_index import (
    TopicInfo,
    mcap_summary,
    metadata_of,
    read_attachment,
    remembered,
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


def summary(path: Path) -> Summary:
    """Read the summary of a recording, its metadata and its attachments.

    Raises
    ------
    RecordingError
        If the file is absent, not MCAP, truncated or corrupt.
    """
    with opened(path) as stream:
        return remembered("summary", path, stream, lambda: _summary(path, stream))


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
        attachments=dict(read_attachment(path, stream, at) for at in found.attachment_indexes),
        provenance=_provenance(path, metadata),
    )


def _scanned(path: Path, stream: Bounded) -> Summary:
    """Build the summary of a complete file that has no Summary section."""
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
