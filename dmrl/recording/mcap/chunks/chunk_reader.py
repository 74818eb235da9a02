"""Read one chunk and verify it against its Chunk Index and Message Index records."""

from collections.abc import Container, Iterator, Mapping, Sequence

import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex

from dmrl.recording.mcap import message_index
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.chunks.chunk import (
    MESSAGE_OPCODE,
    RECORD_HEADER_BYTES,
    ParsedChunk,
    build_batch_at,
    decompress,
    other_records,
    parse_records,
    require_valid_times,
    select_channels,
)
from dmrl.recording.mcap.file import BoundedReader
from dmrl.recording.mcap.file_writer import CHUNK_STRUCT
from dmrl.recording.mcap.message_batch import MESSAGE_PREFIX_BYTES, Bytes, MessageBatch
from dmrl.recording.mcap.summary_section import SummarySection


def locate_chunk(chunk: ChunkIndex) -> tuple[int, int]:
    """Return the offset of a chunk, and its size with its message indexes, bytes."""
    return chunk.chunk_start_offset, chunk.chunk_length + chunk.message_index_length


def iter_chunks(
    stream: BoundedReader,
    chunks: Sequence[ChunkIndex],
    channels: Mapping[int, Channel],
    summary: SummarySection,
) -> Iterator[MessageBatch]:
    """Yield the messages of chunks, one chunk after the other; see `read_chunk`."""
    stream.expect_reads([locate_chunk(chunk) for chunk in chunks])
    for chunk in chunks:
        yield read_chunk(stream, chunk, channels, summary)


def read_chunk(
    stream: BoundedReader,
    chunk_index: ChunkIndex,
    channels: Mapping[int, Channel],
    summary: SummarySection,
) -> MessageBatch:
    """Read a chunk and return its messages of some channels, in chunk order.

    Parameters
    ----------
    stream
        The recording.
    chunk_index
        Chunk Index record of the chunk.
    channels
        Channels to read, by channel id.
    summary
        Summary section of the recording.

    Raises
    ------
    McapError
        If the chunk contradicts its Chunk Index, its Message Index or the Summary section.
    """
    raw, _, data = _load_chunk(stream, chunk_index)
    indexed = chunk_index.message_index_offsets.keys()
    if indexed and indexed <= channels.keys():
        return _read_whole_chunk(raw, data, chunk_index, summary)[0]
    if not indexed or not summary.counts:  # no statistics will be compared with the messages
        batch = _read_whole_chunk(raw, data, chunk_index, summary)[0]
        return batch.select_channels(channels)
    if summary.needs_definition_check(chunk_index):
        summary.check_definitions(parse_records(data).iter_definitions())
    return _select_by_index(raw, data, chunk_index, channels)[0]


def read_chunk_for_copy(
    stream: BoundedReader, chunk_index: ChunkIndex, summary: SummarySection
) -> tuple[Chunk, MessageBatch, ParsedChunk, message_index.MessageIndex | None]:
    """Read a chunk for a copy: still compressed, with all its messages and message indexes.

    Parameters
    ----------
    stream
        The recording.
    chunk_index
        Chunk Index record of the chunk.
    summary
        Summary section of the recording.

    Returns
    -------
    tuple
        Chunk record, all messages, all other records, and message indexes. The indexes are None
        where there are none or their layout differs from that of a copy.

    Raises
    ------
    McapError
        If the chunk contradicts its Chunk Index, its Message Index or the Summary section.
    """
    raw, chunk, data = _load_chunk(stream, chunk_index)
    batch, others, counts = _read_whole_chunk(raw, data, chunk_index, summary)
    records = raw[chunk_index.chunk_length :]
    after = chunk_index.chunk_start_offset + chunk_index.chunk_length
    places = {n: at - after for n, at in chunk_index.message_index_offsets.items()}
    own_layout = all(counts.values()) and len(records) == message_index.compute_indexes_size(counts)
    if not own_layout or min(places.values(), default=-1) < 0:
        return chunk, batch, others, None
    return chunk, batch, others, message_index.MessageIndex(records, places, counts)


def _load_chunk(stream: BoundedReader, chunk_index: ChunkIndex) -> tuple[bytes, Chunk, Bytes]:
    """Return a chunk's bytes with its message indexes, its record, and its decompressed data."""
    at, size = locate_chunk(chunk_index)
    stream.seek(at)
    raw = stream.read(size)
    chunk = _parse_chunk_record(raw, chunk_index)
    return raw, chunk, decompress(chunk, at)


def _read_whole_chunk(
    raw: bytes, data: Bytes, chunk_index: ChunkIndex, summary: SummarySection
) -> tuple[MessageBatch, ParsedChunk, dict[int, int]]:
    """Return all messages, all other records, and the number that each message index lists."""
    others: ParsedChunk | None
    if chunk_index.message_index_offsets:
        batch, counts = _select_by_index(raw, data, chunk_index, summary.channels)
        others = other_records(batch)
        if others is None:
            at, found = chunk_index.chunk_start_offset, len(parse_records(data).messages)
            raise McapError(
                f"the message indexes of the chunk at byte {at} do not list each of its "
                f"{found} messages once"
            )
    else:
        others, counts = parse_records(data), {}
        batch = select_channels(others.batch, summary.channels, summary.channels)
        _check_time_range(chunk_index, batch)
    summary.check_definitions(others.iter_definitions())
    return batch, others, counts


def _select_by_index(
    raw: bytes, data: Bytes, chunk_index: ChunkIndex, channels: Container[int]
) -> tuple[MessageBatch, dict[int, int]]:
    """Return the messages of some channels, and the number that each message index lists."""
    at = chunk_index.chunk_start_offset
    places = {
        n: place - at for n, place in chunk_index.message_index_offsets.items() if n in channels
    }
    entries = message_index.parse_index_entries(raw, places)
    offset, channel, time_ns = entries.offset, entries.channel, entries.time_ns
    if (offset[1:] < offset[:-1]).any():  # of several channels
        order = np.argsort(offset)
        offset, channel, time_ns = offset[order], channel[order], time_ns[order]
    if len(offset) and not 0 <= offset[0] <= offset[-1] <= len(data) - MESSAGE_PREFIX_BYTES:
        raise McapError(f"index beyond the chunk at byte {at}")
    # Message indexes have no CRC, so they are compared with the records they point at.
    batch = build_batch_at(data, offset)
    right = (data[offset] == MESSAGE_OPCODE) & (batch.channel == channel)
    if not (right & (batch.time_ns == time_ns) & (batch.end <= len(data))).all():
        raise McapError(f"index of the chunk at byte {at} is wrong")
    return _check_time_range(chunk_index, require_valid_times(batch)), dict(
        zip(places, entries.counts.tolist(), strict=True)
    )


def _check_time_range(chunk_index: ChunkIndex, batch: MessageBatch) -> MessageBatch:
    """Return the batch; raise McapError if its times exceed the range of its Chunk Index."""
    low, high = chunk_index.message_start_time, chunk_index.message_end_time
    first, last = batch.time_span_ns if len(batch) else (low, high)
    if not low <= first <= last <= high:
        raise McapError(
            f"messages in the chunk at byte {chunk_index.chunk_start_offset} are "
            "outside the time range that it states"
        )
    return batch


def _parse_chunk_record(raw: bytes, chunk_index: ChunkIndex) -> Chunk:
    """Parse the Chunk record at the start of some bytes and compare it with its Chunk Index."""
    at = chunk_index.chunk_start_offset
    if len(raw) < CHUNK_STRUCT.size or raw[0] != Opcode.CHUNK:
        raise McapError(f"no chunk at byte {at}")
    _, length, first, last, size, crc, name_bytes = CHUNK_STRUCT.unpack_from(raw)
    begin = CHUNK_STRUCT.size + name_bytes + 8
    compression = raw[CHUNK_STRUCT.size : begin - 8].decode()
    end = begin + int.from_bytes(raw[begin - 8 : begin], "little")
    found = length + RECORD_HEADER_BYTES, first, last, size, compression
    listed = chunk_index.chunk_length, chunk_index.message_start_time, chunk_index.message_end_time
    if (
        found != (*listed, chunk_index.uncompressed_size, chunk_index.compression)
        or end > chunk_index.chunk_length
    ):
        raise McapError(f"the chunk at byte {at} differs from its index in the summary")
    body = memoryview(raw)[begin:end]  # a slice would be a copy
    return Chunk(compression, body, last, first, crc, size)  # type: ignore[arg-type]
