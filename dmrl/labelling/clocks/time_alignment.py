"""Estimate clocks from ranges, from a camera's turns, or from motion capture.

Several signals may show how two clocks differ. All are tried, and the most certain one counts.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np

from dmrl import topics
from dmrl.errors import SourceError
from dmrl.estimation.signals.clock_estimation import Clock, estimate_clock
from dmrl.estimation.signals.image_motion import estimate_shift, shift_rates, shrink_image
from dmrl.estimation.signals.ranging_clocks import estimate_from_exchanges
from dmrl.geometry.frames import Array
from dmrl.geometry.rotations import quaternion_to_euler
from dmrl.images import codec
from dmrl.labelling.flight_log import FlightLog, Samples
from dmrl.recording import read
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import track

Signals = dict[str, tuple[Array, Array]]
"""By name: (N,) times, seconds since the recording's start, increasing, and (N,) values."""

MIN_MOCAP_STEP_S = 0.02
"""Shortest time between poses whose difference is used, seconds; shorter ones are noise."""


def estimate_range_clocks(flight: FlightLog) -> dict[tuple[str, str], Clock]:
    """Return by pair how to correct the times of the second to those of the first.

    Parameters
    ----------
    flight
        With ranges of robots to each other, both ways.
    """
    links = flight.ranges
    pairs = {}
    for one, other in combinations(sorted({name for link in links for name in link}), 2):
        if (one, other) in links and (other, one) in links:
            here, there = (
                _keep_increasing(*_columns(flight, links[link]))
                for link in ((one, other), (other, one))
            )
            clock = estimate_from_exchanges(*here, *there)
            if clock is not None:
                pairs[one, other] = replace(clock, by="ranges")
    return pairs


def estimate_camera_clock(
    flight: FlightLog, robot: str, even_ns: Mapping[int, int]
) -> Clock | None:
    """Return how to correct the times of a robot's camera to those of its attitude.

    Parameters
    ----------
    flight
        With images and attitude of the robot.
    robot
        Its name.
    even_ns
        Times of images that replace those in the recording.

    Returns
    -------
    Clock | None
        None if images and attitude have no common turn.

    Raises
    ------
    SourceError
        If an image cannot be decoded and the command is strict.
    """
    topic = topics.CAMERA_IMAGE(robot)
    if robot not in flight.attitude:
        return None
    times, moved, before = [], [], None
    count = flight.topics[topic].count
    for stamped in track(read(flight.path, topic), f"Turns of {robot}'s camera", count):
        at = f"{topic} at {stamped.time_ns} ns in {flight.path}"
        try:
            after = shrink_image(codec.decode(stamped.message.data, at))
        except SourceError as e:
            leave_out(codec.UNDECODABLE, e)
            continue
        if before is not None:
            moved.append(estimate_shift(before, after) or (np.nan, np.nan))
        times.append(even_ns.get(stamped.time_ns, stamped.time_ns))
        before = after
    if len(times) < 2:
        return None
    # A shift between two images is the mean rate between them, so it belongs to the middle.
    middle, speed = shift_rates(flight.to_seconds(np.array(times)), np.array(moved))
    # A camera that turns left makes the scene move right; nose down, up.
    turns = {"yaw rate": (middle, speed[:, 0]), "pitch rate": (middle, -speed[:, 1])}
    return _most_certain(_attitude_turns(flight, robot), turns)


def estimate_mocap_clocks(flight: FlightLog) -> dict[str, Clock | None]:
    """Return how to correct the times of robots to those of motion capture.

    Parameters
    ----------
    flight
        With poses of robots on ``/tf`` (frames ``<robot>`` or ``<robot>/horizontal``) or
        ``/<robot>/pose/truth``, and their attitude, velocity or height.

    Returns
    -------
    dict
        By robot that motion capture has poses of; None if the two do not agree.
    """
    return {
        robot: _most_certain(_pose_signals(*poses), _robot_signals(flight, robot))
        for robot, poses in sorted(_read_poses(flight).items())
    }


def _most_certain(reference: Signals, other: Signals) -> Clock | None:
    """Return the clock with the smallest sigma over all signals that both have."""
    found = []
    for name in sorted(reference.keys() & other.keys()):
        clock = estimate_clock(*reference[name], *other[name])
        if clock is not None:
            found.append(replace(clock, by=name))
    return min(found, key=lambda clock: clock.sigma_s, default=None)


def _keep_increasing(time_s: Array, values: Array) -> tuple[Array, Array]:
    # Interpolation and gradients need times that increase: of equal times the first counts.
    good = np.isfinite(values) & np.concatenate([[True], np.diff(time_s) > 0])[: len(values)]
    return time_s[good], values[good]


def _columns(flight: FlightLog, samples: Samples) -> list[Array]:
    """Return times, seconds, and the columns of a topic."""
    return [flight.to_seconds(samples.time_ns), *samples.values.T]


def _attitude_turns(flight: FlightLog, robot: str) -> Signals:
    time_s, _, pitch, yaw_rate = _columns(flight, flight.attitude[robot])
    slow_s, pitch = _keep_increasing(time_s, pitch)
    signals = {"yaw rate": _keep_increasing(time_s, yaw_rate)}
    if len(slow_s) > 1:
        # Images show the nose go down and up; logs have the yaw rate, not the pitch rate.
        signals["pitch rate"] = slow_s, np.gradient(pitch, slow_s)
    return signals


def _robot_signals(flight: FlightLog, robot: str) -> Signals:
    """Return the signals of a robot's own sensors that motion capture measures as well."""
    signals = {}
    if robot in flight.attitude:
        time_s, *values = _columns(flight, flight.attitude[robot])
        for name, column in zip(("roll", "pitch", "yaw rate"), values, strict=True):
            signals[name] = _keep_increasing(time_s, column)
    if robot in flight.velocity:
        time_s, vx, vy = _columns(flight, flight.velocity[robot])
        # The length alone: it is the same in every frame, however the robot is turned.
        signals["speed"] = _keep_increasing(time_s, np.hypot(vx, vy))
    if robot in flight.height:
        time_s, height = _columns(flight, flight.height[robot])
        signals["height"] = _keep_increasing(time_s, height)
    return signals


def _pose_signals(time_s: Array, rows: Array) -> Signals:
    """Return the same signals from poses (N, 7): x, y, z, and a quaternion x, y, z, w."""
    # A rate is a difference over a time; over a short one it is noise of the poses.
    keep = [0]
    for k, moment in enumerate(time_s.tolist()):
        if moment - time_s[keep[-1]] >= MIN_MOCAP_STEP_S:
            keep.append(k)
    time_s, rows = time_s[keep], rows[keep]
    if len(keep) < 2:
        return {}
    roll, pitch, yaw = quaternion_to_euler(rows[:, 3:]).T
    yaw = np.unwrap(yaw)  # it jumps by a whole turn where it passes half of one; its rate must not
    middle, step = (time_s[1:] + time_s[:-1]) / 2, np.diff(time_s)
    return {
        "roll": (time_s, roll),
        "pitch": (time_s, pitch),
        "yaw rate": (middle, np.diff(yaw) / step),
        "speed": (middle, np.hypot(*np.diff(rows[:, :2], axis=0).T) / step),
        "height": (time_s, rows[:, 2]),
    }


def _read_poses(flight: FlightLog) -> dict[str, tuple[Array, Array]]:
    """Return times and (N, 7) poses of each robot that motion capture has."""
    rows = _transform_poses(flight)
    # A topic of true poses counts before a frame, which may be another estimate.
    for robot, poses in flight.true_poses.items():
        rows[robot] = dict(zip(poses.time_ns.tolist(), poses.values, strict=True))
    found = {}
    for robot, by_time in rows.items():
        if not by_time:
            continue
        values = np.array(list(by_time.values()))
        good = np.isfinite(values).all(axis=1)
        if good.any():
            found[robot] = flight.to_seconds(np.array(list(by_time)))[good], values[good]
    return found


def _transform_poses(flight: FlightLog) -> dict[str, dict[int, Array]]:
    """Return poses by time of every robot on ``/tf``; of equal times the last counts."""
    rows: dict[str, dict[int, Array]] = {}
    for stamped in flight.transforms:
        for frame in stamped.message.transforms:
            robot, _, part = frame.child_frame_id.partition("/")
            if part in ("", "horizontal"):
                place, turn = frame.translation, frame.rotation
                row = [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]
                rows.setdefault(robot, {})[stamped.time_ns] = np.array(row, float)
    return rows
