"""Conversion of ROS messages to samples: one function per message type."""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dmrl import topics
from dmrl.errors import SourceError
from dmrl.formats.files.pictures import scaling_words
from dmrl.geometry.calibration import BINNING_KEYS, ROI_KEYS, crop_and_bin
from dmrl.geometry.frames import Array, camera_from_horizontal
from dmrl.geometry.rotations import quaternion_to_euler
from dmrl.guards import limits
from dmrl.images import codec
from dmrl.images.bayer import demosaic_decoded
from dmrl.images.pixel_encodings import LAYOUTS, UNNAMED_CHANNELS, convert_to_rgb
from dmrl.messages import LogType, find_descriptor
from dmrl.samples.sample import Sample, build_image, to_timestamp
from dmrl.terminal.left_out import leave_out

HALF_PX = 0.5  # the origin is the first pixel's centre in ROS, its edge in dmrl
MAX_RANGE_M = 60.0
DMRL_PREFIX = "dmrl_msgs/msg/"
DEPTH_ENCODINGS = ("16UC1", "32FC1")
"""Encodings of depth images by REP 118."""
MAX_SIDE_PX = 10_000
FIXED_FRAME = re.compile(r"(?:^|[_/])(?:odom|map|world|earth|origin|enu)(?:_(?:enu|combined))?$")
"""Ends of the names of frames that do not turn with a robot (REP 105), such as ``cf1_odom``."""


@dataclass(frozen=True, slots=True)
class MessageContext:
    """Context of a message: its bag and robots.

    Parameters
    ----------
    source
        The bag, for errors.
    robot, peer
        Robot of the message, and the peer that it ranges to.
    captured
        The message comes from motion capture.
    rectified
        The robot's images are rectified.
    odometry
        The robot has odometry, which replaces other messages.
    bits
        Significant bits of 16-bit pixels.
    changes
        Robots by the change of their images. The converters add to it.
    """

    source: Path
    robot: str
    peer: str = ""
    captured: bool = False
    rectified: bool = False
    odometry: bool = False
    bits: int = codec.BITS
    changes: dict[str, set[str]] = field(default_factory=dict)

    def report_change(self, change: str) -> None:
        """Remember a change of the robot's images."""
        self.changes.setdefault(change, set()).add(self.robot)


def _convert_image(message: Any, time_ns: int, where: MessageContext) -> Iterator[Sample]:
    shape = message.height, message.width
    try:
        if max(shape) > MAX_SIDE_PX:
            raise SourceError(f"images over {MAX_SIDE_PX} px long")
        rgb = convert_to_rgb(
            message.data,
            message.encoding,
            shape,
            message.step,
            big_endian=bool(message.is_bigendian),
            bits=where.bits,
        )
    except SourceError as e:
        leave_out(str(e), where.source)
        return
    if LAYOUTS[message.encoding][1] == 2:
        where.report_change(scaling_words(where.bits))
    if UNNAMED_CHANNELS.fullmatch(message.encoding):
        where.report_change(f"{message.encoding} is read as blue, green, red, as OpenCV has it")
    yield build_image(time_ns, where.robot, codec.encode_png(rgb), "png")


def is_camera_image(message: Any) -> bool:
    """Return whether an image can be decoded, and is no map of depths (REP 118) or of a mask."""
    if hasattr(message, "encoding"):
        return message.encoding in LAYOUTS and message.encoding not in DEPTH_ENCODINGS
    try:
        codec.read_header(message.data.tobytes())
    except SourceError:
        return False
    return not message.format.startswith(tuple(DEPTH_ENCODINGS))


def _convert_compressed_image(
    message: Any, time_ns: int, where: MessageContext
) -> Iterator[Sample]:
    data = message.data.tobytes()
    what = f"{where.source}: an image of {where.robot} at {time_ns} ns"
    try:
        header = codec.read_header(data, what)
        rgb = header.decode(limits.FRAME_PIXELS, bits=where.bits)
    except SourceError as e:
        leave_out(f"{codec.UNDECODABLE}, of format {message.format[:40]!r}", e)
        return
    if header.has_16_bits:
        where.report_change(scaling_words(where.bits))
    coloured = demosaic_decoded(rgb, message.format)
    if header.kind not in ("png", "jpeg") or header.has_16_bits or coloured is not None:
        data, kind = codec.encode_png(rgb if coloured is None else coloured), "png"
    else:
        kind = header.kind
    yield build_image(time_ns, where.robot, data, kind)


def _convert_camera_info(message: Any, time_ns: int, where: MessageContext) -> Iterator[Sample]:
    # ROS 1 and Foxglove write these names in capitals.
    k, p, d, r = (
        np.array(getattr(message, name, getattr(message, name.upper(), [])), float)
        for name in "kpdr"
    )
    if not (k[:1] > 0 and k[4:5] > 0):
        reason = f"calibrations of {where.robot} without a focal length"
        leave_out(reason, f"{where.source} at {time_ns} ns")
        return
    p = p if len(p) else np.insert(k, [3, 6, 9], 0.0)  # Foxglove's may have K alone
    r = r if len(r) else np.eye(3).ravel()
    k[[2, 5]] += HALF_PX
    p[[2, 6]] += HALF_PX
    roi = _read_numbers(getattr(message, "roi", None), ROI_KEYS)
    told = _read_numbers(message, ROI_KEYS[2:]), roi, _read_numbers(message, BINNING_KEYS)
    width, height = crop_and_bin(*told, k.reshape(3, 3), p.reshape(3, 4))
    model = message.distortion_model
    if where.rectified and p[0] > 0:
        k, d, r, model = p.reshape(3, 4)[:, :3].ravel(), np.zeros(0), np.eye(3).ravel(), ""
    fields = {
        "timestamp": to_timestamp(time_ns),
        "frame_id": f"{where.robot}/optical",
        "width": width,
        "height": height,
        "distortion_model": model,
        **{name: value.tolist() for name, value in zip("DKRP", (d, k, r, p), strict=True)},
    }
    yield Sample(time_ns, topics.CALIBRATION(where.robot), "CameraCalibration", fields)


def _read_numbers(message: Any, names: Sequence[str]) -> list[int]:
    return [getattr(message, name, 0) for name in names]


def _to_array(vector: Any) -> Array:
    return np.array([vector.x, vector.y, vector.z])


def _to_euler(q: Any) -> Array | None:
    """Return roll, pitch, yaw; None if the quaternion is not a unit one."""
    values = np.array([q.x, q.y, q.z, q.w], float)
    norm = float(np.linalg.norm(values))
    return quaternion_to_euler(values[None] / norm)[0] if abs(norm - 1) < 0.1 else None


def _find_angles(q: Any, where: MessageContext, time_ns: int) -> Array | None:
    """Return roll, pitch, yaw; None, counted as left out, if the quaternion is not a unit one."""
    angles = _to_euler(q)
    if angles is None:
        reason = f"orientations of {where.robot} that are no unit quaternion"
        leave_out(reason, f"{where.source} at {time_ns} ns")
    return angles


def _is_fixed_frame(frame: str, parent: str = "") -> bool:
    return bool(frame) and (frame == parent or FIXED_FRAME.search(frame) is not None)


def _build_attitude(robot: str, time_ns: int, angles: Array, yaw_rate: float) -> Sample:
    roll, pitch, yaw = angles.tolist()
    fields = {"roll_rad": roll, "pitch_rad": pitch, "yaw_rad": yaw, "yaw_rate_radps": yaw_rate}
    return Sample(time_ns, topics.ATTITUDE(robot), "Attitude", fields)


def _compute_yaw_rate(turning: Array, angles: Array) -> float:
    """Compute the yaw rate from angular rates about the body's axes."""
    roll, pitch, _ = angles.tolist()
    return float((turning[1] * math.sin(roll) + turning[2] * math.cos(roll)) / math.cos(pitch))


def _build_velocity(robot: str, time_ns: int, level: Array) -> Sample:
    fields = dict(zip(("vx_mps", "vy_mps", "vz_mps"), level.tolist(), strict=True))
    return Sample(time_ns, topics.VELOCITY(robot), "Velocity", fields)


def _rotate_from_body(body: Array, angles: Array) -> Array:
    """Rotate a vector from the body's frame to the robot's horizontal one."""
    return camera_from_horizontal(angles[0], angles[1]).T @ body


def _rotate_from_fixed(fixed: Array, angles: Array) -> Array:
    """Rotate a vector from the frame of the yaw to the robot's horizontal one."""
    c, s = math.cos(angles[2]), math.sin(angles[2])
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ fixed


def build_pose(topic: str, time_ns: int, position: Any, orientation: Any) -> Sample:
    """Build a pose in the world frame from a geometry_msgs pose."""
    turn = {name: float(getattr(orientation, name)) for name in "xyzw"}
    place = {name: float(getattr(position, name)) for name in "xyz"}
    fields = {
        "timestamp": to_timestamp(time_ns),
        "frame_id": "world",
        "pose": {"position": place, "orientation": turn},
    }
    return Sample(time_ns, topic, "PoseInFrame", fields)


def _convert_odometry(message: Any, time_ns: int, where: MessageContext) -> Iterator[Sample]:
    held, twist = message.pose.pose, message.twist.twist
    angles = _find_angles(held.orientation, where, time_ns)
    if angles is not None:
        yield build_pose(topics.POSE(where.robot), time_ns, held.position, held.orientation)
    height = {"height_m": float(held.position.z)}
    yield Sample(time_ns, topics.HEIGHT(where.robot), "Height", height)
    if angles is None:
        return
    # The twist is in the child's frame by definition; some drivers name a fixed one there.
    fixed = _is_fixed_frame(message.child_frame_id, message.header.frame_id)
    turning, linear = _to_array(twist.angular), _to_array(twist.linear)
    yaw_rate = float(turning[2]) if fixed else _compute_yaw_rate(turning, angles)
    yield _build_attitude(where.robot, time_ns, angles, yaw_rate)
    level = _rotate_from_fixed(linear, angles) if fixed else _rotate_from_body(linear, angles)
    yield _build_velocity(where.robot, time_ns, level)


def _convert_imu(message: Any, time_ns: int, where: MessageContext) -> Iterator[Sample]:
    if where.odometry:
        return
    for what in ("orientation", "angular_velocity"):
        # By sensor_msgs/Imu, a covariance that begins with -1 marks what was not measured.
        if getattr(message, f"{what}_covariance", [0.0])[0] == -1:
            reason = f"IMU messages of {where.robot} without {what.replace('_', ' ')}"
            leave_out(reason, f"{where.source} at {time_ns} ns")
            return
    angles = _find_angles(message.orientation, where, time_ns)
    if angles is not None:
        yaw_rate = _compute_yaw_rate(_to_array(message.angular_velocity), angles)
        yield _build_attitude(where.robot, time_ns, angles, yaw_rate)


def _convert_twist(message: Any, time_ns: int, where: MessageContext) -> Iterator[Sample]:
    if where.odometry:
        return
    if _is_fixed_frame(message.header.frame_id):
        reason = f"velocities of {where.robot} in a frame that does not turn with the robot"
        leave_out(reason, f"{where.source} at {time_ns} ns")
    else:
        yield _build_velocity(where.robot, time_ns, _to_array(message.twist.linear))


def _convert_pose(message: Any, time_ns: int, where: MessageContext) -> Iterator[Sample]:
    topic = topics.TRUE_POSE(where.robot) if where.captured else topics.POSE(where.robot)
    if _find_angles(message.pose.orientation, where, time_ns) is None:
        return
    yield build_pose(topic, time_ns, message.pose.position, message.pose.orientation)


def _convert_range(message: Any, time_ns: int, where: MessageContext) -> Iterator[Sample]:
    value = float(message.range)
    topic = topics.RANGE(where.robot, where.peer)
    low, high = (getattr(message, name, 0.0) for name in ("min_range", "max_range"))
    if not 0 < value < MAX_RANGE_M:
        reason = f"ranges of {topic} that are not over 0 and under {MAX_RANGE_M:.0f} m"
        leave_out(reason, f"{where.source} at {time_ns} ns")
    elif low < high and not low <= value <= high:
        reason = f"ranges of {topic} outside their own min_range and max_range"
        leave_out(reason, f"{where.source} at {time_ns} ns")
    else:
        yield Sample(time_ns, topic, "UwbRange", {"range_m": value})


def _convert_transforms(message: Any, time_ns: int, _where: MessageContext) -> Iterator[Sample]:
    frames = []
    for entry in message.transforms:
        stamp, held = entry.header.stamp, entry.transform
        time_ns = stamp.sec * 1_000_000_000 + stamp.nanosec or time_ns
        frames.append(
            {
                "timestamp": {"seconds": stamp.sec, "nanos": stamp.nanosec},
                "parent_frame_id": entry.header.frame_id,
                "child_frame_id": entry.child_frame_id,
                "translation": {n: float(getattr(held.translation, n)) for n in "xyz"},
                "rotation": {n: float(getattr(held.rotation, n)) for n in "xyzw"},
            }
        )
    yield Sample(time_ns, topics.TRANSFORMS, "FrameTransforms", {"transforms": frames})


def convert_dmrl_message(message: Any, topic: str, time_ns: int) -> Sample | None:
    """Convert a message of dmrl as it was exported; None for one of another version."""
    name = message.__msgtype__.removeprefix(DMRL_PREFIX)
    if topics.parse_topic(topics.LOG, topic):
        # rosbags keeps the types of fields in their annotations only, so the values define them.
        fields = {k: v for k, v in vars(message).items() if isinstance(v, (int, float))}
        kind = LogType(
            name.removeprefix("Log"),
            tuple((k, "d" if isinstance(v, float) else "q") for k, v in fields.items()),
        )
        return Sample(time_ns, topic, kind, fields)
    try:
        known = {field.name for field in find_descriptor(name).fields}
    except KeyError:
        return None
    return Sample(time_ns, topic, name, {k: v for k, v in _to_plain(message).items() if k in known})


def _to_plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tobytes() if value.dtype == np.uint8 else value.tolist()
    if isinstance(value, list):
        return [_to_plain(item) for item in value]
    if hasattr(value, "__msgtype__"):
        names = (name for name in vars(value) if not name.startswith("__"))
        return {name: _to_plain(getattr(value, name)) for name in names}
    return value


CONVERTERS: dict[str, Callable[[Any, int, MessageContext], Iterator[Sample]]] = {
    "sensor_msgs/msg/Image": _convert_image,
    "sensor_msgs/msg/CompressedImage": _convert_compressed_image,
    "sensor_msgs/msg/CameraInfo": _convert_camera_info,
    "nav_msgs/msg/Odometry": _convert_odometry,
    "sensor_msgs/msg/Imu": _convert_imu,
    "geometry_msgs/msg/TwistStamped": _convert_twist,
    "geometry_msgs/msg/PoseStamped": _convert_pose,
    "sensor_msgs/msg/Range": _convert_range,
    "tf2_msgs/msg/TFMessage": _convert_transforms,
}
