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

import errno
import re
import sqlite3
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from dmrl import topics
from dmrl.errors import DmrlError, MissingExtra, SourceError
from dmrl.formats.base import SOURCE_OPTIONS, Content, Format, Options
from dmrl.formats.clocks import MessageClock
from dmrl.formats.files.pictures import scaling_words
from dmrl.formats.ros.ros_messages import (
    CONVERTERS,
    DMRL_PREFIX,
    MessageContext,
    convert_dmrl_message,
)
from dmrl.guards.memory import MemoryLimit, measure_size
from dmrl.samples.sample import Sample
from dmrl.terminal.progress import say

SUFFIXES = (".db3", ".bag", ".mcap")
ROS1_MAGIC = b"#ROSBAG V2.0\n"
NON_CAMERA_TOPICS = (topics.MASKS, topics.DEPTHS)
"""Image topics of an exported render that are not images of a camera."""
MOTION_CAPTURE = re.compile(
    r"vrpn|mocap|optitrack|vicon|qualisys|natnet|motive|truth", re.IGNORECASE
)
COMPUTED_TABLE = re.compile(r"\bVIRTUAL\b|\bGENERATED\b|\bAS\s*\(", re.IGNORECASE)
# Parts of a topic that describe its content rather than name its robot.
GENERIC_PART = re.compile(
    r"odom\w*|odometry|pose\w*|imu\w*|data|raw|twist|velocity|image\w*|color|colour|camera\w*|rgb|"
    r"compressed|info|camera_info|filtered|local|vrpn_client_node|mavros|state|truth|calibration|"
    r"uwb\w*|rang(e|es|ing)|dist(ance|ances)?|peers?|to|from",
    re.IGNORECASE,
)


def can_read(source: Path) -> bool:
    """Return whether a source is a ROS 1 bag, a rosbag2 folder, or the storage of one."""
    if source.is_dir():
        return (source / "metadata.yaml").is_file()
    if source.suffix not in SUFFIXES:
        return False
    with source.open("rb") as stream:
        head = stream.read(64)
    if source.suffix == ".mcap":
        return b"ros2" in head
    return head.startswith((b"SQLite format 3", b"#ROSBAG V2"))


@dataclass(frozen=True, slots=True)
class TopicPlan:
    """Conversion of one topic of a bag: its type, message count, robot and peer."""

    topic: str
    kind: str
    count: int
    robot: str
    peer: str = ""


def load_content(source: Path, options: Options) -> Content:
    """Load the samples of a bag, in the bag's order.

    Parameters
    ----------
    source
        The bag.
    options
        ``names`` renames robots; others keep the names in their topics. ``robot`` is the robot of
        topics that name none.

    Raises
    ------
    SourceError
        If the bag cannot be read, or has no supported topic.
    MissingExtra
        If rosbags is not installed.
    """
    lines, unknown = plan_topics(_list_topics(source), options)
    if not lines:
        known = ", ".join(sorted({*CONVERTERS}))
        raise SourceError(f"{source} has no topic of a known type: {known}. Pass another bag")
    if unknown:
        say(f"{source}: left out: {', '.join(sorted(unknown))}")
    return Content(
        _iter_samples(source, lines, options), sum(line.count for line in lines.values())
    )


def plan_topics(
    held: list[tuple[str, str, int]], options: Options
) -> tuple[dict[tuple[str, str], TopicPlan], list[str]]:
    """Return the conversion of each topic, and the topics that are left out.

    Parameters
    ----------
    held
        Topic, type and number of messages.
    options
        See ``load_content``.
    """
    lines: dict[tuple[str, str], TopicPlan] = {}
    unknown = []
    for topic, kind, count in held:
        line = _plan_topic(topic, kind, count, options)
        if line is None or not count:
            unknown += [topic] if count else []
        else:
            lines[topic, kind] = line
    # One topic per type and robot: two interleaved ones would contradict each other.
    best: dict[tuple[str, str, str, bool], TopicPlan] = {}
    for line in lines.values():
        key = (line.kind, line.robot, line.peer, bool(MOTION_CAPTURE.search(line.topic)))
        if not line.kind.startswith(DMRL_PREFIX) and (
            key not in best or best[key].count < line.count
        ):
            best[key] = line
    kept = {
        key: line
        for key, line in lines.items()
        if line.kind.startswith(DMRL_PREFIX) or line in best.values()
    }
    return kept, unknown + [line.topic for key, line in lines.items() if key not in kept]


def _plan_topic(topic: str, kind: str, count: int, options: Options) -> TopicPlan | None:
    def name(part: str) -> str:
        part = options.names.get(part, part)
        return re.sub(r"[^A-Za-z0-9_-]", "_", part)

    if kind.startswith(DMRL_PREFIX):
        return TopicPlan(topic, kind, count, "")
    if kind not in CONVERTERS or any(topics.parse_topic(one, topic) for one in NON_CAMERA_TOPICS):
        return None
    own = [name(part) for part in topic.split("/") if part and not GENERIC_PART.fullmatch(part)]
    if kind != "sensor_msgs/msg/Range":
        return TopicPlan(topic, kind, count, own[-1] if own else options.robot)
    if len(own) < 2 or own[-2] == own[-1]:
        return None
    return TopicPlan(topic, kind, count, own[-2], own[-1])


def _open_reader(source: Path) -> Any:
    try:
        from rosbags.highlevel import AnyReader  # noqa: PLC0415
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ModuleNotFoundError as e:
        raise MissingExtra("rosbags", "ros", "a ROS bag") from e
    return AnyReader([source], default_typestore=get_typestore(Stores.ROS2_HUMBLE))


def _list_topics(source: Path) -> list[tuple[str, str, int]]:
    """List topic, type and number of messages of all connections of a bag."""
    found: Counter[tuple[str, str]] = Counter()
    for connection in _iter_guarded(source, lambda reader: iter(reader.connections)):
        found[connection.topic, connection.msgtype] += connection.msgcount
    return [(topic, kind, count) for (topic, kind), count in found.items()]


def _check_storage(source: Path) -> None:
    """Raise SourceError unless a bag's SQLite files have tables alone; a view can run any query.

    A ROS 1 bag must begin with its magic: rosbags reads its first line, however long it is.
    """
    for path in sorted(source.glob("*.db3")) if source.is_dir() else [source]:
        with path.open("rb") as stream:
            head = stream.read(16)
        if path.suffix == ".bag" and not head.startswith(ROS1_MAGIC):
            raise SourceError(f"{path} does not begin as a ROS 1 bag 2.0. Pass another file")
        if not head.startswith(b"SQLite format 3"):
            continue
        where = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
        with closing(sqlite3.connect(where, uri=True)) as database:
            for kind, text in database.execute("SELECT type, sql FROM sqlite_master"):
                if kind not in ("table", "index") or COMPUTED_TABLE.search(text or ""):
                    raise SourceError(f"{path} has more than tables. Record the bag again")


def _iter_guarded(source: Path, of: Any) -> Iterator[Any]:
    """Yield the items of ``of(reader)``, with any error of rosbags as one line.

    rosbags passes on the errors of sqlite, YAML, struct and its decompressors on damaged bags, so
    all exceptions are caught.
    """
    try:
        bound = MemoryLimit(measure_size(source))
        reader = _open_reader(source)
        _check_storage(source)
        with bound:
            reader.open()
        with closing(reader):
            found = of(reader)
            while True:
                with bound:
                    one = next(found, None)
                if one is None:
                    return
                yield one
    except DmrlError:
        raise
    except Exception as e:
        if isinstance(e, MemoryError) or getattr(e, "errno", None) == errno.EFBIG:
            raise SourceError(
                f"{source} unpacks to much more than its size explains. Record the bag again"
            ) from e
        why = " ".join(str(e).split())[:200] or type(e).__name__
        raise SourceError(f"{source} cannot be read as a ROS bag: {why}. Restore it") from e


def _iter_samples(
    source: Path, lines: Mapping[tuple[str, str], TopicPlan], options: Options
) -> Iterator[Sample]:
    calibrated: set[str] = set()
    unstamped: Counter[str] = Counter()
    fixed: set[str] = set()
    scaled: set[str] = set()
    moving = {line.robot for line in lines.values() if line.kind == "nav_msgs/msg/Odometry"}

    def messages(reader: Any) -> Iterator[Any]:
        wanted = [c for c in reader.connections if (c.topic, c.msgtype) in lines]
        for connection, bag_ns, data in reader.messages(connections=wanted):
            line = lines[connection.topic, connection.msgtype]
            yield line, bag_ns, reader.deserialize(data, connection.msgtype)

    with closing(_iter_guarded(source, messages)) as first:
        stamps = ((line.topic, _header_time_ns(decoded), at) for line, at, decoded in first)
        clock = MessageClock.from_stamps(source, stamps)
    for line, bag_ns, decoded in _iter_guarded(source, messages):
        captured, odometry = bool(MOTION_CAPTURE.search(line.topic)), line.robot in moving
        where = MessageContext(
            source, line.robot, line.peer, captured, odometry, fixed, options.bits
        )
        # Without a time in the header, the bag's own time is the best estimate.
        stamp_ns = _header_time_ns(decoded)
        unstamped[line.topic] += clock.is_unset(line.topic, stamp_ns) and bag_ns > 0
        if (time_ns := clock.find_time_ns(line.topic, stamp_ns, bag_ns)) is None:
            continue
        for sample in _convert_message(line, decoded, time_ns, where):
            is_calibration = sample.message == "CameraCalibration"
            # A calibration is sent with every image and never changes: keep the first.
            if not (is_calibration and sample.topic in calibrated):
                yield replace(sample, publish_ns=max(bag_ns, 0))
            if is_calibration:
                calibrated.add(sample.topic)
    if scaled:
        say(f"{source}: images of {', '.join(sorted(scaled))}: {scaling_words(options.bits)}")
    _report_problems(source, fixed, unstamped)


def _report_problems(source: Path, fixed: set[str], unstamped: Mapping[str, int]) -> None:
    """Report velocities that were left out, and topics whose stamps are 0."""
    if fixed:
        say(
            f"{source}: left out: velocities of {', '.join(sorted(fixed))}, which are in a frame "
            "that does not turn with the robot. Record its odometry"
        )
    if zeros := [f"{count} on {topic}" for topic, count in unstamped.items() if count]:
        say(f"{source}: messages with a stamp of 0 get the bag's times: {', '.join(zeros)}")


def _header_time_ns(message: Any) -> int | None:
    """Return the time in the header; 0: it is empty, None: there is no header."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None:
        return None
    return max(int(stamp.sec * 1_000_000_000 + stamp.nanosec), 0)


def _convert_message(
    line: TopicPlan, message: Any, time_ns: int, where: MessageContext
) -> Iterator[Sample]:
    if not line.kind.startswith(DMRL_PREFIX):
        yield from CONVERTERS[line.kind](message, time_ns, where)
    elif (sample := convert_dmrl_message(message, line.topic, time_ns)) is not None:
        yield sample


FORMAT = Format("rosbag2", "a ROS bag", can_read, load_content, SOURCE_OPTIONS | {"bits"})
