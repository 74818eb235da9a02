"""ROS bags: rosbag2 (folders, ``.db3``, ``.mcap``) and ROS 1 (``.bag``). The only user of rosbags.

These message types are converted. All others are left out, with a line that names them:

* ``sensor_msgs/Image``, ``CompressedImage`` and ``CameraInfo``;
* ``nav_msgs/Odometry``: attitude, velocity (in the body's frame), height, pose;
* ``sensor_msgs/Imu`` and ``geometry_msgs/TwistStamped``, for a robot without odometry;
* ``geometry_msgs/PoseStamped``: a true pose if the topic names motion capture, else a pose;
* ``sensor_msgs/Range`` on a topic that names two robots, ``/<robot>/uwb/<peer>``: UWB;
* ``dmrl_msgs/*``, as ``dmrl convert --to ros2`` writes them, on the topics of dmrl.

Times are those of the headers. If they are empty, the time at which the bag received a message
replaces it, and a line reports this. That time is the publish time of every message.
"""

import re
from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from dmrl.errors import SourceError
from dmrl.formats.base import SOURCE_OPTIONS, Content, Format, Options
from dmrl.formats.ros.message_clock import MessageClock
from dmrl.formats.ros.reader import (
    METADATA_FILE,
    BagMessage,
    find_unnamed_files,
    iter_messages,
    list_topics,
)
from dmrl.formats.ros.ros_messages import (
    CONVERTERS,
    DMRL_PREFIX,
    MessageContext,
    convert_dmrl_message,
    is_camera_image,
)
from dmrl.formats.ros.topic_plan import IMU, ODOMETRY, POSE, TWIST, TopicPlan, plan_topics
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import say

FOREIGN_OUTPUTS = ("Attitude", "Velocity", "Height", "UwbRange", "PoseInFrame", "CameraCalibration")
"""Messages of sensors, whose numbers must be finite."""
MOTIONS = (ODOMETRY, POSE, TWIST, IMU)
Z_DOWN_FRAME = re.compile(r"(^|[_/])(ned|frd)$", re.IGNORECASE)
"""Frames whose z is down, by REP 103."""
Z_DOWN_HINT = "its z is down (--columns takes fields, with sign = -1)"
SUFFIXES = (".db3", ".bag", ".mcap")


def can_read(source: Path) -> bool:
    """Return whether a source is a ROS 1 bag, a rosbag2 folder, or the storage of one."""
    if source.is_dir():
        return (source / METADATA_FILE).is_file() or any(source.glob("*.db3"))
    if source.suffix not in SUFFIXES:
        return False
    with source.open("rb") as stream:
        head = stream.read(64)
    if source.suffix == ".mcap":
        return b"ros2" in head
    return head.startswith((b"SQLite format 3", b"#ROSBAG V2"))


def load_content(source: Path, options: Options, *, skip: Collection[str] = ()) -> Content:
    """Load the samples of a bag, in the bag's order.

    Parameters
    ----------
    source
        The bag.
    options
        ``names`` renames robots; others keep the names in their topics. ``robot`` is the robot of
        topics that name none.
    skip
        Topics that are read otherwise.

    Raises
    ------
    SourceError
        If the bag cannot be read, or has no supported topic.
    MissingExtra
        If rosbags is not installed.
    """
    held = [one for one in list_topics(source) if one[0] not in skip]
    if unnamed := find_unnamed_files(source):
        leave_out(f"files that {METADATA_FILE} does not name", unnamed[0], len(unnamed))

    def is_camera(topic: str, kind: str) -> bool:
        first = next(iter_messages(source, [(topic, kind)], ahead=True), None)
        return first is not None and is_camera_image(first.decoded)

    lines, why = plan_topics(held, options, is_camera)
    if not (lines or skip):
        known = ", ".join(sorted({*CONVERTERS}))
        raise SourceError(f"{source} has no topic of a known type: {known}. Pass another bag")
    for topic, kind, count in held:
        if (topic, kind) in why:
            leave_out(f"messages on {topic}: {why[topic, kind]}", source, count)
    samples = iter_samples(
        source,
        iter_messages(source, lines),
        iter_messages(source, lines, ahead=True),
        lines,
        options,
    )
    return Content(samples, sum(line.count for line in lines.values()))


def iter_samples(
    source: Path,
    messages: Iterable[BagMessage | Sample],
    ahead: Generator[BagMessage | Sample],
    lines: Mapping[tuple[str, str], TopicPlan],
    options: Options,
) -> Iterator[Sample]:
    """Yield the samples of messages of ROS, or of messages with the fields of ROS's.

    Parameters
    ----------
    source
        The file, for reports.
    messages
        The messages, in the file's order. Samples among them are yielded unchanged.
    ahead
        The messages once more, of which the first tell the clock.
    lines
        Conversion by topic and type.
    options
        ``bits``.
    """
    calibrated: dict[str, Mapping[str, Any]] = {}
    unstamped: Counter[str] = Counter()
    changes: dict[str, set[str]] = {}
    moving = {line.robot for line in lines.values() if line.kind == ODOMETRY}
    with closing(ahead):
        first = (m for m in ahead if isinstance(m, BagMessage))
        stamps = ((m.topic, header_time_ns(m.decoded), m.bag_ns) for m in first)
        clock = MessageClock.from_stamps(source, stamps)
    for message in messages:
        if isinstance(message, Sample):
            yield message
            continue
        line, bag_ns = lines[message.topic, message.kind], message.bag_ns
        odometry = line.robot in moving
        where = MessageContext(
            *(source, line.robot, line.peer, line.captured, line.rectified),
            *(odometry, options.bits, changes),
        )
        # Without a time in the header, the bag's own time is the best estimate.
        stamp_ns = header_time_ns(message.decoded)
        unstamped[line.topic] += clock.is_unset(line.topic, stamp_ns) and bag_ns > 0
        if (time_ns := clock.find_time_ns(line.topic, stamp_ns, bag_ns)) is None:
            continue
        samples = convert_message(line, message.decoded, time_ns, where)
        received_ns = bag_ns if message.publish_ns is None else message.publish_ns
        for sample in select_usable(samples, f"{source}: {line.topic}", calibrated):
            yield replace(sample, publish_ns=max(received_ns, 0))
    for change, robots in changes.items():
        say(f"{source}: images of {', '.join(sorted(robots))}: {change}")
    _report_unstamped(source, unstamped)


def _report_unstamped(source: Path, unstamped: Mapping[str, int]) -> None:
    """Report topics whose stamps are 0."""
    if zeros := [f"{count} on {topic}" for topic, count in unstamped.items() if count]:
        say(f"{source}: messages with a stamp of 0 get the bag's times: {', '.join(zeros)}")


def header_time_ns(message: Any) -> int | None:
    """Return the time in the header; 0: it is empty, None: there is no header."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    try:
        return max(int(stamp.sec * 1_000_000_000 + stamp.nanosec), 0)  # type: ignore[union-attr]
    except (AttributeError, TypeError, ValueError, OverflowError):
        return None  # no header, or one of another definition


def convert_message(
    line: TopicPlan, decoded: Any, time_ns: int, where: MessageContext
) -> Iterator[Sample]:
    """Yield the samples of a decoded message."""
    if line.kind in MOTIONS and (frame := _find_frame_with_z_down(decoded)):
        leave_out(f"messages on {line.topic} in the frame {frame}: {Z_DOWN_HINT}", where.source)
    elif not line.kind.startswith(DMRL_PREFIX):
        try:
            with np.errstate(invalid="ignore"):  # what is not finite is left out, and counted
                yield from list(CONVERTERS[line.kind](decoded, time_ns, where))
        except (AttributeError, TypeError, ValueError, LookupError, ArithmeticError):
            # The file's definition of a standard type may be another.
            leave_out(f"messages on {line.topic} that cannot be decoded", where.source)
    elif (sample := convert_dmrl_message(decoded, line.topic, time_ns)) is not None:
        yield sample
    else:
        leave_out(f"messages on {line.topic} of another version of dmrl", where.source)


def _find_frame_with_z_down(message: Any) -> str:
    """Return the first frame of a message whose z is down by its name, by REP 103; or nothing."""
    parent = getattr(getattr(message, "header", None), "frame_id", "")
    frames = (str(parent), str(getattr(message, "child_frame_id", "")))
    return next(filter(Z_DOWN_FRAME.search, frames), "")


def select_usable(
    samples: Iterator[Sample], where: object, calibrated: dict[str, Mapping[str, Any]]
) -> Iterator[Sample]:
    """Yield the samples whose numbers are finite, and of calibrations the first of each topic.

    A calibration is sent with every image and seldom changes. ``calibrated`` holds the one of each
    topic. dmrl's own messages may hold infinite numbers, such as unknown sigmas.
    """
    for sample in samples:
        if sample.message in FOREIGN_OUTPUTS and not _is_finite(sample.fields):
            reason = f"samples of {sample.topic} with values that are not finite"
            leave_out(reason, f"{where} at {sample.time_ns} ns")
        elif sample.message != "CameraCalibration":
            yield sample
        else:
            fields = {k: v for k, v in sample.fields.items() if k != "timestamp"}
            if (first := calibrated.setdefault(sample.topic, fields)) is fields:
                yield sample
            elif first != fields:
                reason = f"calibrations on {sample.topic} that differ from the first"
                leave_out(reason, f"{where} at {sample.time_ns} ns")


def _is_finite(value: Any) -> bool:
    """Return whether a field, its parts and its items are finite where they are numbers."""
    if isinstance(value, float):
        return isfinite(value)
    if isinstance(value, Mapping):
        return all(_is_finite(part) for part in value.values())
    return not isinstance(value, list) or all(_is_finite(part) for part in value)


FORMAT = Format("rosbag2", "a ROS bag", can_read, load_content, SOURCE_OPTIONS | {"bits"})
