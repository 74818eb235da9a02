"""Messages of a simulated flight: sensors, truth, and labels of images."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import permutations
from typing import Any

import numpy as np

from dmrl.flight import Clock, Flight, Truth
from dmrl.geometry.frames import Array
from dmrl.rendering.shot import Shot
from dmrl.rendering.sketch_renderer import Sketch
from dmrl.samples import flight as samples
from dmrl.samples.flight import START_NS, RobotPose, Times, to_nanoseconds
from dmrl.samples.sample import Sample, iter_slices

TRUTH_RATE_HZ = 20.0
JPEG_QUALITY = 92


def log_times(clock: Clock, true_time_s: Array) -> Times:
    """Return the log times of true times: those of the robot's own clock."""
    return START_NS + to_nanoseconds(clock.to_clock_time(true_time_s))


def iter_sensor_streams(
    flight: Flight, yaw_rad: Mapping[str, Array] | None = None
) -> Iterator[Iterable[Sample]]:
    """Yield the messages of every robot's own sensors, and of the ranges of every pair.

    Parameters
    ----------
    flight
        Logs and ranges of a flight, or of a part of it.
    yaw_rad
        (N,) heading by robot. None: integrated from 0 at the first sample.
    """
    for robot, log in flight.robots.items():
        columns = {name: getattr(log, name) for name in samples.LOG_COLUMNS}
        if yaw_rad is not None:
            columns["yaw_rad"] = yaw_rad[robot]
        yield from samples.build_robot_log(robot, START_NS + to_nanoseconds(log.time_s), columns)
    for (robot, peer), ranges in flight.ranges.items():
        time_ns = START_NS + to_nanoseconds(ranges.time_s)
        yield samples.iter_ranges(robot, peer, time_ns, ranges.range_m)


def iter_truth_streams(flight: Flight, time_s: Array) -> Iterator[Iterable[Sample]]:
    """Yield the true positions of every pair, and the frames of all robots, at (N,) true times."""
    for robot, peer in permutations(flight.truth, 2):
        yield iter_peer_truth(flight, robot, peer, time_s)
    yield (build_flight_transforms(flight, float(moment)) for moment in time_s)


def iter_peer_truth(flight: Flight, robot: str, peer: str, true_time_s: Array) -> Iterator[Sample]:
    """Yield the true position of a peer at (N,) true times, on the observer's clock."""
    for part in iter_slices(len(true_time_s)):
        time_s = true_time_s[part]
        xyz = flight.peer_in_horizontal(robot, peer, time_s)
        yield from samples.build_truth(robot, peer, log_times(flight.clocks[robot], time_s), xyz)


def build_flight_transforms(flight: Flight, true_time_s: float) -> Sample:
    """Return every robot's frames, on true time."""
    bodies = {robot: body_at(truth, true_time_s) for robot, truth in flight.truth.items()}
    time_ns = int(log_times(Clock(), np.array([true_time_s]))[0])
    return samples.build_transforms(time_ns, bodies)


def body_at(truth: Truth, true_time_s: float) -> RobotPose:
    """Return the pose of a robot at a true time, seconds."""
    at = np.array([true_time_s])
    return RobotPose(
        truth.position_at(at)[0],
        float(truth.yaw_at(at)[0]),
        float(np.interp(true_time_s, truth.time_s, truth.roll)),
        float(np.interp(true_time_s, truth.time_s, truth.pitch)),
    )


def iter_label_fields(peers: Sequence[str], picture: Sketch | Shot) -> Iterator[dict[str, Any]]:
    """Yield the true label of every peer in front of a camera, whose names are given."""
    for k, peer in enumerate(peers):
        box = picture.box_px[k]
        yield {
            "peer": peer,
            "u_px": picture.uv_px[k, 0],
            "v_px": picture.uv_px[k, 1],
            "depth_m": picture.depth_m[k],
            "box_px": [] if np.isnan(box).any() else box.tolist(),
            "visible_share": float(picture.visible_share[k]),
            "source": "truth",
        }
