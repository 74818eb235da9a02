"""What a recording says of a topic, one message of it, and which topics hold pictures."""

from dataclasses import dataclass, field
from functools import cache

PICTURES = ("Image", "Video", "GridMap", "Grid", "PointCloud", "PointCloud2")
"""How the names of message types end that are large and seldom read with the rest."""


@dataclass(frozen=True, slots=True)
class Channel:
    """What a recording says of one topic: its name, schema and encodings."""

    topic: str
    schema_name: str
    schema_data: bytes
    schema_encoding: str = "protobuf"
    encoding: str = "protobuf"
    metadata: tuple[tuple[str, str], ...] = ()
    pictured: bool = field(init=False, repr=False, compare=False)
    """Whether its messages stand in chunks of pictures, apart from numbers."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "pictured", holds_pictures(self.schema_name))


@cache
def holds_pictures(schema_name: str) -> bool:
    """Whether messages of this type are pictures: images, masks, depths, network maps."""
    return schema_name.endswith(PICTURES)


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
