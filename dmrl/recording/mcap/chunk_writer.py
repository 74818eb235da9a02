"""Messages to chunks: pictures to one, numbers to another, each written when it is full."""

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
"""Chunks of pictures that numbers wait for at most: few and large ones are read faster."""


class Assembly:
    """The chunks of a recording that is written.

    Parameters
    ----------
    path
        The recording, for errors.
    file
        Takes what is full.
    oldest
        A chunk is written, full or not, once so many of the other kind were written after its
        start.
    """

    def __init__(self, path: Path, file: Container, oldest: int = OLDEST) -> None:
        self._path, self._file, self._oldest = path, file, oldest
        self._defined = Defined()
        self._numbers, self._pictures = OpenChunk(), OpenChunk()

    def add(
        self, number: int, chunk: OpenChunk, time_ns: int, publish_ns: int, payload: bytes
    ) -> None:
        """Append one message of a channel that was begun.

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
        """Number channels of a recording that is copied as they are there; see `Defined`."""
        self._defined.adopt(channels, records)

    def append(self, block: Block, channels: Mapping[int, Channel]) -> None:
        """Append many messages, bit for bit.

        Parameters
        ----------
        block
            The messages, with the times that they are to have.
        channels
            By their numbers in it.

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
        """Append messages that are all pictures, or none of them."""
        self._refuse_negative(block, channels)
        numbers = np.zeros(max(channels) + 1, np.int64)
        for number, channel in channels.items():
            numbers[number], chunk = self.begin(channel)
        records, at = block.records()
        set_heads(records, at, numbers[block.channel], block.time_ns, block.publish_ns)
        self._fill(chunk, records, at)

    def _fill(self, chunk: OpenChunk, records: Bytes, at: Ints) -> None:
        """Put records into a chunk, and as many after it as they need."""
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
        """Append a chunk as it is, still compressed, if it can stand in this recording.

        Parameters
        ----------
        chunk
            A chunk that passed its CRC.
        block
            All of its messages, in the order of the chunk.
        channels
            By their numbers in it.
        index
            Its message indexes, if they are known to be right.

        Returns
        -------
        bool
            False: it mixes pictures and numbers, is small, or channels have other numbers here.
            Nothing was written then.

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
        self._close(before)  # what came before it stands before it
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
        """Append messages of one channel, laid out but for their heads.

        Parameters
        ----------
        channel
            The channel.
        records
            Room for a head, then a message, one after another.
        at
            (N + 1,) where each starts, and the end of the last.
        time_ns, publish_ns
            (N,) times.

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
        """Close the open chunks, so that a killed process keeps them."""
        for chunk in (self._numbers, self._pictures):
            self._close(chunk)

    def finish(self) -> None:
        """Close the open chunks, and write the summary.

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
        """Number of a channel, defined before its first message, and the chunk it goes to."""
        number = self._defined.number(channel)
        chunk = self._pictures if channel.pictured else self._numbers
        chunk.define(self._defined.begin(number))
        return number, chunk

    def _close(self, chunk: OpenChunk) -> None:
        """Write a chunk, if it holds messages."""
        if chunk.starts:
            self._put(chunk.packed(), chunk)

    def _put(self, packed: Packed, chunk: OpenChunk) -> None:
        """Write what was in a chunk, and the other one if it is old."""
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
