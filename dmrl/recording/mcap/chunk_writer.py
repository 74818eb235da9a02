"""Collect messages into chunks, images and numbers apart, and write each chunk when it is full."""

import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from mcap.records import Channel as McapChannel
from mcap.records import Chunk

from dmrl.atomic_output import as_output_error
from dmrl.errors import RecordingError
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.channel_registry import Defined
from dmrl.recording.mcap.chunk import set_heads
from dmrl.recording.mcap.chunk_builder import CHUNK_BYTES, OpenChunk
from dmrl.recording.mcap.file_writer import Container, Packed
from dmrl.recording.mcap.message_batch import Block, Bytes, Ints
from dmrl.recording.mcap.message_index import MessageIndex, index_of

OLDEST = 16
"""Chunks of the other kind after which an open chunk is written.

Numbers are rare beside images: few and large chunks of them are read faster.
"""


class Assembly:
    """Write the chunks of a recording.

    Parameters
    ----------
    path
        The recording, for errors.
    file
        File that receives the full chunks.
    age_max
        A chunk is written, full or not, after this many later chunks of the other kind.
    """

    def __init__(self, path: Path, file: Container, oldest: int = OLDEST) -> None:
        self._path, self._file, self._oldest = path, file, oldest
        self._defined = Defined()
        self._numbers, self._pictures = OpenChunk(), OpenChunk()

    def add(
        self, number: int, chunk: OpenChunk, time_ns: int, publish_ns: int, payload: bytes
    ) -> None:
        """Append one message of a channel that `define_channel` returned.

        Raises
        ------
        RecordingError
            If a time is negative.
        """
        if time_ns < 0 or publish_ns < 0:
            raise self._negative(time_ns, self._defined.topic(number))
        chunk.add(number, time_ns, publish_ns, payload)
        if chunk.full:
            self._close(chunk)

    def adopt(self, channels: Mapping[int, Channel], records: Mapping[int, McapChannel]) -> None:
        """Assign the channel ids of a recording that is copied; see `ChannelRegistry`."""
        self._defined.adopt(channels, records)

    def append(self, block: Block, channels: Mapping[int, Channel]) -> None:
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
        present = block.numbers()
        for pictured in (False, True):
            own = [number for number in present if channels[number].pictured == pictured]
            if own:
                part = block if len(own) == len(present) else block.of(own)
                self._append(part, {number: channels[number] for number in own})

    def _append(self, block: Block, channels: Mapping[int, Channel]) -> None:
        """Append messages that are all images, or all numbers."""
        self._refuse_negative(block, channels)
        numbers = np.zeros(max(channels) + 1, np.int64)
        for number, channel in channels.items():
            numbers[number], chunk = self.begin(channel)
        records, at = block.records()
        set_heads(records, at, numbers[block.channel], block.time_ns, block.publish_ns)
        self._fill(chunk, records, at)

    def _fill(self, chunk: OpenChunk, records: Bytes, at: Ints) -> None:
        """Add records to a chunk; write it and start another whenever it is full."""
        while len(at) > 1:
            at = at[chunk.fill(records, at) :]
            if chunk.full:
                self._close(chunk)

    def append_chunk(
        self,
        chunk: Chunk,
        block: Block,
        channels: Mapping[int, Channel],
        index: MessageIndex | None = None,
    ) -> bool:
        """Append a chunk as it is, still compressed, if this recording can contain it.

        Parameters
        ----------
        chunk
            A chunk that passed its CRC.
        batch
            All messages of the chunk, in chunk order.
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
        index = index_of(block) if index is None else index
        pictured = {channels[number].pictured for number in index.counts}
        if len(pictured) != 1 or not self._defined.begin_in(block, channels):
            return False
        self._refuse_negative(block, channels)
        before = self._pictures if pictured.pop() else self._numbers
        self._close(before)  # keeps the order of the messages
        crc = chunk.uncompressed_crc or zlib.crc32(block.data.data)
        size = chunk.uncompressed_size
        self._put(Packed(chunk.compression, chunk.data, size, crc, *block.span, index), before)
        return True

    def _refuse_negative(self, block: Block, channels: Mapping[int, Channel]) -> None:
        earliest = np.minimum(block.time_ns, block.publish_ns)
        if earliest.min() < 0:
            worst = int(np.argmin(earliest))
            topic = channels[int(block.channel[worst])].topic
            raise self._negative(int(block.time_ns[worst]), topic)

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
            raise self._negative(int(time_ns.min()), channel.topic)
        number, chunk = self.begin(channel)
        numbers = np.full(len(time_ns), number)
        set_heads(records, at, numbers, time_ns, publish_ns, fresh=True)
        self._fill(chunk, records, at)

    def flush(self) -> None:
        """Write the open chunks, so that they survive a kill of the process."""
        for chunk in (self._numbers, self._pictures):
            self._close(chunk)

    def finish(self) -> None:
        """Write the open chunks and the Summary section.

        Raises
        ------
        OutputError
            If the disk is full.
        """
        self.flush()
        try:
            self._file.finish(*self._defined.all_begun())
        except OSError as e:
            raise as_output_error(self._path, e) from e

    def begin(self, channel: Channel) -> tuple[int, OpenChunk]:
        """Return a channel's id and its chunk; define the channel there if it is new."""
        number = self._defined.number(channel)
        chunk = self._pictures if channel.pictured else self._numbers
        chunk.define(self._defined.begin(number))
        return number, chunk

    def _close(self, chunk: OpenChunk) -> None:
        """Write a chunk, if it holds messages."""
        if chunk.starts:
            self._put(chunk.packed(), chunk)

    def _put(self, packed: Packed, chunk: OpenChunk) -> None:
        """Write a compressed chunk, then the open chunk of the other kind if that is old."""
        try:
            self._file.add_chunk(packed)
        except OSError as e:
            raise as_output_error(self._path, e) from e
        other = self._pictures if chunk is self._numbers else self._numbers
        other.age += bool(other.starts)
        if other.age >= self._oldest:
            self._close(other)

    def _negative(self, time_ns: int, topic: str) -> RecordingError:
        return RecordingError(
            f"{self._path}: time {time_ns} ns on {topic} is negative, which MCAP cannot hold. "
            "Shift the recording's times"
        )
