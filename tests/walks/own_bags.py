"""Bags of simulated robots with odometry, ranges and motion capture, as a ROS driver writes them.

Messages are made by rosbags, independently of dmrl's readers and writers.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from dmrl.flight.flight_arrays import Flight, RobotLog

Array = NDArray[np.float64]
Message = tuple[str, str, int, Any]
"""Topic, type, time in nanoseconds, message."""
BORN_S = 1_772_000_000
"""Time since 1970 at the start of a flight."""
EVERY = 2
"""Every second simulated sample becomes an odometry message."""


def make_rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Return the (3, 3) matrix world from body: Rz(yaw) Ry(pitch) Rx(roll), radians."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    c, s = np.cos(yaw), np.sin(yaw)
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return np.asarray(about_z @ about_y @ about_x)


@dataclass(frozen=True)
class Bag:
    """A flight as ROS messages.

    Parameters
    ----------
    flight
        The simulated flight. Headers have the clocks of its robots.
    version
        Version of ROS, 1 or 2.
    moving_frame
        Frame of the twists: ``body``, as REP 105 requires, or ``world``, the frame of the pose.
        ``child_frame_id`` names it.
    late_s
        Delay between the stamp of a message and its receipt, seconds.
    """

    flight: Flight
    version: int = 2
    moving_frame: str = "body"
    late_s: float = 0.03
    born_s: dict[str, float] = field(default_factory=dict)

    @property
    def store(self) -> Any:
        """Return the message types of the version of ROS."""
        return get_typestore(Stores.ROS1_NOETIC if self.version == 1 else Stores.ROS2_HUMBLE)

    def make_header(self, time_s: float, frame: str, robot: str = "") -> Any:
        """Return a header with a time of a robot's clock."""
        types = self.store.types
        time_ns = self.to_ns(time_s, robot)
        clock = types["builtin_interfaces/msg/Time"]
        stamp = clock(sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        more = {"seq": 0} if self.version == 1 else {}
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **more)

    def to_ns(self, time_s: float, robot: str = "") -> int:
        """Return a time of a robot's clock in nanoseconds, counted from its own start if given."""
        return round((self.born_s.get(robot, BORN_S) + time_s) * 1e9)

    def write(self, path: Path, storage: str = "sqlite3") -> Path:
        """Write a ROS 1 file or a rosbag2 folder."""
        version: dict[str, Any] = {"version": 9, "storage_plugin": StoragePlugin[storage.upper()]}
        store = self.store
        ready = store.serialize_ros1 if self.version == 1 else store.serialize_cdr
        with Writer1(path) if self.version == 1 else Writer2(path, **version) as writer:
            known: dict[str, Any] = {}
            for topic, kind, time_ns, message in sorted(self.iter_messages(), key=lambda m: m[2]):
                if topic not in known:
                    known[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(known[topic], time_ns, ready(message, kind))
        return path

    def iter_messages(self) -> Iterator[Message]:
        """Yield all messages of the flight, robot by robot."""
        late_ns = round(self.late_s * 1e9)
        for robot, log in self.flight.robots.items():
            true_s = self.flight.clocks[robot].to_true_time(log.time_s)
            for k, odometry in self.iter_odometry(robot, log):
                arrived = self.to_ns(true_s[k]) + late_ns
                yield f"/{robot}/odom", "nav_msgs/msg/Odometry", arrived, odometry
            yield from self.iter_captured(robot)
        ranged = self.store.types["sensor_msgs/msg/Range"]
        for (robot, peer), measured in self.flight.ranges.items():
            true_s = self.flight.clocks[robot].to_true_time(measured.time_s)
            for here_s, true, value in zip(measured.time_s, true_s, measured.range_m, strict=True):
                head = self.make_header(here_s, f"{robot}_uwb", robot)
                message = ranged(head, 0, 0.0, 0.1, 50.0, float(value))
                arrived = self.to_ns(true) + late_ns
                yield f"/{robot}/uwb/{peer}", "sensor_msgs/msg/Range", arrived, message

    def iter_odometry(self, robot: str, log: RobotLog) -> Iterator[tuple[int, Any]]:
        """Yield number and message of dead reckoning from the position of take-off."""
        types = self.store.types
        step_s = np.gradient(log.time_s)
        yaw = np.cumsum(log.yaw_rate_radps * step_s)
        c, s = np.cos(yaw), np.sin(yaw)
        x = np.cumsum((c * log.vx_mps - s * log.vy_mps) * step_s)
        y = np.cumsum((s * log.vx_mps + c * log.vy_mps) * step_s)
        vz = np.zeros_like(x)
        for k in range(0, len(x), EVERY):
            roll, pitch = log.roll_rad[k], log.pitch_rad[k]
            body = make_rotation(roll, pitch, yaw[k])
            level = make_rotation(0.0, 0.0, yaw[k])
            world = level @ np.array([log.vx_mps[k], log.vy_mps[k], vz[k]])
            twist = world if self.moving_frame == "world" else body.T @ world
            rate = log.yaw_rate_radps[k] * np.cos(pitch) / np.cos(roll)
            pose = types["geometry_msgs/msg/Pose"](
                self.make_point(x[k], y[k], log.height_m[k]),
                self.make_quaternion(roll, pitch, yaw[k]),
            )
            moving = types["geometry_msgs/msg/Twist"](
                self.make_vector(*twist), self.make_vector(0.0, 0.0, rate)
            )
            child = "odom" if self.moving_frame == "world" else f"{robot}/base_link"
            yield (
                k,
                types["nav_msgs/msg/Odometry"](
                    self.make_header(log.time_s[k], "odom", robot),
                    child,
                    types["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
                    types["geometry_msgs/msg/TwistWithCovariance"](moving, np.zeros(36)),
                ),
            )

    def iter_captured(self, robot: str) -> Iterator[Message]:
        """Yield the true poses of motion capture, whose clock is exact."""
        types = self.store.types
        truth = self.flight.truth[robot]
        for k in range(0, len(truth.time_s), EVERY):
            pose = types["geometry_msgs/msg/Pose"](
                self.make_point(*truth.position[k]),
                self.make_quaternion(truth.roll[k], truth.pitch[k], truth.yaw[k]),
            )
            head = self.make_header(truth.time_s[k], "map")
            message = types["geometry_msgs/msg/PoseStamped"](head, pose)
            topic = f"/vrpn_client_node/{robot}/pose"
            yield topic, "geometry_msgs/msg/PoseStamped", self.to_ns(truth.time_s[k]), message

    def make_point(self, *xyz: float) -> Any:
        """Return a Point, metres."""
        return self.store.types["geometry_msgs/msg/Point"](*(float(value) for value in xyz))

    def make_vector(self, *xyz: float) -> Any:
        """Return a Vector3."""
        return self.store.types["geometry_msgs/msg/Vector3"](*(float(value) for value in xyz))

    def make_quaternion(self, roll: float, pitch: float, yaw: float) -> Any:
        """Return the Quaternion of Euler angles, radians."""
        halves = np.array([roll, pitch, yaw]) / 2
        (cr, cp, cy), (sr, sp, sy) = np.cos(halves), np.sin(halves)
        values = (
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        )
        return self.store.types["geometry_msgs/msg/Quaternion"](*(float(v) for v in values))
