"""Read and verify the Summary section of an MCAP file.

The Summary CRC protects the section itself. Writers may omit it, and it does not prove that the
section fits the file. Statistics, chunk indexes and the bytes between the listed records are
therefore compared as well.
"""

import struct
import zlib
from collections.abc import Iterable, Iterator
from io import BytesIO
from itertools import chain
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader
from mcap.summary import Summary as McapSummary

from dmrl.guards import limits
from dmrl.recording.mcap.file import DEFINITIONS, MAGIC, RECORD, Bounded, damaged, too_large
from dmrl.recording.mcap.message_batch import EVER_NS

FOOTER = struct.Struct("<BQQQI")  # opcode, length, summary start, summary offset start, CRC


class Section(McapSummary):
    """The Summary section of a recording.

    Attributes
    ----------
    has_crc
        Whether the section has a CRC. Without one, every definition in a chunk that is read is
        compared with the section.
    """

    proven: bool = False
    _firsts: frozenset[int] | None = None

    def must_confirm(self, chunk: ChunkIndex) -> bool:
        """Return whether the definitions in a chunk must be compared with this section.

        Without a CRC this applies to every chunk. With one, the first chunk of each channel is
        enough: it detects a file with two different definitions and valid CRCs, in which other
        readers would find other topics.
        """
        if self._firsts is None:
            firsts: dict[int, int] = {}
            for one in sorted(self.chunk_indexes, key=lambda one: -one.chunk_start_offset):
                firsts |= dict.fromkeys(one.message_index_offsets, one.chunk_start_offset)
            self._firsts = frozenset(firsts.values())
        return not self.proven or chunk.chunk_start_offset in self._firsts

    def confirm(self, path: Path, definitions: Iterable[Schema | Channel]) -> None:
        """Raise RecordingError unless schemas and channels equal those of this section.

        Raises
        ------
        RecordingError
            If a definition differs.
        """
        for one in definitions:
            known = self.schemas if isinstance(one, Schema) else self.channels
            if known.get(one.id, one) != one:
                name = one.name if isinstance(one, Schema) else one.topic
                raise damaged(path, f"the definition of {name} contradicts the summary")


def section(path: Path, stream: Bounded) -> Section | None:
    """Read and verify the Summary section; return None if it does not index the messages.

    Parameters
    ----------
    path
        The recording, for errors.
    stream
        The complete file.

    Raises
    ------
    RecordingError
        If the section fails its CRC, contradicts itself or the file, or exceeds a limit.
    """
    found, start = stated(path, stream)
    if found is None or not _usable(found):
        return None
    _within_budget(path, stream, found)
    _counted(path, found)
    _before_the_end_of_time(path, found)
    if not _placed(path, stream, found, start):
        return None
    return found


def stated(path: Path, stream: Bounded, start: int | None = None) -> tuple[Section | None, int]:
    """Read the Summary section and check only its CRC; return it and its offset.

    Parameters
    ----------
    path, stream
        The recording.
    start
        Offset of the section, for a file that lost bytes before it. None: the Footer contains it.

    Raises
    ------
    RecordingError
        If there is no Footer, or the section fails its CRC.
    """
    end = stream.size - len(MAGIC) - FOOTER.size
    if end < len(MAGIC):
        raise damaged(path, "it has no footer")
    stream.seek(end)
    footer = stream.read(FOOTER.size)
    opcode, length, said, _, crc = FOOTER.unpack(footer)
    if (opcode, length) != (Opcode.FOOTER, FOOTER.size - RECORD.size):
        raise damaged(path, "it has no footer")
    if not said:
        return None, end
    start = said if start is None else start
    if not len(MAGIC) <= start <= end:
        raise damaged(path, "its footer points beyond it")
    stream.seek(start)
    body = stream.read(end - start)
    # The CRC covers everything before its own four bytes.
    if crc and zlib.crc32(footer[:-4], zlib.crc32(body)) != crc:
        raise damaged(path, "its summary fails its CRC")
    found = _parsed(body + footer + MAGIC)
    found.proven = crc != 0
    return found, start


def _parsed(body: bytes) -> Section:
    found = Section()
    for record in StreamReader(BytesIO(body), skip_magic=True, record_size_limit=len(body)).records:
        match record:
            case Statistics():
                found.statistics = record
            case Schema():
                if found.schemas.setdefault(record.id, record) != record:
                    raise McapError(f"its summary has two message types {record.id}")
            case Channel():
                if found.channels.setdefault(record.id, record) != record:
                    raise McapError(f"its summary has two channels {record.id}")
            case AttachmentIndex():
                found.attachment_indexes.append(record)
            case ChunkIndex():
                found.chunk_indexes.append(record)
            case MetadataIndex():
                found.metadata_indexes.append(record)
    return found


def _usable(found: McapSummary) -> bool:
    """Return whether the section repeats definitions and indexes chunks. Writers may omit both."""
    some = found.statistics is None or found.statistics.message_count
    defined = bool(found.channels) and (
        bool(found.schemas) or not any(c.schema_id for c in found.channels.values())
    )
    return (defined and bool(found.chunk_indexes)) or not some


def _within_budget(path: Path, stream: Bounded, found: McapSummary) -> None:
    if max(len(found.channels), len(found.schemas)) > limits.TOPICS:
        raise too_large(path, f"it has more than {limits.TOPICS} topics or message types")
    names = chain(
        (c.topic for c in found.channels.values()), (s.name for s in found.schemas.values())
    )
    if longest := [name for name in names if len(name) > limits.NAME_CHARACTERS]:
        raise too_large(path, f"the name {longest[0][:20]}... has {len(longest[0])} characters")
    size = sum(chunk.uncompressed_size for chunk in found.chunk_indexes)
    if size > limits.unpacked_bytes(stream.size):
        raise too_large(
            path, f"{stream.size / 1e6:.1f} MB of recording unpack to {size / 1e6:.0f} MB"
        )


def _counted(path: Path, found: McapSummary) -> None:
    """Raise unless Statistics, chunk indexes and channels agree with each other."""
    counts = found.statistics.channel_message_counts if found.statistics else {}
    mentioned = {number for number, count in counts.items() if count}
    for chunk in found.chunk_indexes:
        mentioned.update(chunk.message_index_offsets)
    if unknown := mentioned - found.channels.keys():
        raise damaged(path, f"its summary lacks channel {min(unknown)}")
    for channel in found.channels.values():
        if channel.schema_id and channel.schema_id not in found.schemas:
            raise damaged(path, f"its summary lacks the message type of {channel.topic}")
    said = found.statistics
    if said is None:
        return
    if counts and sum(counts.values()) != said.message_count:
        raise damaged(path, "its statistics contradict themselves")
    for what, number, indexes in (
        ("chunks", said.chunk_count, found.chunk_indexes),
        ("metadata records", said.metadata_count, found.metadata_indexes),
        ("attachments", said.attachment_count, found.attachment_indexes),
    ):
        if indexes and len(indexes) != number:
            raise damaged(path, f"its summary lists {len(indexes)} of {number} {what}")


def _before_the_end_of_time(path: Path, found: McapSummary) -> None:
    latest = [chunk.message_end_time for chunk in found.chunk_indexes]
    if found.statistics is not None:
        latest += [found.statistics.message_start_time, found.statistics.message_end_time]
    if max(latest, default=0) >= EVER_NS:
        raise damaged(path, "a message has a time beyond the year 2262")


def _placed(path: Path, stream: Bounded, found: Section, end: int) -> bool:
    """Return whether all messages are in listed chunks.

    Raises
    ------
    RecordingError
        If a chunk is not listed, two records overlap, or one runs beyond the data section.
    """
    at = len(MAGIC)
    for start, length in sorted(places(found)):
        if start < at:
            raise damaged(path, f"its summary lists two records that overlap at byte {start}")
        if not _between(path, stream, found, at, start):
            return False
        at = start + length
    if at > end:
        raise damaged(path, "its summary lists a record beyond the data section")
    return _between(path, stream, found, at, end)


def places(found: McapSummary) -> Iterator[tuple[int, int]]:
    """Yield offset and length of every record that the section lists."""
    for chunk in found.chunk_indexes:
        yield chunk.chunk_start_offset, chunk.chunk_length + chunk.message_index_length
    for metadata in found.metadata_indexes:
        yield metadata.offset, metadata.length
    for attachment in found.attachment_indexes:
        yield attachment.offset, attachment.length


def _between(path: Path, stream: Bounded, found: Section, at: int, end: int) -> bool:
    """Return whether the records from ``at`` to ``end`` contain no message."""
    while at < end:
        stream.seek(at)
        opcode, length = RECORD.unpack(stream.read(RECORD.size))
        if opcode == Opcode.CHUNK:
            raise damaged(path, f"its summary lacks the chunk at byte {at}")
        if opcode == Opcode.MESSAGE:
            return False
        if opcode in DEFINITIONS and not found.proven:
            body = ReadDataStream(BytesIO(stream.read(length)))
            found.confirm(path, [DEFINITIONS[opcode].read(body)])
        at += RECORD.size + length
    if at > end:
        raise damaged(path, f"a record that ends at byte {at} overlaps the next one")
    return True
