"""Write recordings atomically, with their provenance first.

Images are in chunks of their own, so that readers of numbers need not decompress images.
"""

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from google.protobuf.descriptor import Descriptor

from dmrl.atomic_output import as_output_error, partial_file
from dmrl.errors import OutputError, RecordingError
from dmrl.messages import message as message_class
from dmrl.messages import schema_bytes
from dmrl.recording.mcap.channel import Channel, RawMessage
from dmrl.recording.mcap.chunk_builder import OpenChunk
from dmrl.recording.mcap.chunk_writer import OLDEST, Assembly
from dmrl.recording.mcap.file_writer import Container
from dmrl.recording.mcap.message_batch import HEAD_BYTES, Ints
from dmrl.recording.protobuf.encode import Value, encode
from dmrl.recording.provenance import METADATA_NAME, Provenance
from dmrl.samples.sample import Sample
from dmrl.topics import row_of

SUFFIX = ".mcap"
RECIPE_NAME = "recipe.toml"
"""Attachment with the settings of the run as a recipe."""


class RecordingWriter:
    """Writes one recording. The file appears under its name only when it is complete.

    A killed process leaves ``<name>.partial``, which ``dmrl recover`` reads. It contains all
    messages except those in the two open chunks, one of images and one of numbers.

    Parameters
    ----------
    path
        File to write. It must not exist.
    provenance
        Stage, settings and inputs. Written before the first message.
    recipe
        Text of the recipe of the run. None: the settings as TOML.
    keep_on_error
        Keep ``<name>.partial`` after an error, for work that can be resumed.

    Raises
    ------
    OutputError
        If the file exists, its suffix is not ``.mcap``, its folder does not exist, or the disk is
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
        if SUFFIX not in path.suffixes:  # a resumed recording is out.mcap.kept for a while
            raise OutputError(f"{path} is not named like a recording. Use {path.name}{SUFFIX}")
        self._path = path
        self._topics: dict[str, tuple[type, int, OpenChunk]] = {}
        self._resources = ExitStack()
        partial = self._resources.enter_context(partial_file(path, keep_on_error=keep_on_error))
        try:
            self._file = Container(partial, f"dmrl {provenance.dmrl_version}")
            self._resources.callback(self._file.close)
            # Work that can be resumed leaves complete moments: images with their numbers.
            self.chunks = Assembly(path, self._file, 1 if keep_on_error else OLDEST)
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
        """Append one message. Times need not increase; readers sort them.

        Parameters
        ----------
        time_ns
            Log time: time of the measurement, nanoseconds.
        topic
            Topic, as in ``topics.py``.
        message
            A message of the topic's type.
        publish_ns
            Time of reception, nanoseconds. None: the log time.

        Raises
        ------
        RecordingError
            If dmrl's topic carries another message type, or the time is negative.
        """
        known = self._topics.get(topic)
        if known is None or known[0] is not type(message):
            channel = channel_for(topic, message.DESCRIPTOR)
            known = type(message), *self.chunks.begin(channel)
            self._topics[topic] = known
        _, number, chunk = known
        publish_ns = time_ns if publish_ns is None else publish_ns
        self.chunks.add(number, chunk, time_ns, publish_ns, message.SerializeToString())

    def write_sample(self, sample: Sample) -> None:
        """Append one sample as a message; see `write`."""
        built = message_class(sample.message)(**sample.fields)
        self.write(sample.time_ns, sample.topic, built, publish_ns=sample.publish_ns)

    def write_columns(
        self,
        topic: str,
        kind: Any,
        time_ns: Ints,
        fields: Mapping[str, Value],
        *,
        publish_ns: Ints | None = None,
    ) -> None:
        """Append many messages of one topic from columns, ten times faster than `write`.

        Parameters
        ----------
        topic
            Topic, as in ``topics.py``.
        kind
            Message class: ``message("Attitude")``.
        time_ns
            (N,) log times, nanoseconds.
        fields
            By name: (N,) numbers or texts, (N, K) for a repeated field, one value for all, or the
            fields of a sub-message. Missing fields have their default.
        publish_ns
            (N,) times of reception, nanoseconds. None: the log times.

        Raises
        ------
        RecordingError
            If dmrl's topic carries another message type, or a time is negative.
        TypeError, ValueError
            If a column does not fit the message type.
        """
        if not len(time_ns):
            return
        channel = channel_for(topic, kind.DESCRIPTOR)
        records, at = encode(kind.DESCRIPTOR, fields, len(time_ns), HEAD_BYTES)
        publish_ns = time_ns if publish_ns is None else publish_ns
        self.chunks.add_records(channel, records, at, time_ns, publish_ns)

    def write_raw(self, raw: RawMessage) -> None:
        """Append a message of another recording, its payload bit for bit."""
        number, chunk = self.chunks.begin(raw.channel)
        self.chunks.add(number, chunk, raw.time_ns, raw.publish_ns, raw.data)

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Append a metadata record, such as the split of the source."""
        self._file.add_metadata(name, values)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Append an attachment."""
        self._file.add_attachment(name, media_type, data)

    def flush(self) -> None:
        """Write the open chunks, so that they survive a kill of the process."""
        self.chunks.flush()

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
            self.chunks.finish()
        except OutputError as e:
            self._abandon(e)
            raise
        self._resources.close()


def channel_for(topic: str, kind: Descriptor) -> Channel:
    """Build the channel of a topic for a message type.

    Raises
    ------
    RecordingError
        If dmrl's topic carries another type.
    """
    schema_name = str(kind.full_name)
    row = row_of(topic)
    if row is not None and not row.carries(schema_name):
        raise RecordingError(f"{topic} carries {row.message}, not {schema_name}. Use its own topic")
    return Channel(topic, schema_name, schema_bytes(kind))
