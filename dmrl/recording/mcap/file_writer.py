"""Write the bytes of an MCAP file front to back: records, chunks and the Summary section.

`chunk_writer` decides the content. The mcap package serializes the rare records. Chunks and
message indexes are serialized here, from arrays.
"""

import io
import struct
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    ChunkIndex,
    DataEnd,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Statistics,
    SummaryOffset,
)

from dmrl.recording.mcap import checksums
from dmrl.recording.mcap.file import FOOTER_STRUCT, MAGIC, RECORD_STRUCT
from dmrl.recording.mcap.message_index import MessageIndex

CHUNK_STRUCT = struct.Struct("<BQQQQII")  # opcode, length, start, end, size, CRC, length of a name


def serialize(*records: McapRecord) -> bytes:
    """Serialize records to bytes."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())


def index_attachment(one: Attachment, at: int, length: int) -> AttachmentIndex:
    """Build the index of an attachment, from the offset and the length of its record."""
    size = len(one.data)
    return AttachmentIndex(
        at, length, one.log_time, one.create_time, size, one.name, one.media_type
    )


@dataclass(frozen=True, slots=True)
class CompressedChunk:
    """A compressed chunk and its message indexes.

    Parameters
    ----------
    compression, data
        Name of the compression, and the compressed records.
    uncompressed_size, crc
        Size of the records before compression, bytes, and their CRC-32.
    first_ns, last_ns
        First and last log time, nanoseconds.
    index
        Message indexes.
    """

    compression: str
    data: bytes
    uncompressed_size: int
    crc: int
    first_ns: int
    last_ns: int
    index: MessageIndex


class McapFileWriter:
    """An MCAP file that is being written.

    Every finished part is passed to the system at once, so that it survives a kill of the process.

    Parameters
    ----------
    path
        File to write.
    library, profile
        Name of the writer, and of what its channels conform to, for the Header record.
    """

    def __init__(self, path: Path, library: str, profile: str = "dmrl") -> None:
        self._stream = io.FileIO(path, "wb")
        self._at = self._crc = 0
        self._checksums = checksums.Checksums()
        self._statistics = Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0)
        self._counts: Counter[int] = Counter()
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._attachments: list[AttachmentIndex] = []
        try:
            self._append(MAGIC + serialize(Header(profile, library)))
        except OSError:
            self.close()
            raise

    def _append(self, data: bytes) -> int:
        """Append bytes to the file and return the offset they start at."""
        at = self._at
        left = memoryview(data)
        while left:
            left = left[self._stream.write(left) :]
        self._crc = zlib.crc32(data, self._crc)
        self._at += len(data)
        return at

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Append a Metadata record."""
        record = serialize(Metadata(name, values))
        self._checksums.add_metadata(record)
        self._metadata.append(MetadataIndex(self._append(record), len(record), name))

    def add_attachment(self, attachment: Attachment) -> None:
        """Append an Attachment record."""
        record = serialize(attachment)
        at = self._append(record)
        self._attachments.append(index_attachment(attachment, at, len(record)))

    def add_chunk(self, chunk: CompressedChunk) -> None:
        """Append a chunk and its message indexes."""
        first, last, index = chunk.first_ns, chunk.last_ns, chunk.index
        name = chunk.compression.encode()
        length = CHUNK_STRUCT.size - RECORD_STRUCT.size + len(name) + 8 + len(chunk.data)
        head = CHUNK_STRUCT.pack(
            Opcode.CHUNK, length, first, last, chunk.uncompressed_size, chunk.crc, len(name)
        )
        head += name + struct.pack("<Q", len(chunk.data))
        after = self._at + RECORD_STRUCT.size + length
        self._checksums.add_message_indexes(index.records)
        self._chunks.append(
            ChunkIndex(
                chunk_length=RECORD_STRUCT.size + length,
                chunk_start_offset=self._append(b"".join((head, chunk.data, index.records))),
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=last,
                message_index_length=len(index.records),
                message_index_offsets={n: after + at for n, at in index.offsets.items()},
                message_start_time=first,
                uncompressed_size=chunk.uncompressed_size,
            )
        )
        statistics = self._statistics
        earlier = statistics.message_count > 0
        known = statistics.message_start_time if earlier else first
        statistics.message_start_time = min(known, first)
        statistics.message_end_time = max(statistics.message_end_time, last)
        statistics.message_count += sum(index.counts.values())
        self._counts.update(index.counts)

    def finish(self, schemas: Sequence[bytes], channels: Sequence[bytes], unused: bytes) -> None:
        """Write the checksums and the Summary section.

        Parameters
        ----------
        schemas, channels
            Definitions that the Summary section repeats.
        unused
            Those of them that are in no chunk, to be written before the end of the data section.
        """
        self._append(unused)
        self.add_metadata(checksums.METADATA_NAME, self._checksums.to_metadata(self._at))
        self._append(serialize(DataEnd(self._crc)))
        statistics = self._statistics
        statistics.schema_count, statistics.channel_count = len(schemas), len(channels)
        statistics.chunk_count, statistics.metadata_count = len(self._chunks), len(self._metadata)
        statistics.attachment_count = len(self._attachments)
        statistics.channel_message_counts = dict(sorted(self._counts.items()))
        start, body, offsets = self._at, b"", b""
        chunks = b"".join(_serialize_chunk_index(chunk) for chunk in self._chunks)
        before = b"".join(schemas), b"".join(channels), serialize(statistics)
        for records in (*before, chunks, serialize(*self._attachments), serialize(*self._metadata)):
            if records:
                at = start + len(body)
                offsets += serialize(SummaryOffset(records[0], at, len(records)))
            body += records
        self._write_summary(start, body, offsets)

    def _write_summary(self, start: int, body: bytes, offsets: bytes) -> None:
        """Write the Summary section, the Footer and the magic bytes."""
        length = FOOTER_STRUCT.size - RECORD_STRUCT.size
        footer = FOOTER_STRUCT.pack(Opcode.FOOTER, length, start, start + len(body), 0)[:-4]
        crc = zlib.crc32(body + offsets + footer)
        self._append(b"".join((body, offsets, footer, struct.pack("<I", crc), MAGIC)))

    def close(self) -> None:
        """Close the file, complete or not."""
        self._stream.close()


def _serialize_chunk_index(chunk: ChunkIndex) -> bytes:
    """Serialize a Chunk Index record.

    With hundreds of topics the mcap package takes longer for it than for the chunk.
    """
    flat = [value for place in chunk.message_index_offsets.items() for value in place]
    places = struct.pack(f"<{len(flat) // 2 * 'HQ'}", *flat)
    name = chunk.compression.encode()
    body = struct.pack(
        "<QQQQI",
        chunk.message_start_time,
        chunk.message_end_time,
        chunk.chunk_start_offset,
        chunk.chunk_length,
        len(places),
    )
    body += places + struct.pack("<QI", chunk.message_index_length, len(name)) + name
    body += struct.pack("<QQ", chunk.compressed_size, chunk.uncompressed_size)
    return RECORD_STRUCT.pack(Opcode.CHUNK_INDEX, len(body)) + body
