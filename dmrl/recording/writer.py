"""Writing a recording: whole or absent, with its provenance at the front."""

import io
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from google.protobuf.descriptor import Descriptor
from mcap.writer import CompressionType, Writer

from dmrl.errors import OutputError, RecordingError
from dmrl.messages import schema_bytes
from dmrl.output import as_output_error, partial_file
from dmrl.recording import sums
from dmrl.recording.provenance import METADATA_NAME, Provenance
from dmrl.topics import row_of

# 256 KiB costs no size against 1 MiB and bounds what a crash can lose.
CHUNK_BYTES = 256 * 1024
SUFFIX = ".mcap"
RECIPE_NAME = "recipe.toml"


@dataclass(frozen=True, slots=True)
class Channel:
    """What a recording says of one topic: its name, schema and encodings."""

    topic: str
    schema_name: str
    schema_data: bytes
    schema_encoding: str = "protobuf"
    encoding: str = "protobuf"
    metadata: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class RawMessage:
    """One message as it stands in the file.

    Parameters
    ----------
    time_ns
        Log time: the sensor's time, nanoseconds.
    publish_ns
        Publish time: when it was received, nanoseconds.
    channel
        Topic and schema.
    data
        Serialized message.
    """

    time_ns: int
    publish_ns: int
    channel: Channel
    data: bytes = field(repr=False)

    @property
    def topic(self) -> str:
        """Topic of the message."""
        return self.channel.topic

    @property
    def schema_name(self) -> str:
        """Full name of the message's type."""
        return self.channel.schema_name


class _WriteThrough(io.BufferedWriter):
    """Hands every finished chunk to the system, so that a killed process keeps it."""

    def __init__(self, raw: io.RawIOBase) -> None:
        super().__init__(raw)
        self.sums = sums.Sums()

    def write(self, data: Any) -> int:
        self.sums.add(data)
        count = super().write(data)
        self.flush()
        return count


class RecordingWriter:
    """Writes one recording; the file appears under its name only when complete.

    A killed process leaves ``<name>.partial``, which ``dmrl recover`` reads: everything
    before the open chunk is in it.

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
        self._channels: dict[Channel, int] = {}
        self._known: dict[str, Channel] = {}
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._resources = ExitStack()
        partial = self._resources.enter_context(partial_file(path, keep_on_error=keep_on_error))
        try:
            raw = self._resources.enter_context(io.FileIO(partial, "wb"))
            self._stream = _WriteThrough(raw)
            self._writer = Writer(
                self._stream,
                chunk_size=CHUNK_BYTES,
                compression=CompressionType.ZSTD,
                enable_data_crcs=True,
            )
            self._writer.start(profile="dmrl", library=f"dmrl {provenance.dmrl_version}")
            self._writer.add_metadata(METADATA_NAME, provenance.to_metadata())
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
        channel = self._known.get(topic)
        if channel is None or channel.schema_name != message.DESCRIPTOR.full_name:
            channel = self._known[topic] = self._channel_for(topic, message.DESCRIPTOR)
        publish_ns = time_ns if publish_ns is None else publish_ns
        self.write_raw(RawMessage(time_ns, publish_ns, channel, message.SerializeToString()))

    def write_raw(self, raw: RawMessage) -> None:
        """Append a message of another recording, bit for bit."""
        if raw.time_ns < 0 or raw.publish_ns < 0:
            raise RecordingError(
                f"{self._path}: time {raw.time_ns} ns on {raw.topic} is negative, which MCAP "
                "cannot hold. Shift the recording's times"
            )
        try:
            number = self._channels.get(raw.channel)
            if number is None:
                number = self._channels[raw.channel] = self._register(raw.channel)
            self._writer.add_message(number, raw.time_ns, raw.data, raw.publish_ns)
        except OSError as e:
            raise as_output_error(self._path, e) from e

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Append named strings, such as the source's own split."""
        self._writer.add_metadata(name, values)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Append a named file."""
        self._writer.add_attachment(0, 0, name, media_type, data)

    def flush(self) -> None:
        """Close the open chunk, so that a killed process keeps it."""
        self._writer.flush()

    def _channel_for(self, topic: str, kind: Descriptor) -> Channel:
        schema_name = str(kind.full_name)
        row = row_of(topic)
        if row is not None and not row.carries(schema_name):
            raise RecordingError(
                f"{topic} carries {row.message}, not {schema_name}. Use its own topic"
            )
        return Channel(topic, schema_name, schema_bytes(kind))

    def _register(self, channel: Channel) -> int:
        key = (channel.schema_name, channel.schema_data)
        if key not in self._schemas:
            self._schemas[key] = self._writer.register_schema(
                channel.schema_name, channel.schema_encoding, channel.schema_data
            )
        return self._writer.register_channel(
            channel.topic, channel.encoding, self._schemas[key], dict(channel.metadata)
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
            self._writer.flush()  # its sums are to cover the last chunk, too
            self._writer.add_metadata(sums.METADATA_NAME, self._stream.sums.to_metadata())
            self._writer.finish()
        except OSError as e:
            self._abandon(e)
            raise as_output_error(self._path, e) from e
        self._resources.close()
