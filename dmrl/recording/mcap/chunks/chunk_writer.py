"""Collect messages into chunks, images and numbers apart, and write each chunk when it is full."""

import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from mcap.records import Chunk

from dmrl.atomic_output import as_output_error
from dmrl.errors import RecordingError
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.channel_registry import ChannelRegistry
from dmrl.recording.mcap.chunks.chunk import ParsedChunk, write_message_prefixes
from dmrl.recording.mcap.chunks.chunk_builder import CHUNK_BYTES, ChunkBuilder
from dmrl.recording.mcap.file_writer import CompressedChunk, McapFileWriter
from dmrl.recording.mcap.message_batch import Bytes, Ints, MessageBatch
from dmrl.recording.mcap.message_index import MessageIndex, build_message_index

OPEN_CHUNK_AGE_MAX = 16
"""Chunks of the other kind after which an open chunk is written.

Numbers are rare beside images: few and large chunks of them are read faster.
"""


class ChunkWriter:
    """Write the chunks of a recording.

    Parameters
    ----------
    path
        The recording, for errors.
    file
        File that receives the full chunks.
    age_max
        A chunk is written, full or not, after this many later chunks of the other kind.

    Attributes
    ----------
    registry
        Ids of the channels; a copy may reserve those of its source.
    """

    def __init__(self, path: Path, file: McapFileWriter, age_max: int = OPEN_CHUNK_AGE_MAX) -> None:
        self._path, self._file, self._age_max = path, file, age_max
        self.registry = ChannelRegistry()
        self._numbers, self._images = ChunkBuilder(), ChunkBuilder(images=True)

    def add_message(
        self, channel_id: int, chunk: ChunkBuilder, time_ns: int, publish_ns: int, payload: bytes
    ) -> None:
        """Append one message of a channel that `define_channel` returned.

        Raises
        ------
        RecordingError
            If a time is negative.
        """
        if time_ns < 0 or publish_ns < 0:
            raise self._negative_time_error(time_ns, self.registry.get_topic(channel_id))
        chunk.add_message(channel_id, time_ns, publish_ns, payload)
        if chunk.full:
            self._write_chunk(chunk)

    def append_batch(self, batch: MessageBatch, channels: Mapping[int, Channel]) -> None:
        """Append a batch of messages, their payloads bit for bit.

        Parameters
        ----------
        batch
            The messages, with the times to write.
        channels
            By channel id in the batch.

        Raises
        ------
        RecordingError
            If a time is negative.
        """
        present = batch.list_channel_ids()
        for images in (False, True):
            own = {n: channels[n] for n in present if channels[n].carries_images == images}
            if own:
                whole = len(own) == len(present)
                self._append_one_kind(batch if whole else batch.select_channels(own), own)

    def _append_one_kind(self, batch: MessageBatch, channels: Mapping[int, Channel]) -> None:
        """Append messages that are all images, or all numbers."""
        self._require_nonnegative_times(batch, channels)
        numbers = np.zeros(max(channels) + 1, np.int64)
        for number, channel in channels.items():
            numbers[number], chunk = self.define_channel(channel)
        records, at = batch.copy_records()
        write_message_prefixes(records, at, numbers[batch.channel], batch.time_ns, batch.publish_ns)
        self._fill_chunks(chunk, records, at)

    def _fill_chunks(self, chunk: ChunkBuilder, records: Bytes, at: Ints) -> None:
        """Add records to a chunk; write it and start another whenever it is full."""
        while len(at) > 1:
            at = at[chunk.fill(records, at) :]
            if chunk.full:
                self._write_chunk(chunk)

    def append_chunk(
        self,
        chunk: Chunk,
        batch: MessageBatch,
        others: ParsedChunk,
        channels: Mapping[int, Channel],
        index: MessageIndex | None = None,
    ) -> bool:
        """Append a chunk as it is, still compressed, if this recording can contain it.

        Parameters
        ----------
        chunk
            A chunk that passed its CRC.
        batch
            All messages of the chunk, in chunk order; at least one.
        others
            All other records of the chunk.
        channels
            By channel id in the chunk.
        index
            Verified message indexes of the chunk. None: they are built.

        Returns
        -------
        bool
            False, and nothing is written, if the chunk mixes images and numbers, is small, or its
            channels have other ids here.

        Raises
        ------
        RecordingError
            If a time is negative.
        """
        if chunk.uncompressed_size < CHUNK_BYTES // 4:
            return False
        index = build_message_index(batch) if index is None else index
        pictured = {channels[number].carries_images for number in index.counts}
        if len(pictured) != 1 or not self.registry.can_copy_chunk(batch, others, channels):
            return False
        self._require_nonnegative_times(batch, channels)
        before = self._images if pictured.pop() else self._numbers
        self._write_chunk(before)  # keeps the order of the messages
        crc = chunk.uncompressed_crc or zlib.crc32(batch.data.data)
        size = chunk.uncompressed_size
        self._write_compressed(
            CompressedChunk(chunk.compression, chunk.data, size, crc, *batch.time_span_ns, index),
            before,
        )
        return True

    def _require_nonnegative_times(
        self, batch: MessageBatch, channels: Mapping[int, Channel]
    ) -> None:
        earliest = np.minimum(batch.time_ns, batch.publish_ns)
        if earliest.min() < 0:
            worst = int(np.argmin(earliest))
            topic = channels[int(batch.channel[worst])].topic
            raise self._negative_time_error(int(batch.time_ns[worst]), topic)

    def add_records(
        self, channel: Channel, records: Bytes, at: Ints, time_ns: Ints, publish_ns: Ints
    ) -> None:
        """Append Message records of one channel whose prefixes are still empty.

        Parameters
        ----------
        channel
            The channel.
        records
            Contiguous records: an empty prefix, then a payload.
        at
            (N + 1,) offset of each record, and the end of the last.
        time_ns, publish_ns
            (N,) times to write, nanoseconds.

        Raises
        ------
        RecordingError
            If a time is negative.
        """
        if min(time_ns.min(), publish_ns.min()) < 0:
            raise self._negative_time_error(int(time_ns.min()), channel.topic)
        number, chunk = self.define_channel(channel)
        numbers = np.full(len(time_ns), number)
        write_message_prefixes(records, at, numbers, time_ns, publish_ns, fresh=True)
        self._fill_chunks(chunk, records, at)

    def flush(self) -> None:
        """Write the open chunks, so that they survive a kill of the process."""
        for chunk in (self._numbers, self._images):
            self._write_chunk(chunk)

    def finish(self) -> None:
        """Write the open chunks and the Summary section.

        Raises
        ------
        OutputError
            If the disk is full.
        """
        self.flush()
        try:
            unused = self.registry.take_unwritten_definitions()
            self._file.finish(*self.registry.list_written_definitions(), unused)
        except OSError as e:
            raise as_output_error(self._path, e) from e

    def define_channel(self, channel: Channel) -> tuple[int, ChunkBuilder]:
        """Return a channel's id and its chunk; define the channel there if it is new."""
        number = self.registry.get_channel_id(channel)
        chunk = self._images if channel.carries_images else self._numbers
        chunk.add_definition(self.registry.definition_records(number))
        return number, chunk

    def _write_chunk(self, chunk: ChunkBuilder) -> None:
        """Write a chunk, if it holds messages."""
        if chunk.starts:
            self._write_compressed(chunk.compress(), chunk)

    def _write_compressed(self, packed: CompressedChunk, chunk: ChunkBuilder) -> None:
        """Write a compressed chunk, then the open chunk of the other kind if that is old."""
        try:
            self._file.add_chunk(packed)
        except OSError as e:
            raise as_output_error(self._path, e) from e
        other = self._images if chunk is self._numbers else self._numbers
        other.age += bool(other.starts)
        if other.age >= self._age_max:
            self._write_chunk(other)

    def _negative_time_error(self, time_ns: int, topic: str) -> RecordingError:
        return RecordingError(
            f"{self._path}: time {time_ns} ns on {topic} is negative, which MCAP cannot hold. "
            "Shift the recording's times"
        )
