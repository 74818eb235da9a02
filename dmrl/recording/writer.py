"""Write recordings atomically, with their provenance first.

Images are in chunks of their own, so that readers of numbers need not decompress images.
"""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from google.protobuf.descriptor import Descriptor
from mcap.records import Attachment

from dmrl.atomic_output import as_output_error, atomic_file
from dmrl.errors import OutputError, RecordingError
from dmrl.messages import message_class as message_class
from dmrl.messages import serialize_schema
from dmrl.recording.mcap import checksums
from dmrl.recording.mcap.channel import Channel, RawMessage
from dmrl.recording.mcap.chunks.chunk_builder import ChunkBuilder
from dmrl.recording.mcap.chunks.chunk_writer import OPEN_CHUNK_AGE_MAX, ChunkWriter
from dmrl.recording.mcap.file_writer import McapFileWriter
from dmrl.recording.mcap.message_batch import MESSAGE_PREFIX_BYTES, Ints
from dmrl.recording.protobuf.encode import ColumnValue, encode
from dmrl.recording.provenance import METADATA_NAME, Provenance
from dmrl.recording.summary import Summary
from dmrl.samples.sample import Columns, Sample
from dmrl.terminal.left_out import count_so_far
from dmrl.topics import find_topic

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
        Stage, settings and inputs. Written before the first message, and again at the end with the
        counts of `dmrl.terminal.left_out`, if something was left out.
    recipe
        Text of the recipe of the run. None: the settings as TOML.
    profile
        Profile of the Header record, such as that of a recording that is copied.
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
        profile: str = "dmrl",
        keep_on_error: bool = False,
    ) -> None:
        if SUFFIX not in path.suffixes:  # a resumed recording is out.mcap.kept for a while
            raise OutputError(f"{path} is not named like a recording. Use {path.name}{SUFFIX}")
        self._path, self._provenance = path, provenance
        self._topics: dict[str, tuple[type, int, ChunkBuilder]] = {}
        self._resources = ExitStack()
        partial = self._resources.enter_context(atomic_file(path, keep_on_error=keep_on_error))
        try:
            self._file = McapFileWriter(partial, f"dmrl {provenance.dmrl_version}", profile)
            self._resources.callback(self._file.close)
            # Work that can be resumed leaves complete moments: images with their numbers.
            self.chunk_writer = ChunkWriter(
                path, self._file, 1 if keep_on_error else OPEN_CHUNK_AGE_MAX
            )
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
        cached = self._topics.get(topic)
        if cached is None or cached[0] is not type(message):
            channel = build_topic_channel(topic, message.DESCRIPTOR)
            cached = type(message), *self.chunk_writer.define_channel(channel)
            self._topics[topic] = cached
        _, number, chunk = cached
        publish_ns = time_ns if publish_ns is None else publish_ns
        data = message.SerializeToString()
        self.chunk_writer.add_message(number, chunk, time_ns, publish_ns, data)

    def write_sample(self, sample: Sample) -> None:
        """Append one sample as a message; see `write`."""
        built = message_class(sample.message)(**sample.fields)
        self.write(sample.time_ns, sample.topic, built, publish_ns=sample.publish_ns)

    def write_columns(
        self,
        topic: str,
        kind: Any,
        time_ns: Ints,
        fields: Mapping[str, ColumnValue],
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
        channel = build_topic_channel(topic, kind.DESCRIPTOR)
        records, at = encode(kind.DESCRIPTOR, fields, len(time_ns), MESSAGE_PREFIX_BYTES)
        publish_ns = time_ns if publish_ns is None else publish_ns
        self.chunk_writer.add_records(channel, records, at, time_ns, publish_ns)

    def write_series(self, series: Columns) -> None:
        """Append samples of one topic as messages; see `write_columns`."""
        kind = message_class(series.message)
        self.write_columns(series.topic, kind, series.time_ns, series.fields)

    def write_raw(self, raw: RawMessage) -> None:
        """Append a message of another recording, its payload bit for bit."""
        number, chunk = self.chunk_writer.define_channel(raw.channel)
        self.chunk_writer.add_message(number, chunk, raw.time_ns, raw.publish_ns, raw.data)

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Append a metadata record, such as the split of the source."""
        self._file.add_metadata(name, values)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Append an attachment."""
        self.copy_attachment(Attachment(0, 0, name, media_type, data))

    def copy_attachment(self, attachment: Attachment) -> None:
        """Append an attachment of another recording, with its times and media type."""
        self._file.add_attachment(attachment)

    def copy_extras(self, source: Summary) -> None:
        """Copy metadata and attachments of another recording.

        Provenance and recipe are left out: the provenance of this recording includes them.
        """
        for name, records in source.metadata.items():
            if name not in (METADATA_NAME, checksums.METADATA_NAME):
                for values in records:
                    self.add_metadata(name, values)
        for attachment in source.attachments:
            if attachment.name != RECIPE_NAME:
                self.copy_attachment(attachment)

    def flush(self) -> None:
        """Write the open chunks, so that they survive a kill of the process."""
        self.chunk_writer.flush()

    def _abandon(self, error: BaseException) -> None:
        self._resources.__exit__(type(error), error, error.__traceback__)

    def __exit__(self, *raised: Any) -> None:
        if raised[1] is not None:
            self._resources.__exit__(*raised)
            return
        try:
            if left_out := count_so_far():  # readers take the last record of this name
                made = replace(self._provenance, left_out=left_out)
                self._file.add_metadata(METADATA_NAME, made.to_metadata())
            self.chunk_writer.finish()
        except (OSError, OutputError) as e:
            self._abandon(e)
            raise (as_output_error(self._path, e) if isinstance(e, OSError) else e) from e
        self._resources.close()


def build_topic_channel(topic: str, kind: Descriptor) -> Channel:
    """Build the channel of a topic for a message type.

    Raises
    ------
    RecordingError
        If dmrl's topic carries another type.
    """
    schema_name = str(kind.full_name)
    row = find_topic(topic)
    if row is not None and not row.accepts_message(schema_name):
        raise RecordingError(f"{topic} carries {row.message}, not {schema_name}. Use its own topic")
    return Channel(topic, schema_name, serialize_schema(kind))
