"""ROS 2 messages with a few chosen values, and bags of them written by rosbags."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES: Mapping[str, Any] = STORE.types
START_NS = 1_700_000_000_000_000_000
LATE_NS = 1_000_000


class Sent(NamedTuple):
    """A message: topic, time of its header, nanoseconds, and its content or its bytes."""

    topic: str
    time_ns: int
    message: Any
    kind: str = ""


def make_header(time_ns: int, frame: str = "map") -> Any:
    """Return a header with this stamp."""
    stamp = TYPES["builtin_interfaces/msg/Time"](time_ns // 10**9, time_ns % 10**9)
    return TYPES["std_msgs/msg/Header"](stamp, frame)


def make_odometry(
    time_ns: int, z: float = 1.0, turn: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
) -> Any:
    """Return an Odometry at (1, 2, z), metres, with a quaternion x, y, z, w."""
    pose = TYPES["geometry_msgs/msg/Pose"](
        TYPES["geometry_msgs/msg/Point"](1.0, 2.0, z),
        TYPES["geometry_msgs/msg/Quaternion"](*turn),
    )
    vectors = (TYPES["geometry_msgs/msg/Vector3"](0.5, 0.0, 0.0) for _ in range(2))
    twist = TYPES["geometry_msgs/msg/Twist"](*vectors)
    return TYPES["nav_msgs/msg/Odometry"](
        make_header(time_ns),
        "base_link",
        TYPES["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
        TYPES["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)),
    )


def make_pose(time_ns: int, x: float = 1.0) -> Any:
    """Return a PoseStamped at (x, 2, 1), metres."""
    held = make_odometry(time_ns).pose.pose
    held.position.x = x
    return TYPES["geometry_msgs/msg/PoseStamped"](make_header(time_ns), held)


def make_range(time_ns: int, range_m: float = 1.5) -> Any:
    """Return a Range."""
    return TYPES["sensor_msgs/msg/Range"](make_header(time_ns), 1, 0.1, 0.0, 4.0, range_m)


def make_image(time_ns: int, encoding: str = "rgb8", value: int = 0) -> Any:
    """Return an Image of 32 x 24 pixels whose bytes all have one value."""
    width = {"rgb8": 3, "16UC1": 2, "32FC1": 4, "mono8": 1}.get(encoding, 3)
    data = np.full(24 * 32 * width, value, np.uint8)
    return TYPES["sensor_msgs/msg/Image"](
        make_header(time_ns), 24, 32, encoding, 0, 32 * width, data
    )


def make_compressed_image(time_ns: int, kind: str, data: bytes) -> Any:
    """Return a CompressedImage."""
    held = np.frombuffer(data, np.uint8)
    return TYPES["sensor_msgs/msg/CompressedImage"](make_header(time_ns), kind, held)


def make_camera_info(time_ns: int, f: float) -> Any:
    """Return a CameraInfo of 32 x 24 pixels with a focal length in pixels."""
    k = np.array([f, 0, 15.5, 0, f, 11.5, 0, 0, 1.0])
    roi = TYPES["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    p = np.insert(k, [3, 6, 9], 0.0)
    return TYPES["sensor_msgs/msg/CameraInfo"](
        make_header(time_ns), 24, 32, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, roi
    )


def write_bag(path: Path, sent: Iterable[Sent], storage: str = "mcap") -> Path:
    """Write a rosbag2 folder; each message is received 1 ms after the time of its header."""
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    connections: dict[tuple[str, str], Any] = {}
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        for one in sorted(sent, key=lambda s: s.time_ns):
            kind = one.kind or one.message.__msgtype__
            if (one.topic, kind) not in connections:
                held = writer.add_connection(one.topic, kind, typestore=STORE)
                connections[one.topic, kind] = held
            raw = isinstance(one.message, bytes)
            data = one.message if raw else STORE.serialize_cdr(one.message, kind)
            writer.write(connections[one.topic, kind], one.time_ns + LATE_NS, bytes(data))
    return path


def make_times(count: int = 5, start_ns: int = START_NS) -> list[int]:
    """Return times at 10 Hz, nanoseconds."""
    return [start_ns + k * 10**8 for k in range(count)]
