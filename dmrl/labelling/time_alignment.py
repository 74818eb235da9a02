"""Clocks from a recording: by ranges, a camera's by its robot's turns, by motion capture.

Several signals may tell how two clocks differ, and each flight has others that say much. All
are tried, and the surest counts.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.estimation.signals.clock_alignment import Clock, estimate_clock
from dmrl.estimation.signals.image_motion import rates, shift, small
from dmrl.estimation.signals.ranging_clocks import estimate_from_exchanges
from dmrl.geometry.frames import Array
from dmrl.geometry.rotations import euler_zyx
from dmrl.images import codec
from dmrl.recording import Contents, read
from dmrl.terminal.progress import track

Signals = dict[str, tuple[Array, Array]]
"""By name: times (N,), seconds since the recording's start, increasing, and values (N,)."""

MOCAP_STEP_S = 0.02
"""Differences of poses that are nearer to each other than this are noise."""


def range_clocks(held: Contents) -> dict[tuple[str, str], Clock]:
    """By pair: how to correct the times of the second to those of the first.

    Parameters
    ----------
    held
        With ranges of robots to each other, both ways.
    """
    links = ranging(held)
    pairs = {}
    for one, other in combinations(sorted({name for link in links for name in link}), 2):
        if (one, other) in links and (other, one) in links:
            here, there = (
                _increasing(*_columns(held, topics.uwb_range(*link), "range_m"))
                for link in ((one, other), (other, one))
            )
            clock = estimate_from_exchanges(*here, *there)
            if clock is not None:
                pairs[one, other] = replace(clock, by="ranges")
    return pairs


def ranging(held: Contents) -> set[tuple[str, str]]:
    """Who ranges to whom."""
    return {(n["robot"], n["peer"]) for t in held.topics if (n := topics.names(topics.RANGE, t))}


def camera_clock(held: Contents, robot: str, even_ns: Mapping[int, int]) -> Clock | None:
    """How to correct the times of a robot's camera to those of its attitude.

    Parameters
    ----------
    held
        With images and attitude of the robot.
    robot
        Its name.
    even_ns
        Times of images that count in place of those in the recording.

    Returns
    -------
    Clock | None
        None where images and attitude show no common turn.

    Raises
    ------
    SourceError
        If an image cannot be decoded.
    """
    topic = topics.camera_image(robot)
    if topics.attitude(robot) not in held.topics:
        return None
    times, moved, before = [], [], None
    count = held.topics[topic].count
    for stamped in track(read(held.path, topic), f"Turns of {robot}'s camera", count):
        at = f"{topic} at {stamped.time_ns} ns in {held.path}"
        after = small(codec.decode(stamped.message.data, at))
        if before is not None:
            moved.append(shift(before, after) or (np.nan, np.nan))
        times.append(even_ns.get(stamped.time_ns, stamped.time_ns))
        before = after
    if len(times) < 2:
        return None
    # A shift between two images is the mean rate between them, so it belongs to the middle.
    middle, speed = rates(_seconds(np.array(times), held), np.array(moved))
    # A camera that turns left sees the scene move right; nose down, up.
    seen = {"yaw rate": (middle, speed[:, 0]), "pitch rate": (middle, -speed[:, 1])}
    return _surest(_turns(held, robot), seen)


def mocap_clocks(held: Contents) -> dict[str, Clock | None]:
    """How to correct the times of robots to those of motion capture.

    Parameters
    ----------
    held
        With poses of robots on ``/tf`` (frames ``<robot>`` or ``<robot>/horizontal``) or
        ``/<robot>/pose/truth``, and their attitude, velocity or height.

    Returns
    -------
    dict
        By robot that motion capture has poses of; None where the two do not agree.
    """
    return {
        robot: _surest(_of_pose(*poses), _own(held, robot))
        for robot, poses in sorted(_poses(held).items())
    }


def _surest(reference: Signals, other: Signals) -> Clock | None:
    found = []
    for name in sorted(reference.keys() & other.keys()):
        clock = estimate_clock(*reference[name], *other[name])
        if clock is not None:
            found.append(replace(clock, by=name))
    return min(found, key=lambda clock: clock.sigma_s, default=None)


def _seconds(time_ns: NDArray[np.int64], held: Contents) -> Array:
    return np.asarray((time_ns - held.start_ns) * 1e-9)


def _increasing(time_s: Array, values: Array) -> tuple[Array, Array]:
    # Interpolation and gradients need times that increase: of equal times the first counts.
    good = np.isfinite(values) & np.concatenate([[True], np.diff(time_s) > 0])[: len(values)]
    return time_s[good], values[good]


def _columns(held: Contents, topic: str, *names: str) -> list[Array]:
    """Times and fields of a topic."""
    table = held.table(topic, list(names))
    values = [np.asarray(table[name].to_numpy(), float) for name in names]
    return [_seconds(table["log_time"].to_numpy(), held), *values]


def _turns(held: Contents, robot: str) -> Signals:
    names = ("pitch_rad", "yaw_rate_radps")
    time_s, pitch, yaw_rate = _columns(held, topics.attitude(robot), *names)
    slow_s, pitch = _increasing(time_s, pitch)
    signals = {"yaw rate": _increasing(time_s, yaw_rate)}
    if len(slow_s) > 1:
        # The camera sees the nose go down and up; logs have the yaw rate, not the pitch rate.
        signals["pitch rate"] = slow_s, np.gradient(pitch, slow_s)
    return signals


def _own(held: Contents, robot: str) -> Signals:
    """What a robot measured of itself that motion capture sees as well."""
    signals = {}
    if topics.attitude(robot) in held.topics:
        names = ("roll_rad", "pitch_rad", "yaw_rate_radps")
        time_s, *values = _columns(held, topics.attitude(robot), *names)
        for name, column in zip(("roll", "pitch", "yaw rate"), values, strict=True):
            signals[name] = _increasing(time_s, column)
    if topics.velocity(robot) in held.topics:
        time_s, vx, vy = _columns(held, topics.velocity(robot), "vx_mps", "vy_mps")
        # The length alone: it is the same in every frame, however the robot is turned.
        signals["speed"] = _increasing(time_s, np.hypot(vx, vy))
    if topics.height(robot) in held.topics:
        time_s, height = _columns(held, topics.height(robot), "height_m")
        signals["height"] = _increasing(time_s, height)
    return signals


def _of_pose(time_s: Array, rows: Array) -> Signals:
    """The same from poses (N, 7): x, y, z, and a quaternion x, y, z, w."""
    # A rate is a difference over a time; over a short one it is noise of the poses.
    keep = [0]
    for k, moment in enumerate(time_s.tolist()):
        if moment - time_s[keep[-1]] >= MOCAP_STEP_S:
            keep.append(k)
    time_s, rows = time_s[keep], rows[keep]
    if len(keep) < 2:
        return {}
    roll, pitch, yaw = euler_zyx(rows[:, 3:]).T
    yaw = np.unwrap(yaw)  # it jumps by a whole turn where it passes half of one; its rate must not
    middle, step = (time_s[1:] + time_s[:-1]) / 2, np.diff(time_s)
    return {
        "roll": (time_s, roll),
        "pitch": (time_s, pitch),
        "yaw rate": (middle, np.diff(yaw) / step),
        "speed": (middle, np.hypot(*np.diff(rows[:, :2], axis=0).T) / step),
        "height": (time_s, rows[:, 2]),
    }


def _poses(held: Contents) -> dict[str, tuple[Array, Array]]:
    """Of each robot that motion capture sees: times, and (N, 7) poses."""
    true = {n["robot"]: t for t in held.topics if (n := topics.names(topics.TRUE_POSE, t))}
    rows = {robot: _true_poses(held, topic) for robot, topic in true.items()}
    # A topic of true poses counts before a frame, which may be another estimate.
    rows |= {robot: by for robot, by in _frames(held).items() if robot not in true}
    found = {}
    for robot, by_time in rows.items():
        if not by_time:
            continue
        values = np.array(list(by_time.values()))
        good = np.isfinite(values).all(axis=1)
        if good.any():
            found[robot] = _seconds(np.array(list(by_time)), held)[good], values[good]
    return found


def _true_poses(held: Contents, topic: str) -> dict[int, list[float]]:
    """Rows of a topic of poses, by log time; of equal times the last counts."""
    poses = ((stamped.time_ns, stamped.message.pose) for stamped in held.messages(topic))
    return {time_ns: _row(pose.position, pose.orientation) for time_ns, pose in poses}


def _frames(held: Contents) -> dict[str, dict[int, list[float]]]:
    """The same of every robot on ``/tf``, whichever of its own frames is there."""
    rows: dict[str, dict[int, list[float]]] = {}
    if topics.TRANSFORMS not in held.topics:
        return rows
    for stamped in held.messages(topics.TRANSFORMS):
        for frame in stamped.message.transforms:
            robot, _, part = frame.child_frame_id.partition("/")
            if part in ("", "horizontal"):
                row = _row(frame.translation, frame.rotation)
                rows.setdefault(robot, {})[stamped.time_ns] = row
    return rows


def _row(place: object, turn: object) -> list[float]:
    """x, y, z, and the quaternion x, y, z, w."""
    names = [(place, n) for n in "xyz"] + [(turn, n) for n in "xyzw"]
    return [float(getattr(part, name)) for part, name in names]
