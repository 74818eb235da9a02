"""Find the message type of a channel, and check that topics carry their type.

A recording contains its own schemas. For the types of dmrl, the built-in schemas are used.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

from google.protobuf.descriptor import Descriptor
from google.protobuf.message import DecodeError

from dmrl.errors import RecordingError
from dmrl.messages import build_pool, find_descriptor
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.file import corrupt_error
from dmrl.recording.mcap.summary_index import TopicInfo
from dmrl.topics import find_topic


def require_types(path: Path, topics: Mapping[str, TopicInfo], chosen: Iterable[str]) -> None:
    """Raise RecordingError unless dmrl's topics carry the message types of `dmrl.topics`.

    Raises
    ------
    RecordingError
        If a topic carries another type.
    """
    for topic in sorted(chosen):
        row = find_topic(topic)
        if row is not None and not row.accepts_message(topics[topic].schema):
            raise RecordingError(
                f"{path}: {topic} carries {topics[topic].schema or 'no schema'}, not "
                f"{row.message}. Convert the recording: dmrl convert --help"
            )


def find_channel_descriptor(path: Path, channel: Channel) -> Descriptor:
    """Return the message type of a channel: dmrl's own if it has that name, else the recording's.

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
        return find_descriptor(channel.schema_name)
    except KeyError:
        pass
    try:
        return build_pool(channel.schema_data).FindMessageTypeByName(channel.schema_name)
    except (DecodeError, TypeError, KeyError) as e:
        raise corrupt_error(path, f"schema {channel.schema_name}: {e}") from e


def require_one_type(path: Path, topic: str, kinds: set[Descriptor]) -> Descriptor:
    """Return the common message type of a topic's channels. After a merge there can be several.

    Raises
    ------
    RecordingError
        If the types differ.
    """
    if len(kinds) != 1:
        raise RecordingError(f"{path}: {topic} mixes message types. Split it: dmrl trim --help")
    return kinds.pop()
