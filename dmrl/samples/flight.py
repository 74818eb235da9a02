"""Samples of a flight: measurements of robots and of their peers, and the true positions.

Times are (N,) int64 nanoseconds, values (N,) arrays.
"""

import heapq
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.errors import SourceError
from dmrl.geometry.frames import Array, camera_from_horizontal, yaw_matrix
from dmrl.samples.sample import Columns, Sample, to_timestamp

Times = NDArray[np.int64]

LOG_COLUMNS = ("roll_rad", "pitch_rad", "yaw_rate_radps", "vx_mps", "vy_mps", "height_m")
"""Columns of a robot's log, as ``build_robot_log`` needs them."""

LATEST_TIME_S = 9.2e9
"""Beyond it whole nanoseconds do not fit into 64 bits; seconds, the year 2261."""
START_NS = 1_000_000_000
"""Log time of a simulated start: clocks that run late must not show a time before zero."""


def integrate_yaw(time_ns: Times, rate: Array) -> Array:
    """Integrate (N,) yaw rates from 0 at the first time, interpolated over gaps."""
    turning = np.isfinite(rate)
    if turning.any():
        rate = np.interp(time_ns, time_ns[turning], rate[turning])
    turned = np.diff(time_ns) * 1e-9 * (rate[1:] + rate[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(turned)])


def build_robot_log(robot: str, time_ns: Times, columns: Mapping[str, Array]) -> list[Columns]:
    """Build attitude, velocity and height of one robot.

    A sensor whose values are not all finite has no sample at that time.

    Parameters
    ----------
    robot
        Its name.
    time_ns
        (N,) in order.
    columns
        (N,) for each of ``LOG_COLUMNS``; and ``yaw_rad``, else see `integrate_yaw`.
    """
    log = dict(columns)
    if "yaw_rad" not in log:
        log["yaw_rad"] = integrate_yaw(time_ns, log["yaw_rate_radps"])
    return [
        build_sensor(topic(robot), message, time_ns, {name: log[name] for name in names})
        for topic, message, names in (
            (topics.ATTITUDE, "Attitude", ("roll_rad", "pitch_rad", "yaw_rad", "yaw_rate_radps")),
            (topics.VELOCITY, "Velocity", ("vx_mps", "vy_mps")),
            (topics.HEIGHT, "Height", ("height_m",)),
        )
    ]


def iter_ranges(robot: str, peer: str, time_ns: Times, range_m: Array) -> Columns:
    """Return UWB distances that a robot measured to a peer."""
    return Columns(topics.RANGE(robot, peer), "UwbRange", time_ns, {"range_m": range_m})


def build_sensor(topic: str, message: str, time_ns: Times, columns: Mapping[str, Array]) -> Columns:
    """Build the messages of a sensor where all of its (N,) columns, named as fields, are finite."""
    known = np.isfinite(np.stack(list(columns.values()))).all(axis=0)
    if known.all():  # without copies, which a long flight would hold
        return Columns(topic, message, time_ns, columns)
    fields = {name: column[known] for name, column in columns.items()}
    return Columns(topic, message, time_ns[known], fields)


def build_truth(robot: str, peer: str, time_ns: Times, xyz_m: Array) -> Columns:
    """Build exact positions of a peer, (N, 3) in the robot's horizontal frame, metres."""
    fields = {
        "frame_id": f"{robot}/horizontal",
        **dict(zip("xyz", xyz_m.T, strict=True)),
        "covariance": [0.0] * 9,
    }
    return Columns(topics.TRUTH(robot, peer), "PeerPosition", time_ns, fields)


@dataclass(frozen=True, slots=True)
class RobotPose:
    """Pose of a robot in the world frame, z up.

    Parameters
    ----------
    xyz_world
        (3,) centre, metres.
    yaw_rad, roll_rad, pitch_rad
        Attitude Rz(yaw) Ry(pitch) Rx(roll).
    """

    xyz_world: Array
    yaw_rad: float
    roll_rad: float
    pitch_rad: float

    @property
    def body_from_world(self) -> Array:
        """(3, 3) rotation to the body. The camera looks along the body's x, from its centre."""
        tilt = camera_from_horizontal(self.roll_rad, self.pitch_rad)
        return np.asarray(tilt @ yaw_matrix(self.yaw_rad))


def build_transforms(time_ns: int, robots: Mapping[str, RobotPose]) -> Sample:
    """Build the horizontal, camera and optical frames of robots, as foxglove.FrameTransforms.

    The camera is assumed at the robot's centre, with its axis along the robot's x.
    """
    frames = [
        {"timestamp": to_timestamp(time_ns), **frame}
        for robot, placed in robots.items()
        for frame in _iter_frames(robot, placed)
    ]
    return Sample(time_ns, topics.TRANSFORMS, "FrameTransforms", {"transforms": frames})


# The rotation camera_from_optical: the transpose of geometry.OPTICAL_FROM_CAMERA.
CAMERA_FROM_OPTICAL = {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5}


def _iter_frames(robot: str, placed: RobotPose) -> Iterator[dict[str, Any]]:
    cy, sy = np.cos(placed.yaw_rad / 2), np.sin(placed.yaw_rad / 2)
    cp, sp = np.cos(placed.pitch_rad / 2), np.sin(placed.pitch_rad / 2)
    cr, sr = np.cos(placed.roll_rad / 2), np.sin(placed.roll_rad / 2)
    place = dict(zip("xyz", placed.xyz_world.tolist(), strict=True))
    turn = {"x": 0.0, "y": 0.0, "z": sy, "w": cy}
    tilt = {"x": cp * sr, "y": sp * cr, "z": -sp * sr, "w": cp * cr}
    for parent, child, translation, rotation in (
        ("world", f"{robot}/horizontal", place, turn),
        (f"{robot}/horizontal", f"{robot}/camera", {}, tilt),
        (f"{robot}/camera", f"{robot}/optical", {}, CAMERA_FROM_OPTICAL),
    ):
        names = {"parent_frame_id": parent, "child_frame_id": child}
        yield {**names, "translation": translation, "rotation": rotation}


def merge_by_time(streams: Iterable[Iterable[Sample]]) -> Iterator[Sample]:
    """Merge several streams, each in time order, into one in time order."""
    return heapq.merge(*streams, key=lambda sample: sample.time_ns)


def to_nanoseconds(time_s: Array, place: str | Path = "the source") -> Times:
    """Convert (N,) seconds to whole nanoseconds.

    Parameters
    ----------
    time_s
        (N,) seconds.
    place
        Where they are from, for the error.

    Raises
    ------
    SourceError
        If one is not a number, or too large for nanoseconds; it names the first.
    """
    wrong = ~(np.abs(time_s) < LATEST_TIME_S)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise SourceError(f"{place}: time {time_s[row]:g} s in row {row}. Leave out such rows")
    return np.rint(time_s * 1e9).astype(np.int64)


def log_from_poses(time_s: Array, xy_m: Array, yaw_rad: Array) -> dict[str, Array]:
    """Return the log of a robot that moved like this on level ground, by central differences.

    Parameters
    ----------
    time_s
        (N,) in order.
    xy_m
        (N, 2) world frame.
    yaw_rad
        (N,) relative to world x; may be wrapped.
    """
    yaw = np.unwrap(yaw_rad)
    vx, vy = np.gradient(xy_m, time_s, axis=0).T
    c, s = np.cos(yaw), np.sin(yaw)
    level = np.zeros(len(time_s))
    return {
        "roll_rad": level,
        "pitch_rad": level,
        "yaw_rate_radps": np.asarray(np.gradient(yaw, time_s)),
        "vx_mps": c * vx + s * vy,
        "vy_mps": c * vy - s * vx,
        "height_m": level,
    }
