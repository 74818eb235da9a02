"""Define channels and raw messages, and which message types hold images."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache

from mcap.exceptions import McapError
from mcap.records import Channel as McapChannel
from mcap.records import Schema

IMAGE_TYPE_SUFFIXES = ("Image", "Video", "GridMap", "Grid", "PointCloud", "PointCloud2")
"""Suffixes of the names of message types that hold images or other large arrays.

Their messages are large and seldom read together with the rest.
"""


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel: topic, schema and encodings.

    Channels compare by content. The channel id belongs to a file, so it is not a field. ``repeat``
    counts the channels of the same content before this one in its file.
    """

    topic: str
    schema_name: str
    schema_data: bytes
    schema_encoding: str = "protobuf"
    encoding: str = "protobuf"
    metadata: tuple[tuple[str, str], ...] = ()
    repeat: int = 0
    carries_images: bool = field(init=False, repr=False, compare=False)
    """Whether the messages are images. They are written into chunks of their own."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "carries_images", is_image_type(self.schema_name))


@cache
def is_image_type(schema_name: str) -> bool:
    """Return whether a message type holds images, masks, depths or network maps."""
    return schema_name.endswith(IMAGE_TYPE_SUFFIXES)


class ChannelTable(dict[int, Channel]):
    """Channels of a file, by channel id."""

    def __init__(self) -> None:
        self._numbers: dict[Channel, int] = {}

    def define(self, record: McapChannel, schemas: Mapping[int, Schema]) -> Channel:
        """Add the channel of a Channel record, or replace it.

        Raises
        ------
        McapError
            If its schema is missing.
        """
        schema = schemas.get(record.schema_id)
        if schema is None and record.schema_id != 0:
            raise McapError(f"no schema for {record.topic}")
        kind = ("", b"", "") if schema is None else (schema.name, schema.data, schema.encoding)
        metadata = tuple(sorted(record.metadata.items()))
        channel = Channel(record.topic, *kind, record.message_encoding, metadata)
        while self._numbers.setdefault(channel, record.id) != record.id:
            channel = replace(channel, repeat=channel.repeat + 1)
        self[record.id] = channel
        return channel


def build_channels(
    records: Mapping[int, McapChannel], schemas: Mapping[int, Schema]
) -> ChannelTable:
    """Build the channels of a file from its Channel and Schema records.

    Raises
    ------
    McapError
        If the schema of a channel is not among them.
    """
    found = ChannelTable()
    for record in records.values():
        found.define(record, schemas)
    return found


@dataclass(frozen=True, slots=True)
class RawMessage:
    """One message with its undecoded payload.

    Parameters
    ----------
    time_ns
        Log time: time of the measurement, nanoseconds.
    publish_ns
        Publish time: time of reception, nanoseconds.
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
        """Full name of the message type."""
        return self.channel.schema_name
