"""Export of a recording as a rosbag2 folder, messages in CDR, types in the bag.

Images, calibrations, poses and transforms become messages of the standard ROS 2 packages. All
others become ``dmrl_msgs/msg/<Name>`` with the fields of dmrl's own; these types are generated
from protobuf. ``dmrl convert`` reads all of them back. Bag times are log times.
"""

from collections.abc import Callable
from keyword import iskeyword
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.descriptor import Descriptor, FieldDescriptor

from dmrl.atomic_output import atomic_folder
from dmrl.errors import MissingExtra, RecordingError
from dmrl.formats.ros.ros_messages import DMRL_PREFIX, HALF_PX
from dmrl.recording import Stamped, read, read_summary
from dmrl.terminal.progress import track

F = FieldDescriptor
ROS_SCALARS = {
    F.TYPE_DOUBLE: "float64",
    F.TYPE_FLOAT: "float32",
    F.TYPE_UINT32: "uint32",
    F.TYPE_SINT32: "int32",
    F.TYPE_INT32: "int32",
    F.TYPE_SINT64: "int64",
    F.TYPE_INT64: "int64",
    F.TYPE_UINT64: "uint64",
    F.TYPE_FIXED32: "uint32",
    F.TYPE_FIXED64: "uint64",
    F.TYPE_SFIXED32: "int32",
    F.TYPE_SFIXED64: "int64",
    F.TYPE_ENUM: "int32",
    F.TYPE_BOOL: "bool",
    F.TYPE_STRING: "string",
    F.TYPE_BYTES: "uint8[]",
}
NUMPY_CODES = {"float64": "f8", "float32": "f4", "uint32": "u4", "int32": "i4", "int64": "i8"}
NUMPY_CODES |= {"uint64": "u8", "bool": "?"}


def write_bag(recording: Path, out: Path) -> dict[str, int]:
    """Write the bag to the folder ``out``; return messages per topic.

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
        If the recording cannot be read, or a type has no equivalent in ROS 2.
    OutputError
        If ``out`` exists or cannot be written.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: PLC0415
    except ModuleNotFoundError as e:
        raise MissingExtra("rosbags", "ros", "convert --to ros2") from e
    found = read_summary(recording)
    types = _RosTypes(recording)
    counts = dict.fromkeys(found.topics, 0)
    connections: dict[str, Any] = {}  # by topic; a bag defines a topic's type once, before its data
    with atomic_folder(out) as folder:
        writer = Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
        with writer:
            for sample in track(read(recording), "Writing a bag", found.count):
                kind, message = types.convert_sample(sample)
                topic = sample.topic
                if topic not in connections:
                    opened = writer.add_connection(topic, kind, typestore=types.store)
                    connections[topic] = opened
                if connections[topic].msgtype != kind:
                    mixed = f"{recording}: {topic} mixes message types"
                    raise RecordingError(f"{mixed}, which a bag cannot hold. Pass --to csv")
                data = types.store.serialize_cdr(message, kind)
                writer.write(connections[topic], sample.time_ns, data)
                counts[topic] += 1
        for path in (folder / "bag").iterdir():
            path.rename(folder / path.name)
        (folder / "bag").rmdir()
    return counts


class _UnsupportedType(ValueError):
    """A type without an equivalent in ROS 2."""


class _RosTypes:
    """ROS 2 types of a recording's messages, generated where no standard one exists."""

    def __init__(self, recording: Path) -> None:
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

        self._recording = recording
        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self._names: dict[Descriptor, str] = {}
        self._fields: dict[Descriptor, dict[str, FieldDescriptor]] = {}

    def convert_sample(self, sample: Stamped) -> tuple[str, Any]:
        """Return the type name and message of a sample."""
        kind = sample.message.DESCRIPTOR
        standard = STANDARD_TYPES.get(kind.full_name)
        if standard is not None:
            name, make = standard
            return name, make(self.store.types, sample.message, sample.time_ns)
        try:
            return self._register_type(kind), self._convert_message(sample.message)
        except _UnsupportedType as e:
            raise RecordingError(
                f"{self._recording}: {sample.topic}: {e}, which ROS 2 does not support. Remove it: "
                "dmrl trim"
            ) from None

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
        self._fields[kind] = {names[field.name]: field for field in kind.fields}
        return name

    def _to_field_type(self, field: FieldDescriptor) -> str:
        if field.message_type is not None:
            inner = field.message_type
            if inner.GetOptions().map_entry or self._names.get(inner) == "":
                raise _UnsupportedType(f"{field.full_name} is a map, or its type contains itself")
            own = self._register_type(field.message_type).replace("/msg/", "/")
        else:
            own = ROS_SCALARS[field.type]
        if field.is_repeated and field.type == F.TYPE_BYTES:
            raise _UnsupportedType(f"{field.full_name} is a list of bytes")
        return f"{own}[]" if field.is_repeated else own

    def _convert_message(self, message: Any) -> Any:
        kind = message.DESCRIPTOR
        make = self.store.types[self._register_type(kind)]
        values = {
            name: self._convert_value(field, getattr(message, field.name))
            for name, field in self._fields[kind].items()
        }
        # ROS 2 requires a hidden field in a message without fields.
        return make(**values) if values else make(structure_needs_at_least_one_member=0)

    def _convert_value(self, field: FieldDescriptor, value: Any) -> Any:
        if field.is_repeated:
            if field.type == F.TYPE_MESSAGE:
                return [self._convert_message(item) for item in value]
            code = NUMPY_CODES.get(ROS_SCALARS[field.type])
            return np.array(list(value), code) if code else list(value)
        if field.type == F.TYPE_MESSAGE:
            return self._convert_message(value)
        return np.frombuffer(value, np.uint8) if field.type == F.TYPE_BYTES else value


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


def _build_header(types: Any, time_ns: int, frame: str) -> Any:
    seconds, nanos = divmod(time_ns, 1_000_000_000)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanos)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def _frame_time_ns(message: Any) -> int:
    return int(message.timestamp.seconds * 1_000_000_000 + message.timestamp.nanos)


def _build_vector(types: Any, name: str, value: Any) -> Any:
    return types[f"geometry_msgs/msg/{name}"](x=value.x, y=value.y, z=value.z)


def _build_quaternion(types: Any, q: Any) -> Any:
    return types["geometry_msgs/msg/Quaternion"](x=q.x, y=q.y, z=q.z, w=q.w)


def _convert_compressed_image(types: Any, message: Any, time_ns: int) -> Any:
    return types["sensor_msgs/msg/CompressedImage"](
        header=_build_header(types, time_ns, message.frame_id),
        format=message.format,
        data=np.frombuffer(message.data, np.uint8),
    )


def _convert_camera_info(types: Any, message: Any, time_ns: int) -> Any:
    sizes = (len(message.K), len(message.R), len(message.P))
    if sizes != (9, 9, 12):
        raise RecordingError(
            f"a camera calibration at {time_ns} ns has {sizes} numbers in K, R and P, not 9, 9 and "
            "12. Remove its topic: dmrl trim"
        )
    k, p = np.array(message.K), np.array(message.P)
    k[[2, 5]] -= HALF_PX
    p[[2, 6]] -= HALF_PX
    roi = types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return types["sensor_msgs/msg/CameraInfo"](
        header=_build_header(types, time_ns, message.frame_id),
        height=message.height,
        width=message.width,
        distortion_model=message.distortion_model,
        d=np.array(message.D, float),
        k=k,
        r=np.array(message.R, float),
        p=p,
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


def _convert_pose(types: Any, message: Any, time_ns: int) -> Any:
    pose = types["geometry_msgs/msg/Pose"](
        position=_build_vector(types, "Point", message.pose.position),
        orientation=_build_quaternion(types, message.pose.orientation),
    )
    header = _build_header(types, time_ns, message.frame_id)
    return types["geometry_msgs/msg/PoseStamped"](header=header, pose=pose)


def _convert_transforms(types: Any, message: Any, time_ns: int) -> Any:
    frames = [
        types["geometry_msgs/msg/TransformStamped"](
            header=_build_header(types, _frame_time_ns(frame) or time_ns, frame.parent_frame_id),
            child_frame_id=frame.child_frame_id,
            transform=types["geometry_msgs/msg/Transform"](
                translation=_build_vector(types, "Vector3", frame.translation),
                rotation=_build_quaternion(types, frame.rotation),
            ),
        )
        for frame in message.transforms
    ]
    return types["tf2_msgs/msg/TFMessage"](transforms=frames)


STANDARD_TYPES: dict[str, tuple[str, Callable[[Any, Any, int], Any]]] = {
    "foxglove.CompressedImage": ("sensor_msgs/msg/CompressedImage", _convert_compressed_image),
    "foxglove.CameraCalibration": ("sensor_msgs/msg/CameraInfo", _convert_camera_info),
    "foxglove.PoseInFrame": ("geometry_msgs/msg/PoseStamped", _convert_pose),
    "foxglove.FrameTransforms": ("tf2_msgs/msg/TFMessage", _convert_transforms),
}
