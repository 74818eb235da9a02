"""Define channels and raw messages, and which message types hold images."""

from dataclasses import dataclass, field
from functools import cache

IMAGE_TYPE_SUFFIXES = ("Image", "Video", "GridMap", "Grid", "PointCloud", "PointCloud2")
"""Suffixes of the names of message types that hold images or other large arrays.

Their messages are large and seldom read together with the rest.
"""


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel: topic, schema and encodings.

    Channels compare by content. The channel id belongs to a file, so it is not a field.
    """

    topic: str
    schema_name: str
    schema_data: bytes
    schema_encoding: str = "protobuf"
    encoding: str = "protobuf"
    metadata: tuple[tuple[str, str], ...] = ()
    carries_images: bool = field(init=False, repr=False, compare=False)
    """Whether the messages are images. They are written into chunks of their own."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "carries_images", is_image_type(self.schema_name))


@cache
def is_image_type(schema_name: str) -> bool:
    """Return whether a message type holds images, masks, depths or network maps."""
    return schema_name.endswith(IMAGE_TYPE_SUFFIXES)


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
