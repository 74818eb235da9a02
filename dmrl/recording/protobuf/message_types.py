"""Message types of topics: whether they are what they should be, and how their bytes are read.

A recording brings its own schemas. dmrl's own are used where it knows the name.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

from google.protobuf.descriptor import Descriptor
from google.protobuf.message import DecodeError

from dmrl.errors import RecordingError
from dmrl.messages import descriptor, pool_of
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.file import damaged
from dmrl.recording.mcap.summary_index import TopicInfo
from dmrl.topics import row_of


def require_types(path: Path, topics: Mapping[str, TopicInfo], chosen: Iterable[str]) -> None:
    """Nothing, if topics of dmrl's carry the types they should.

    Raises
    ------
    RecordingError
        If one does not.
    """
    for topic in sorted(chosen):
        row = row_of(topic)
        if row is not None and not row.carries(topics[topic].schema):
            raise RecordingError(
                f"{path}: {topic} carries {topics[topic].schema or 'no schema'}, not "
                f"{row.message}. Convert the recording: dmrl convert --help"
            )


def descriptor_of(path: Path, channel: Channel) -> Descriptor:
    """Type of a channel's messages: dmrl's own where it knows it, else the recording's.

    Raises
    ------
    RecordingError
        If the channel is not protobuf, or its schema cannot be read.
    """
    if channel.encoding != "protobuf" or channel.schema_encoding != "protobuf":
        raise RecordingError(
            f"{path}: {channel.topic} is {channel.encoding or 'without encoding'}, not protobuf. "
            "Leave it out, or convert it: dmrl convert --help"
        )
    try:
        return descriptor(channel.schema_name)
    except KeyError:
        pass
    try:
        return pool_of(channel.schema_data).FindMessageTypeByName(channel.schema_name)
    except (DecodeError, TypeError, KeyError) as e:
        raise damaged(path, f"schema {channel.schema_name}: {e}") from e


def one_type(path: Path, topic: str, kinds: set[Descriptor]) -> Descriptor:
    """The type of a topic's messages. It may have several channels, after a merge for instance.

    Raises
    ------
    RecordingError
        If they differ.
    """
    if len(kinds) != 1:
        raise RecordingError(f"{path}: {topic} mixes message types. Split it: dmrl trim --help")
    return kinds.pop()
