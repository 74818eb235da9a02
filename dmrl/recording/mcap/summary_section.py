"""Read and verify the Summary section of an MCAP file.

The Summary CRC protects the section itself. Writers may omit it, and it does not prove that the
section fits the file. Statistics, chunk indexes and the bytes between the listed records are
therefore compared as well.
"""

import zlib
from collections.abc import Iterable, Iterator
from functools import cached_property
from io import BytesIO

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader
from mcap.summary import Summary as McapSummary

from dmrl.recording.mcap import summary_checks
from dmrl.recording.mcap.channel import ChannelTable, build_channels
from dmrl.recording.mcap.file import DEFINITIONS, FOOTER_STRUCT, MAGIC, RECORD_STRUCT, BoundedReader
from dmrl.recording.mcap.file_cache import get_cached
from dmrl.recording.mcap.file_writer import index_attachment
from dmrl.recording.mcap.message_batch import Ints

DATA_OPCODES = {
    Opcode.HEADER,
    Opcode.MESSAGE,
    Opcode.CHUNK,
    Opcode.MESSAGE_INDEX,
    Opcode.ATTACHMENT,
    Opcode.METADATA,
    Opcode.DATA_END,
}
"""Records that the Summary section cannot contain."""


class SummarySection(McapSummary):
    """The Summary section of a recording.

    Attributes
    ----------
    has_crc
        Whether the section has a CRC. Without one, every definition in a chunk that is read is
        compared with the section.
    """

    has_crc: bool = False
    _first_chunks: frozenset[int] | None = None

    @cached_property
    def channels_by_id(self) -> ChannelTable:
        """Channels of the section, by channel id."""
        return build_channels(self.channels, self.schemas)

    @cached_property
    def chunks_by_time(self) -> tuple[list[ChunkIndex], Ints, Ints]:
        """Chunk indexes by first log time; (N,) first log times, and last ones up to each chunk."""
        found = sorted(
            self.chunk_indexes, key=lambda c: (c.message_start_time, c.chunk_start_offset)
        )
        times = [(chunk.message_start_time, chunk.message_end_time) for chunk in found]
        starts, ends = np.array(times, np.int64).reshape(-1, 2).T
        return found, starts, np.maximum.accumulate(ends)

    @property
    def counts(self) -> dict[int, int]:
        """Number of messages by channel id that the Statistics record states; empty if none."""
        return self.statistics.channel_message_counts if self.statistics else {}

    def needs_definition_check(self, chunk: ChunkIndex) -> bool:
        """Return whether the definitions in a chunk must be compared with this section.

        Without a CRC this applies to every chunk. With one, the first chunk of each channel is
        enough: it detects a file with two different definitions and valid CRCs, in which other
        readers would find other topics.
        """
        if self._first_chunks is None:
            firsts: dict[int, int] = {}
            for one in sorted(self.chunk_indexes, key=lambda one: -one.chunk_start_offset):
                firsts |= dict.fromkeys(one.message_index_offsets, one.chunk_start_offset)
            self._first_chunks = frozenset(firsts.values())
        return not self.has_crc or chunk.chunk_start_offset in self._first_chunks

    def check_definitions(self, definitions: Iterable[Schema | Channel]) -> None:
        """Raise McapError unless schemas and channels equal those of this section.

        Raises
        ------
        McapError
            If a definition differs.
        """
        for one in definitions:
            expected = self.schemas if isinstance(one, Schema) else self.channels
            if expected.get(one.id, one) != one:
                name = one.name if isinstance(one, Schema) else one.topic
                raise McapError(f"the definition of {name} contradicts the summary")


def read_summary_section(stream: BoundedReader) -> SummarySection | None:
    """Return the verified Summary section from the cache, or read it; see `get_cached`.

    None: it is absent or does not list all messages.

    Raises
    ------
    McapError
        If the section contradicts itself or the file.
    """
    return get_cached("verified section", stream, lambda: read_verified_section(stream))


def read_verified_section(stream: BoundedReader) -> SummarySection | None:
    """Read and verify the Summary section; None if it is absent or does not list all messages.

    Metadata and attachments that it does not list are added to its indexes.

    Parameters
    ----------
    stream
        The complete file.

    Raises
    ------
    McapError
        If the section fails its CRC, contradicts itself or the file, or exceeds a limit.
    """
    summary_section, start = read_raw_section(stream)
    if summary_section is None or not _indexes_messages(summary_section):
        return None
    summary_checks.check_budget(stream, summary_section)
    summary_checks.check_statistics(summary_section)
    summary_checks.check_times(summary_section)
    if not _lists_all_messages(stream, summary_section, start):
        return None
    summary_checks.check_extra_counts(summary_section)
    return summary_section


def read_raw_section(
    stream: BoundedReader, start: int | None = None
) -> tuple[SummarySection | None, int]:
    """Read the Summary section and check only its CRC; return it and its offset.

    Parameters
    ----------
    stream
        The recording.
    start
        Offset of the section, for a file that lost bytes before it. None: the Footer contains it.

    Raises
    ------
    McapError
        If there is no Footer, or the section fails its CRC.
    """
    end = stream.size - len(MAGIC) - FOOTER_STRUCT.size
    if end < len(MAGIC):
        raise McapError("it has no footer")
    stream.seek(end)
    footer = stream.read(FOOTER_STRUCT.size)
    opcode, length, summary_start, _, crc = FOOTER_STRUCT.unpack(footer)
    if (opcode, length) != (Opcode.FOOTER, FOOTER_STRUCT.size - RECORD_STRUCT.size):
        raise McapError("it has no footer")
    if not summary_start:
        return None, end
    start = summary_start if start is None else start
    if not len(MAGIC) <= start <= end:
        raise McapError("its footer points beyond it")
    stream.seek(start)
    body = stream.read(end - start)
    # The CRC covers everything before its own four bytes.
    if crc and zlib.crc32(footer[:-4], zlib.crc32(body)) != crc:
        raise McapError("its summary fails its CRC")
    summary_section = _parse_section(body + footer + MAGIC)
    summary_section.has_crc = crc != 0
    return summary_section, start


def _parse_section(body: bytes) -> SummarySection:
    summary_section = SummarySection()
    at = 0
    while body[at] != Opcode.FOOTER:
        if body[at] in DATA_OPCODES:
            raise McapError("its footer points into its data")
        at += RECORD_STRUCT.size + RECORD_STRUCT.unpack_from(body, at)[1]
    for record in StreamReader(BytesIO(body), skip_magic=True, record_size_limit=len(body)).records:
        match record:
            case Statistics():
                summary_section.statistics = record
            case Schema():
                if summary_section.schemas.setdefault(record.id, record) != record:
                    raise McapError(f"its summary has two different schemas of id {record.id}")
            case Channel():
                if summary_section.channels.setdefault(record.id, record) != record:
                    raise McapError(f"its summary has two channels {record.id}")
            case AttachmentIndex():
                summary_section.attachment_indexes.append(record)
            case ChunkIndex():
                summary_section.chunk_indexes.append(record)
            case MetadataIndex():
                summary_section.metadata_indexes.append(record)
    return summary_section


def _indexes_messages(summary_section: McapSummary) -> bool:
    """Return whether the section repeats definitions and indexes chunks. Writers may omit both."""
    statistics, channels = summary_section.statistics, summary_section.channels
    if statistics is not None and (
        statistics.channel_count > len(channels)
        or statistics.schema_count > len(summary_section.schemas)
    ):
        return False
    some = statistics is None or statistics.message_count
    defined = bool(channels) and (
        bool(summary_section.schemas) or not any(c.schema_id for c in channels.values())
    )
    return (defined and bool(summary_section.chunk_indexes)) or not some


def _lists_all_messages(stream: BoundedReader, summary_section: SummarySection, end: int) -> bool:
    """Return whether all messages are in listed chunks.

    Raises
    ------
    McapError
        If a chunk is not listed, two records overlap, or one runs beyond the data section.
    """
    at = len(MAGIC)
    for start, length in sorted(iter_extents(summary_section)):
        if start < at:
            raise McapError(f"its summary lists two records that overlap at byte {start}")
        if not _has_nothing_new(stream, summary_section, at, start):
            return False
        at = start + length
    if at > end:
        raise McapError("its summary lists a record beyond the data section")
    return _has_nothing_new(stream, summary_section, at, end)


def iter_extents(summary_section: McapSummary) -> Iterator[tuple[int, int]]:
    """Yield offset and length of every record that the section lists."""
    for chunk in summary_section.chunk_indexes:
        yield chunk.chunk_start_offset, chunk.chunk_length + chunk.message_index_length
    for metadata in summary_section.metadata_indexes:
        yield metadata.offset, metadata.length
    for attachment in summary_section.attachment_indexes:
        yield attachment.offset, attachment.length


def _has_nothing_new(
    stream: BoundedReader, summary_section: SummarySection, at: int, end: int
) -> bool:
    """Return whether the records from ``at`` to ``end`` contain no message, and no new definition.

    Metadata and attachments among them are added to the indexes of the section.
    """
    while at < end:
        stream.seek(at)
        opcode, length = RECORD_STRUCT.unpack(stream.read(RECORD_STRUCT.size))
        if opcode == Opcode.CHUNK:
            raise McapError(f"its summary lacks the chunk at byte {at}")
        if opcode == Opcode.MESSAGE:
            return False
        if opcode in DEFINITIONS:
            one = DEFINITIONS[opcode].read(ReadDataStream(BytesIO(stream.read(length))))
            known = summary_section.schemas if opcode == Opcode.SCHEMA else summary_section.channels
            if one.id not in known:
                return False
            summary_section.check_definitions([one])
        elif opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
            _add_index(summary_section, opcode, at, stream.read(length))
        at += RECORD_STRUCT.size + length
    if at > end:
        raise McapError(f"a record that ends at byte {at} overlaps the next one")
    return True


def _add_index(summary_section: McapSummary, opcode: int, at: int, body: bytes) -> None:
    """Add the index of a Metadata or Attachment record that the section does not list."""
    data, length = ReadDataStream(BytesIO(body)), RECORD_STRUCT.size + len(body)
    if opcode == Opcode.METADATA:
        name = Metadata.read(data).name
        summary_section.metadata_indexes.append(MetadataIndex(at, length, name))
        return
    index = index_attachment(Attachment.read(data), at, length)
    summary_section.attachment_indexes.append(index)
