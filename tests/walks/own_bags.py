"""Bags of own robots: odometry, ranges and motion capture, as a ROS driver writes them.

Nothing of dmrl's readers or writers is in here: messages are made by rosbags alone.
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
"""True time zero, since 1970."""
EVERY = 2
"""Of the simulated samples, each second one is odometry."""


def turned(roll: float, pitch: float, yaw: float) -> Array:
    """Body to world, Rz(yaw) Ry(pitch) Rx(roll)."""
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
        What was flown; its robots' clocks are those of the headers.
    version
        Of ROS.
    moving_frame
        ``body``: twists are in the body's frame, as REP 105 and the message say. ``world``: in
        the frame of the pose, and the message says so.
    late_s
        How long after its header a message came to the bag.
    """

    flight: Flight
    version: int = 2
    moving_frame: str = "body"
    late_s: float = 0.03
    born_s: dict[str, float] = field(default_factory=dict)

    @property
    def store(self) -> Any:
        return get_typestore(Stores.ROS1_NOETIC if self.version == 1 else Stores.ROS2_HUMBLE)

    def header(self, time_s: float, frame: str, robot: str = "") -> Any:
        types = self.store.types
        time_ns = self.ns(time_s, robot)
        clock = types["builtin_interfaces/msg/Time"]
        stamp = clock(sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        more = {"seq": 0} if self.version == 1 else {}
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **more)

    def ns(self, time_s: float, robot: str = "") -> int:
        """Of a robot's clock; robots that were given a start of their own count from it."""
        return round((self.born_s.get(robot, BORN_S) + time_s) * 1e9)

    def write(self, path: Path, storage: str = "sqlite3") -> Path:
        """A ROS 1 file, or a rosbag2 folder."""
        version: dict[str, Any] = {"version": 9, "storage_plugin": StoragePlugin[storage.upper()]}
        store = self.store
        ready = store.serialize_ros1 if self.version == 1 else store.serialize_cdr
        with Writer1(path) if self.version == 1 else Writer2(path, **version) as writer:
            known: dict[str, Any] = {}
            for topic, kind, time_ns, message in sorted(self.messages(), key=lambda m: m[2]):
                if topic not in known:
                    known[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(known[topic], time_ns, ready(message, kind))
        return path

    def messages(self) -> Iterator[Message]:
        """All of the flight, robot by robot."""
        late_ns = round(self.late_s * 1e9)
        for robot, log in self.flight.robots.items():
            true_s = self.flight.clocks[robot].to_true_time(log.time_s)
            for k, odometry in self.odometry(robot, log):
                arrived = self.ns(true_s[k]) + late_ns
                yield f"/{robot}/odom", "nav_msgs/msg/Odometry", arrived, odometry
            yield from self.captured(robot)
        ranged = self.store.types["sensor_msgs/msg/Range"]
        for (robot, peer), measured in self.flight.ranges.items():
            true_s = self.flight.clocks[robot].to_true_time(measured.time_s)
            for here_s, true, value in zip(measured.time_s, true_s, measured.range_m, strict=True):
                head = self.header(here_s, f"{robot}_uwb", robot)
                message = ranged(head, 0, 0.0, 0.1, 50.0, float(value))
                arrived = self.ns(true) + late_ns
                yield f"/{robot}/uwb/{peer}", "sensor_msgs/msg/Range", arrived, message

    def odometry(self, robot: str, log: RobotLog) -> Iterator[tuple[int, Any]]:
        """Dead reckoning from where the robot took off, with its twist."""
        types = self.store.types
        step_s = np.gradient(log.time_s)
        yaw = np.cumsum(log.yaw_rate_radps * step_s)
        c, s = np.cos(yaw), np.sin(yaw)
        x = np.cumsum((c * log.vx_mps - s * log.vy_mps) * step_s)
        y = np.cumsum((s * log.vx_mps + c * log.vy_mps) * step_s)
        vz = np.zeros_like(x)
        for k in range(0, len(x), EVERY):
            roll, pitch = log.roll_rad[k], log.pitch_rad[k]
            body = turned(roll, pitch, yaw[k])
            level = turned(0.0, 0.0, yaw[k])
            world = level @ np.array([log.vx_mps[k], log.vy_mps[k], vz[k]])
            twist = world if self.moving_frame == "world" else body.T @ world
            rate = log.yaw_rate_radps[k] * np.cos(pitch) / np.cos(roll)
            pose = types["geometry_msgs/msg/Pose"](
                self.point(x[k], y[k], log.height_m[k]), self.quaternion(roll, pitch, yaw[k])
            )
            moving = types["geometry_msgs/msg/Twist"](
                self.vector(*twist), self.vector(0.0, 0.0, rate)
            )
            child = "odom" if self.moving_frame == "world" else f"{robot}/base_link"
            yield (
                k,
                types["nav_msgs/msg/Odometry"](
                    self.header(log.time_s[k], "odom", robot),
                    child,
                    types["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
                    types["geometry_msgs/msg/TwistWithCovariance"](moving, np.zeros(36)),
                ),
            )

    def captured(self, robot: str) -> Iterator[Message]:
        """Poses of motion capture, on its own clock, which is the true one."""
        types = self.store.types
        truth = self.flight.truth[robot]
        for k in range(0, len(truth.time_s), EVERY):
            pose = types["geometry_msgs/msg/Pose"](
                self.point(*truth.position[k]),
                self.quaternion(truth.roll[k], truth.pitch[k], truth.yaw[k]),
            )
            head = self.header(truth.time_s[k], "map")
            message = types["geometry_msgs/msg/PoseStamped"](head, pose)
            topic = f"/vrpn_client_node/{robot}/pose"
            yield topic, "geometry_msgs/msg/PoseStamped", self.ns(truth.time_s[k]), message

    def point(self, *xyz: float) -> Any:
        return self.store.types["geometry_msgs/msg/Point"](*(float(value) for value in xyz))

    def vector(self, *xyz: float) -> Any:
        return self.store.types["geometry_msgs/msg/Vector3"](*(float(value) for value in xyz))

    def quaternion(self, roll: float, pitch: float, yaw: float) -> Any:
        halves = np.array([roll, pitch, yaw]) / 2
        (cr, cp, cy), (sr, sp, sy) = np.cos(halves), np.sin(halves)
        values = (
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        )
        return self.store.types["geometry_msgs/msg/Quaternion"](*(float(v) for v in values))
