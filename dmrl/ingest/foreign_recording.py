"""Recordings of other programs in MCAP, and of dmrl under other names.

Foxglove's images, calibrations and poses, in protobuf or JSON, are converted like the ROS messages
that they were made from, and so are ROS messages beside them. Topics of dmrl with its own messages
are copied, with new names of robots. All others are left out, with a line that names them.
"""

import base64
import re
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping
from functools import cache
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as F
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass

from dmrl import topics
from dmrl.errors import RecordingError, SourceError
from dmrl.formats.base import SOURCE_OPTIONS, Content, Format, Options
from dmrl.formats.files.text_cells import parse_time_ns
from dmrl.formats.ros import bag
from dmrl.formats.ros.reader import BagMessage, build_decoder
from dmrl.formats.ros.ros_messages import is_camera_image
from dmrl.formats.ros.topic_plan import TopicPlan, plan_topics
from dmrl.guards.bounded_parsing import parse_json
from dmrl.messages import LOG_PACKAGE, LogType
from dmrl.recording import Channel, RawMessage, Summary, read_raw, read_splits, read_summary
from dmrl.recording.protobuf.message_types import find_channel_descriptor
from dmrl.recording.writer import RECIPE_NAME
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import leave_out

ROS_TYPES = {
    "foxglove.CompressedImage": "sensor_msgs/msg/CompressedImage",
    "foxglove.RawImage": "sensor_msgs/msg/Image",
    "foxglove.CameraCalibration": "sensor_msgs/msg/CameraInfo",
    "foxglove.PoseInFrame": "geometry_msgs/msg/PoseStamped",
}
"""ROS messages with the fields of Foxglove's."""
ROS_ENCODINGS = ("cdr", "ros1")
OWN_PACKAGES = ("dmrl.v1.", "dmrl.log.")
FIELDS_WITH_ROBOTS = ("peer", "frame_id", "parent_frame_id", "child_frame_id")
STAMP_FIELDS = {"seconds": "sec", "sec": "sec", "nanos": "nanosec", "nsec": "nanosec"}
"""Fields of a time by those of a time in protobuf or JSON."""
STANDARD_BASE64 = str.maketrans("-_", "+/")
"""Characters of base64 for URLs, which JSON may hold too, by those of the standard."""
WHOLE_NUMBER = re.compile(r"-?\d{1,19}")
LOG_CODES = {F.TYPE_UINT32: "I", F.TYPE_SINT32: "i", F.TYPE_SINT64: "q"}
LOG_CODES |= {F.TYPE_FLOAT: "f", F.TYPE_DOUBLE: "d"}
"""Letters of `LogType` by type of field."""


def can_read(source: Path) -> bool:
    """Return whether a source is an MCAP file, and not a bag of ROS messages alone."""
    if not (source.is_file() and source.suffix == ".mcap"):
        return False
    if not bag.can_read(source):
        return True
    try:
        return any(channel.encoding != "cdr" for channel in _list_channels(source))
    except RecordingError:
        return False  # the reader of bags says what is wrong


def _list_channels(source: Path) -> list[Channel]:
    return list(read_summary(source).definitions.channels.values())


def load_content(source: Path, options: Options, *, skip: Collection[str] = ()) -> Content:
    """Load the samples of a recording.

    Parameters
    ----------
    source
        The recording.
    options
        ``names`` renames robots, names the robot of a topic, or gives a topic of dmrl's for one;
        ``robot`` is that of topics that name none.
    skip
        Topics that are read otherwise.

    Raises
    ------
    SourceError
        If no topic can be converted, or the recording is dmrl's own, without foreign topics, and
        nothing is renamed.
    SettingError
        If a name fits no topic.
    """
    summary = read_summary(source)
    kinds = {channel.topic: _to_kind(channel) for channel in _list_channels(source)}
    own = {old: new for old, new in _iter_own(summary, options) if old not in skip}
    held = []
    for topic, info in summary.topics.items():
        held += [(topic, kinds[topic], info.count)] if topic not in {*own, *skip} else []

    def is_camera(topic: str, _kind: str) -> bool:
        found = [_decode(raw, source) for raw in islice(read_topics(source, [topic]), 1)]
        return found[0] is not None and is_camera_image(found[0])

    plan, why = plan_topics(held, options, is_camera)
    if summary.provenance is not None and not (plan or options.names or skip):
        raise SourceError(f"{source} is a recording already. Pass --to: csv, parquet, ros2")
    for topic, kind, count in held:
        if (topic, kind) in why:
            leave_out(f"messages on {topic}: {why[topic, kind]}", source, count)
    lines = {line.topic: line for line in plan.values()}
    if not (lines or own or skip):
        raise SourceError(f"{source} has no topic of a known type. See docs/sources.md")
    foreign = [one for one in summary.attachments if one.name != RECIPE_NAME]
    leave_out("attachments", source, len(foreign))
    count = sum(summary.topics[topic].count for topic in (*own, *lines))
    splits = read_splits(source, summary)
    return Content(_iter_samples(source, own, lines, options), count, splits)


def _iter_own(summary: Summary, options: Options) -> Iterator[tuple[str, str]]:
    """Yield the topics that hold dmrl's own messages, and their new names.

    In a recording of dmrl's, Foxglove's messages count as its own: their calibrations count pixels
    from the edge of the first one.
    """
    for topic, info in summary.topics.items():
        parts = topic.split("/")
        wanted = options.names.get(topic, "/".join(options.names.get(p, p) for p in parts))
        row = topics.find_topic(wanted)
        is_own = summary.provenance is not None or info.schema.startswith(OWN_PACKAGES)
        if is_own and row is not None and row.accepts_message(info.schema):
            yield topic, wanted


def _iter_samples(
    source: Path, own: Mapping[str, str], lines: Mapping[str, TopicPlan], options: Options
) -> Iterator[Sample]:
    by_kind = {(line.topic, line.kind): line for line in lines.values()}

    def messages(topics: Collection[str]) -> Generator[BagMessage | Sample]:
        for raw in read_topics(source, topics):
            if raw.topic in own and (message := parse(raw, source)) is not None:
                fields = _to_fields(message, options.names)
                yield Sample(raw.time_ns, own[raw.topic], _to_type(message), fields, raw.publish_ns)
            elif raw.topic in lines and (held := _decode(raw, source)) is not None:
                kind = lines[raw.topic].kind
                yield BagMessage(raw.topic, kind, raw.time_ns, held, raw.publish_ns)
            elif topics is not lines:  # those are read again
                leave_out(f"messages on {raw.topic} that cannot be decoded", source)

    return bag.iter_samples(source, messages([*own, *lines]), messages(lines), by_kind, options)


def read_topics(source: Path, wanted: Iterable[str]) -> Iterator[RawMessage]:
    """Yield the messages of some topics in log-time order, whatever types they carry."""
    names = set(wanted)  # not by name: topics of dmrl's may carry other messages here
    return (raw for raw in (read_raw(source) if names else ()) if raw.topic in names)


def parse(raw: RawMessage, source: Path) -> Any:
    """Return a protobuf or ROS message or the value of a JSON one; None if it cannot be decoded."""
    try:
        if raw.channel.encoding == "json":
            return parse_json(raw.data)
        if raw.channel.encoding in ROS_ENCODINGS:
            return _build_decoder(raw.channel)(raw.data, _to_kind(raw.channel))
        return GetMessageClass(find_channel_descriptor(source, raw.channel)).FromString(raw.data)
    except (ValueError, DecodeError, RecordingError):  # a schema may lack the message
        return None


@cache
def _build_decoder(channel: Channel) -> Callable[[bytes, str], Any]:
    form = {"ros2msg": "MSG", "ros1msg": "MSG", "ros2idl": "IDL"}.get(channel.schema_encoding, "")
    text = channel.schema_data.decode(errors="replace")
    return build_decoder([(_to_kind(channel), form, text)], is_ros1=channel.encoding == "ros1")


def _to_kind(channel: Channel) -> str:
    """Return the ROS type with the content of a channel's messages, or its type and encoding."""
    name = channel.schema_name
    if channel.encoding in ROS_ENCODINGS:
        return name if name.count("/") != 1 else name.replace("/", "/msg/")
    return ROS_TYPES.get(name, f"{name or 'data'} in {channel.encoding}")


def _decode(raw: RawMessage, source: Path) -> Any:
    """Return a message of Foxglove's as an object with the fields of ROS's; None: it is none."""
    message = parse(raw, source)
    if isinstance(message, dict) and isinstance(message.get("data"), str):
        text = "".join(message["data"].split()).translate(STANDARD_BASE64)
        try:
            message["data"] = base64.b64decode(text + "=" * (-len(text) % 4), validate=True)
        except ValueError:
            return None
    is_ros = raw.channel.encoding in ROS_ENCODINGS
    return message if is_ros or message is None else _to_object(message)


def _to_object(value: Any) -> Any:
    if isinstance(value, bytes):
        return np.frombuffer(value, np.uint8)
    if hasattr(value, "DESCRIPTOR"):
        value = {field.name: getattr(value, field.name) for field in value.DESCRIPTOR.fields}
    if isinstance(value, dict):
        held = {str(name): _to_object(part) for name, part in value.items()}
        if "timestamp" in held:
            held = {"header": _to_header(held["timestamp"])} | held
        return SimpleNamespace(**{"is_bigendian": False} | held)
    return value


def _to_header(stamp: Any) -> Any:
    """Return a ROS header with the time of a message: protobuf's, or in one of JSON's forms."""
    told: dict[str, int] = {}
    if isinstance(stamp, SimpleNamespace):
        held = {STAMP_FIELDS[n]: v for n, v in vars(stamp).items() if n in STAMP_FIELDS}
        told = {n: int(v) for n, v in held.items() if WHOLE_NUMBER.fullmatch(str(v))}
    else:  # protobuf's JSON has dates, and whole numbers of 64 bits as text
        told["sec"], told["nanosec"] = divmod(parse_time_ns(str(stamp), 1e9, False) or 0, 10**9)
    return SimpleNamespace(stamp=SimpleNamespace(**{"sec": 0, "nanosec": 0} | told))


def _to_type(message: Any) -> str | LogType:
    """Return the type of a message of dmrl's for `Sample`."""
    kind = message.DESCRIPTOR
    if not kind.full_name.startswith(f"{LOG_PACKAGE}."):
        return str(kind.full_name)
    return LogType(kind.name, tuple((f.json_name, LOG_CODES[f.type]) for f in kind.fields))


def _to_fields(value: Any, names: Mapping[str, str]) -> Any:
    """Return a protobuf message as fields of a sample, with new names of robots."""
    found = {}
    for field, held in value.ListFields():
        if field.message_type is not None:
            parts = [_to_fields(one, names) for one in (held if field.is_repeated else [held])]
            held = parts if field.is_repeated else parts[0]
        elif field.name in FIELDS_WITH_ROBOTS:
            held = "/".join(names.get(part, part) for part in held.split("/"))
        found[field.name] = list(held) if field.is_repeated else held
    return found


FORMAT = Format(
    "mcap", "an MCAP file of another program", can_read, load_content, SOURCE_OPTIONS | {"bits"}
)
