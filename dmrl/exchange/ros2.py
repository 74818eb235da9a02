"""Export of a recording as a rosbag2 folder, messages in CDR, types in the bag.

Images, calibrations, poses and transforms become messages of the standard ROS 2 packages. All
others become ``dmrl_msgs/msg/<Name>`` with the fields of dmrl's own; these types are generated
from protobuf. ``dmrl convert`` reads all of them back. Bag times are log times.
"""

from collections.abc import Callable, Mapping
from keyword import iskeyword
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message_factory import GetMessageClass

from dmrl.atomic_output import atomic_folder
from dmrl.errors import RecordingError, UnreadableTopic, optional_imports
from dmrl.formats.ros.ros_messages import DMRL_PREFIX, HALF_PX
from dmrl.recording import RawMessage, parse_message, read_raw, read_summary
from dmrl.recording.protobuf.message_types import find_channel_descriptor
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import track

F = FieldDescriptor
ROS_SCALARS = {
    F.TYPE_DOUBLE: "float64",
    F.TYPE_FLOAT: "float32",
    F.TYPE_BOOL: "bool",
    F.TYPE_STRING: "string",
    F.TYPE_BYTES: "uint8[]",
    **dict.fromkeys((F.TYPE_UINT32, F.TYPE_FIXED32), "uint32"),
    **dict.fromkeys((F.TYPE_UINT64, F.TYPE_FIXED64), "uint64"),
    **dict.fromkeys((F.TYPE_INT32, F.TYPE_SINT32, F.TYPE_SFIXED32, F.TYPE_ENUM), "int32"),
    **dict.fromkeys((F.TYPE_INT64, F.TYPE_SINT64, F.TYPE_SFIXED64), "int64"),
}


def write_bag(recording: Path, out: Path) -> dict[str, int]:
    """Write the bag to the folder ``out``; return messages per topic.

    Topics and messages that a bag cannot hold are left out.

    Parameters
    ----------
    recording
        A complete recording.
    out
        Folder to write. Must not exist.

    Raises
    ------
    MissingExtra
        If rosbags is not installed.
    RecordingError
        If the recording cannot be read, or nothing of it fits ROS 2.
    OutputError
        If ``out`` exists or cannot be written.
    """
    with optional_imports("ros", "convert --to ros2"):
        from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: PLC0415
    found = read_summary(recording)
    types = _RosTypes(recording)
    counts = dict.fromkeys(found.topics, 0)
    connections: dict[str, Any] = {}  # by topic; a bag defines a topic's type once, before its data
    with atomic_folder(out) as folder:
        writer = Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
        with writer:
            for raw in track(read_raw(recording), "Writing a bag", found.count):
                topic = raw.topic
                try:
                    kind, message = types.convert(raw)
                    if topic not in connections:
                        opened = writer.add_connection(topic, kind, typestore=types.store)
                        connections[topic] = opened
                    if connections[topic].msgtype != kind:
                        raise _UnfitError("its type is another than that of the first message")
                except _UnfitError as e:
                    leave_out(f"messages on {topic} that ROS 2 cannot hold: {e}", recording)
                    continue
                data = types.store.serialize_cdr(message, kind)
                writer.write(connections[topic], raw.time_ns, data)
                counts[topic] += 1
        if found.count and not connections:
            raise RecordingError(f"{recording} has nothing that ROS 2 can hold. Pass --to csv")
        for path in (folder / "bag").iterdir():
            path.rename(folder / path.name)
        (folder / "bag").rmdir()
    return {t: n for t, n in counts.items() if n or not found.topics[t].count}


class _UnfitError(ValueError):
    """A message, or a type, without an equivalent in ROS 2."""


class _RosTypes:
    """ROS 2 types of a recording's messages, generated where no standard one exists."""

    def __init__(self, recording: Path) -> None:
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

        self._recording = recording
        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self._names: dict[Descriptor, str] = {}
        self._unfit: dict[Descriptor, _UnfitError] = {}
        self._renamed: dict[str, dict[str, str]] = {}
        """Fields of the protobuf messages by those of their ROS types, by type."""

    def convert(self, raw: RawMessage) -> tuple[str, Any]:
        """Return the type name and the message of a message; raise _UnfitError if it has none."""
        try:
            kind = find_channel_descriptor(self._recording, raw.channel)
        except UnreadableTopic as e:
            raise _UnfitError(e.reason) from None
        message = parse_message(raw, GetMessageClass(kind), self._recording)
        if kind.full_name in STANDARD_TYPES:
            name, describe = STANDARD_TYPES[kind.full_name]
            return name, self._build(name, describe(message, raw.time_ns))
        if kind in self._unfit:
            raise self._unfit[kind]
        try:
            name = self._register_type(kind)
        except _UnfitError as e:
            self._names = {known: name for known, name in self._names.items() if name}
            self._unfit[kind] = e
            raise
        return name, self._build(name, message)

    def _register_type(self, kind: Descriptor) -> str:
        """Register a type and its nested types; return its name."""
        from rosbags.typesys import get_types_from_msg  # noqa: PLC0415

        if found := self._names.setdefault(kind, ""):
            return found
        names = {f.name: _to_field_name(f.name) for f in kind.fields}
        if len(set(names.values())) < len(names):  # they differ in case only
            names = {f.name: f"{_to_field_name(f.name)}_{f.number}" for f in kind.fields}
        lines = [f"{self._to_field_type(field)} {names[field.name]}" for field in kind.fields]
        name = base = DMRL_PREFIX + _to_type_name(kind)
        while name in self._names.values():
            name = f"{base}{len(self._names)}"
        self.store.register(get_types_from_msg("\n".join(lines) + "\n", name))
        self._names[kind] = name
        self._renamed[name] = {ros: own for own, ros in names.items()}
        return name

    def _to_field_type(self, field: FieldDescriptor) -> str:
        inner = field.message_type
        if inner is not None:
            if inner.GetOptions().map_entry or self._names.get(inner) == "":
                raise _UnfitError(f"{field.full_name} is a map, or its type contains itself")
            own = self._register_type(inner).replace("/msg/", "/")
        else:
            own = ROS_SCALARS[field.type]
        if field.is_repeated and field.type == F.TYPE_BYTES:
            raise _UnfitError(f"{field.full_name} is a list of bytes")
        return f"{own}[]" if field.is_repeated else own

    def _build(self, name: str, value: Any) -> Any:
        """Build a message from a protobuf message, or from a mapping; other fields are 0."""
        _, fields = self.store.fielddefs[name]
        sources = {field: self._renamed.get(name, {}).get(field, field) for field, _ in fields}
        given = {
            field: value.get(own) if isinstance(value, Mapping) else getattr(value, own, None)
            for field, own in sources.items()
        }
        parts = {field: self._build_field(form, given[field]) for field, form in fields}
        return self.store.types[name](**parts)

    def _build_field(self, form: Any, value: Any) -> Any:
        """Build a field of a form that rosbags gives: a name, a base type, or a list of either."""
        node, detail = form
        if node == NAME_NODE:
            return self._build(detail, {} if value is None else value)
        if node not in LIST_NODES:
            return 0 if value is None else value
        item, kind = detail[0]
        if item == NAME_NODE:
            return [self._build(kind, one) for one in value]
        if isinstance(value, bytes):
            return np.frombuffer(value, np.uint8)
        return list(value) if kind[0] == "string" else np.array(list(value), kind[0])


NAME_NODE, LIST_NODES = 2, (3, 4)
"""Kinds of fields in rosbags: a message; an array and a sequence."""


def _to_field_name(name: str) -> str:
    """Convert a field name to the rules of ROS 2.

    They are lower case, a letter in front, no double and no trailing underscore. Python keywords
    are changed too, since rosbags uses field names as identifiers.
    """
    plain = "_".join(part for part in name.lower().split("_") if part)
    fits = plain[:1].isalpha() and not iskeyword(plain)
    return plain if fits else f"field_{plain}".rstrip("_")


def _to_type_name(kind: Descriptor) -> str:
    words = kind.name.replace("-", "_").split("_")
    name = "".join(word[:1].upper() + word[1:] for word in words)
    name = name if name[:1].isalpha() else f"Type{name}"
    return f"Log{name}" if kind.full_name.startswith("dmrl.log.") else name


def _header(time_ns: int, frame: str) -> dict[str, Any]:
    seconds, nanos = divmod(time_ns, 1_000_000_000)
    return {"header": {"stamp": {"sec": seconds, "nanosec": nanos}, "frame_id": frame}}


def _describe_image(message: Any, time_ns: int) -> dict[str, Any]:
    own = {"format": message.format, "data": message.data}
    return _header(time_ns, message.frame_id) | own


def _describe_camera(message: Any, time_ns: int) -> dict[str, Any]:
    if (sizes := (len(message.K), len(message.R), len(message.P))) != (9, 9, 12):
        raise _UnfitError(f"a calibration with {sizes} numbers in K, R and P, not 9, 9 and 12")
    k, p = np.array(message.K), np.array(message.P)
    k[[2, 5]] -= HALF_PX
    p[[2, 6]] -= HALF_PX
    own = {name: getattr(message, name) for name in ("height", "width", "distortion_model")}
    own |= {"d": message.D, "k": k, "r": message.R, "p": p}
    return _header(time_ns, message.frame_id) | own


def _describe_pose(message: Any, time_ns: int) -> dict[str, Any]:
    return _header(time_ns, message.frame_id) | {"pose": message.pose}


def _describe_transforms(message: Any, time_ns: int) -> dict[str, Any]:
    frames = []
    for frame in message.transforms:
        stamp_ns = frame.timestamp.seconds * 1_000_000_000 + frame.timestamp.nanos
        own = {"child_frame_id": frame.child_frame_id, "transform": frame}
        frames.append(_header(stamp_ns or time_ns, frame.parent_frame_id) | own)
    return {"transforms": frames}


STANDARD_TYPES: dict[str, tuple[str, Callable[[Any, int], dict[str, Any]]]] = {
    "foxglove.CompressedImage": ("sensor_msgs/msg/CompressedImage", _describe_image),
    "foxglove.CameraCalibration": ("sensor_msgs/msg/CameraInfo", _describe_camera),
    "foxglove.PoseInFrame": ("geometry_msgs/msg/PoseStamped", _describe_pose),
    "foxglove.FrameTransforms": ("tf2_msgs/msg/TFMessage", _describe_transforms),
}
