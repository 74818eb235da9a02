"""Check that the parts of a Summary section agree with each other and with the limits."""

from itertools import chain

from mcap.exceptions import McapError
from mcap.summary import Summary as McapSummary

from dmrl.guards import limits
from dmrl.recording.mcap.file import BoundedReader, BudgetError
from dmrl.recording.mcap.message_batch import MAX_TIME_NS


def check_budget(stream: BoundedReader, summary_section: McapSummary) -> None:
    """Raise unless names, topics and the size of all chunks are within the limits."""
    if max(len(summary_section.channels), len(summary_section.schemas)) > limits.TOPICS:
        raise BudgetError(f"it has more than {limits.TOPICS} channels or schemas")
    names = chain(
        (c.topic for c in summary_section.channels.values()),
        (s.name for s in summary_section.schemas.values()),
    )
    if longest := [name for name in names if len(name) > limits.NAME_CHARACTERS]:
        raise BudgetError(f"the name {longest[0][:20]}... has {len(longest[0])} characters")
    size = sum(chunk.uncompressed_size for chunk in summary_section.chunk_indexes)
    if size > limits.max_unpacked_bytes(stream.size):
        raise BudgetError(f"{stream.size / 1e6:.1f} MB of recording unpack to {size / 1e6:.0f} MB")


def check_statistics(summary_section: McapSummary) -> None:
    """Raise unless Statistics, chunk indexes and channels agree with each other."""
    counts = summary_section.statistics.channel_message_counts if summary_section.statistics else {}
    mentioned = {number for number, count in counts.items() if count}
    for chunk in summary_section.chunk_indexes:
        mentioned.update(chunk.message_index_offsets)
    if unknown := mentioned - summary_section.channels.keys():
        raise McapError(f"its summary lacks channel {min(unknown)}")
    for channel in summary_section.channels.values():
        if channel.schema_id and channel.schema_id not in summary_section.schemas:
            raise McapError(f"its summary lacks the schema of {channel.topic}")
    statistics = summary_section.statistics
    if statistics is None:
        return
    if counts and sum(counts.values()) != statistics.message_count:
        raise McapError("its statistics contradict themselves")
    found, number = len(summary_section.chunk_indexes), statistics.chunk_count
    if found and found != number:
        raise McapError(f"its summary lists {found} of {number} chunks")


def check_extra_counts(summary_section: McapSummary) -> None:
    """Raise unless there are as many metadata and attachments as Statistics states."""
    statistics = summary_section.statistics
    if statistics is None:
        return
    for what, number, indexes in (
        ("metadata records", statistics.metadata_count, summary_section.metadata_indexes),
        ("attachments", statistics.attachment_count, summary_section.attachment_indexes),
    ):
        if len(indexes) != number:
            raise McapError(f"it has {len(indexes)} of {number} {what}")


def check_times(summary_section: McapSummary) -> None:
    """Raise if a chunk ends beyond the largest time."""
    latest = max((chunk.message_end_time for chunk in summary_section.chunk_indexes), default=0)
    if latest >= MAX_TIME_NS:
        raise McapError("a message has a time beyond the year 2262")
