"""Find the message type of a channel, and check that topics carry their type.

A recording contains its own schemas. For the types of dmrl, the built-in schemas are used if they
have all fields of the recording's.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

from google.protobuf.descriptor import Descriptor
from google.protobuf.message import DecodeError

from dmrl.errors import UnreadableTopic
from dmrl.messages import PACKAGES, find_descriptor, serialize_schema
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.protobuf.definitions import build_type
from dmrl.recording.summary import TopicInfo
from dmrl.topics import find_topic


def require_types(path: Path, topics: Mapping[str, TopicInfo], chosen: Iterable[str]) -> None:
    """Raise UnreadableTopic unless dmrl's topics carry the message types of `dmrl.topics`.

    Raises
    ------
    UnreadableTopic
        If a topic carries another type.
    """
    for topic, why in iter_wrong_types(topics, chosen):
        raise UnreadableTopic(path, topic, why)


def iter_wrong_types(
    topics: Mapping[str, TopicInfo], chosen: Iterable[str]
) -> Iterator[tuple[str, str]]:
    """Yield dmrl's topics with another message type than that of `dmrl.topics`, and which."""
    for topic in sorted(chosen):
        row, schema = find_topic(topic), topics[topic].schema
        if row is not None and not row.accepts_message(schema):
            yield topic, f"carries {schema or 'no schema'}, not {row.message}"


def carries_own_type(topic: str, schema: str) -> bool:
    """Return whether a topic is one of dmrl's and has the right message type."""
    row = find_topic(topic)
    return row is not None and row.accepts_message(schema)


def find_channel_descriptor(path: Path, channel: Channel) -> Descriptor:
    """Return the message type of a channel.

    Raises
    ------
    UnreadableTopic
        If the channel is not protobuf, its schema defines no such message, or a topic of dmrl
        carries a message with the name of dmrl's and other fields.
    """
    if channel.encoding != "protobuf" or channel.schema_encoding != "protobuf":
        raise UnreadableTopic(
            path, channel.topic, f"is {channel.encoding or 'without encoding'}, not protobuf"
        )
    name = channel.schema_name
    try:
        kind = _find_type(name, channel.schema_data)
    except (DecodeError, TypeError, KeyError) as e:
        why = " ".join(str(e).split())
        reason = f"has a schema {name} that cannot be used: {why}"
        raise UnreadableTopic(path, channel.topic, reason) from e
    row = find_topic(channel.topic)
    if row is not None and name == row.message:
        own = find_descriptor(name)
        if kind is not own and not _has_fields(kind, own):
            raise UnreadableTopic(
                path, channel.topic, f"carries another {name}, without all fields of dmrl's"
            )
    return kind


@lru_cache(maxsize=256)
def _find_type(name: str, schema_data: bytes) -> Descriptor:
    """Return dmrl's own type if it has that name and the recording's fields, else the latter's.

    Raises
    ------
    DecodeError, KeyError, TypeError
        If the schema defines no such message.
    """
    own = None
    if name.startswith(tuple(f"{package}." for package in PACKAGES)):
        with suppress(KeyError):
            own = find_descriptor(name)
    if own is not None and (not schema_data or schema_data == serialize_schema(name)):
        return own
    recorded = build_type(name, schema_data)
    return own if own is not None and _has_fields(own, recorded) else recorded


def _has_fields(kind: Descriptor, other: Descriptor, within: tuple[str, ...] = ()) -> bool:
    """Return whether a type has all fields of another, with their names, numbers and types."""
    for theirs in other.fields:
        mine = kind.fields_by_number.get(theirs.number)
        if mine is None or (mine.name, mine.type, mine.is_repeated) != (
            *(theirs.name, theirs.type, theirs.is_repeated),
        ):
            return False
        inner, wanted = mine.message_type, theirs.message_type
        if inner is None or wanted is None or wanted.full_name in within:
            continue
        if not _has_fields(inner, wanted, (*within, wanted.full_name)):
            return False
    return True
