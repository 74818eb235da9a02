"""Writing a recording: whole or absent, with its provenance at the front.

Pictures stand in chunks of their own, so that whoever reads numbers unpacks no picture.
"""

import zlib
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from google.protobuf.descriptor import Descriptor
from mcap.records import Channel as McapChannel
from mcap.records import Chunk

from dmrl.errors import OutputError, RecordingError
from dmrl.messages import schema_bytes
from dmrl.output import as_output_error, partial_file
from dmrl.recording.block import HEAD_BYTES, Block
from dmrl.recording.channel import Channel, RawMessage
from dmrl.recording.chunks import set_heads
from dmrl.recording.container import Container, Packed
from dmrl.recording.defined import Defined
from dmrl.recording.open_chunk import CHUNK_BYTES, OpenChunk
from dmrl.recording.provenance import METADATA_NAME, Provenance
from dmrl.topics import row_of

SUFFIX = ".mcap"
RECIPE_NAME = "recipe.toml"
OLDEST = 16
"""A chunk is written, full or not, once so many of the other kind were written after its start."""


class RecordingWriter:
    """Writes one recording; the file appears under its name only when complete.

    A killed process leaves ``<name>.partial``, which ``dmrl recover`` reads: everything
    before the open chunks, one of pictures and one of the rest, is in it.

    Parameters
    ----------
    path
        File to write; must not exist.
    provenance
        Stage, settings and inputs; written before the first message.
    recipe
        Text of the recipe that was run. None: the settings as TOML.
    keep_on_error
        Leave ``<name>.partial`` when the work stops: for work that can be resumed.

    Raises
    ------
    OutputError
        If the file exists, is not called ``.mcap``, its folder does not exist, or the disk is
        full.
    """

    def __init__(
        self,
        path: Path,
        provenance: Provenance,
        *,
        recipe: str | None = None,
        keep_on_error: bool = False,
    ) -> None:
        if SUFFIX not in path.suffixes:  # a resumed one is out.mcap.kept for a while
            raise OutputError(f"{path} is no name of a recording. Call it {path.name}{SUFFIX}")
        self._path = path
        self._defined = Defined()
        self._topics: dict[str, tuple[type, int, OpenChunk]] = {}
        self._numbers, self._pictures = OpenChunk(), OpenChunk()
        self._resources = ExitStack()
        partial = self._resources.enter_context(partial_file(path, keep_on_error=keep_on_error))
        try:
            self._file = Container(partial, f"dmrl {provenance.dmrl_version}")
            self._resources.callback(self._file.close)
            self._file.add_metadata(METADATA_NAME, provenance.to_metadata())
            text = provenance.to_recipe() if recipe is None else recipe
            self.add_attachment(RECIPE_NAME, "application/toml", text.encode())
        except OSError as e:
            self._abandon(e)
            raise as_output_error(path, e) from e

    def __enter__(self) -> Self:
        return self

    def write(
        self, time_ns: int, topic: str, message: Any, *, publish_ns: int | None = None
    ) -> None:
        """Append one message. Times need not increase; readers sort.

        Parameters
        ----------
        time_ns
            Log time: the sensor's time, nanoseconds.
        topic
            Topic, as in ``topics.py``.
        message
            A message of the type that the topic carries.
        publish_ns
            When it was received, nanoseconds. None: the log time.

        Raises
        ------
        RecordingError
            If the topic is dmrl's and carries another message type, or the time is negative.
        """
        known = self._topics.get(topic)
        if known is None or known[0] is not type(message):
            channel = channel_for(topic, message.DESCRIPTOR)
            known = type(message), *self._begin(channel)
            self._topics[topic] = known
        _, number, chunk = known
        publish_ns = time_ns if publish_ns is None else publish_ns
        if time_ns < 0 or publish_ns < 0:
            raise self._negative(time_ns, topic)
        chunk.add(number, time_ns, publish_ns, message.SerializeToString())
        if chunk.full:
            self._close(chunk)

    def write_raw(self, raw: RawMessage) -> None:
        """Append a message of another recording, bit for bit."""
        if raw.time_ns < 0 or raw.publish_ns < 0:
            raise self._negative(raw.time_ns, raw.topic)
        number, chunk = self._begin(raw.channel)
        chunk.add(number, raw.time_ns, raw.publish_ns, raw.data)
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
            numbers[number], chunk = self._begin(channel)
        records, at = block.records()
        set_heads(records, at[:-1], numbers[block.channel], block.time_ns, block.publish_ns)
        while len(at) > 1:
            at = at[chunk.fill(records, at) :]
            if chunk.full:
                self._close(chunk)

    def append_chunk(self, chunk: Chunk, block: Block, channels: Mapping[int, Channel]) -> bool:
        """Append a chunk as it is, still compressed, if it can stand in this recording.

        Parameters
        ----------
        chunk
            A chunk that passed its CRC.
        block
            All of its messages, in the order of the chunk.
        channels
            By their numbers in it.

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
        pictured = {channels[number].pictured for number in block.numbers()}
        small = chunk.uncompressed_size < CHUNK_BYTES // 4
        if len(pictured) != 1 or small or not self._defined.begin_in(block, channels):
            return False
        self._refuse_negative(block, channels)
        before = self._pictures if pictured.pop() else self._numbers
        self._close(before)  # what came before it stands before it
        crc = chunk.uncompressed_crc or zlib.crc32(block.data.data)
        places = block.channel, block.time_ns, block.start - HEAD_BYTES
        packed = Packed(chunk.compression, chunk.data, chunk.uncompressed_size, crc, *places)
        self._put(packed, before)
        return True

    def _refuse_negative(self, block: Block, channels: Mapping[int, Channel]) -> None:
        earliest = np.minimum(block.time_ns, block.publish_ns)
        if earliest.min() < 0:
            worst = int(np.argmin(earliest))
            topic = channels[int(block.channel[worst])].topic
            raise self._negative(int(block.time_ns[worst]), topic)

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Append named strings, such as the source's own split."""
        self._file.add_metadata(name, values)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Append a named file."""
        self._file.add_attachment(name, media_type, data)

    def flush(self) -> None:
        """Close the open chunks, so that a killed process keeps them."""
        for chunk in (self._numbers, self._pictures):
            self._close(chunk)

    def _begin(self, channel: Channel) -> tuple[int, OpenChunk]:
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
        if other.age >= OLDEST:
            self._close(other)

    def _negative(self, time_ns: int, topic: str) -> RecordingError:
        return RecordingError(
            f"{self._path}: time {time_ns} ns on {topic} is negative, which MCAP cannot hold. "
            "Shift the recording's times"
        )

    def _abandon(self, error: BaseException) -> None:
        self._resources.__exit__(type(error), error, error.__traceback__)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if error is not None:
            self._resources.__exit__(kind, error, traceback)
            return
        try:
            self.flush()
            self._file.finish(*self._defined.all_begun())
        except (OSError, OutputError) as e:
            self._abandon(e)
            raise (e if isinstance(e, OutputError) else as_output_error(self._path, e)) from e
        self._resources.close()


def channel_for(topic: str, kind: Descriptor) -> Channel:
    """The channel of a topic that carries a type of message.

    Raises
    ------
    RecordingError
        If the topic is dmrl's and carries another.
    """
    schema_name = str(kind.full_name)
    row = row_of(topic)
    if row is not None and not row.carries(schema_name):
        raise RecordingError(f"{topic} carries {row.message}, not {schema_name}. Use its own topic")
    return Channel(topic, schema_name, schema_bytes(kind))
