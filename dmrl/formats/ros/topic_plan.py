"""Plan of a bag: which topics are converted, and whose they are.

A robot is the part of a topic that neither describes the content (``odom``, ``camera``) nor holds
robots (``swarm``). Of several such parts, one with a number counts, then the one that most topics
share, then the first. ``Options.names`` decides by part or by topic.
"""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from dmrl import topics
from dmrl.errors import SettingError
from dmrl.formats.base import Options
from dmrl.formats.ros.ros_messages import CONVERTERS, DMRL_PREFIX
from dmrl.terminal.progress import say

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO, RANGE = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Range"
POSE, ODOMETRY = "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry"
TWIST, IMU = "geometry_msgs/msg/TwistStamped", "sensor_msgs/msg/Imu"
TARGETS = {
    **dict.fromkeys(IMAGE_TYPES, (topics.CAMERA_IMAGE,)),
    CAMERA_INFO: (topics.CALIBRATION,),
    RANGE: (topics.RANGE,),
    POSE: (topics.POSE, topics.TRUE_POSE),
    ODOMETRY: (topics.POSE, topics.ATTITUDE, topics.VELOCITY, topics.HEIGHT),
    IMU: (topics.ATTITUDE,),
    TWIST: (topics.VELOCITY,),
}
"""Topics that messages become, by type."""
NON_CAMERA_TOPICS = (topics.MASKS, topics.DEPTHS)
"""Image topics of an exported render that are not images of a camera."""
MOTION_CAPTURE = re.compile(
    r"vrpn|mocap|optitrack|vicon|qualisys|natnet|motive|truth", re.IGNORECASE
)
CONTENT_PART = re.compile(
    r"(odom\w*|pose\w*|imu|data|raw|twist\w*|vel(ocity)?(_\w*)?|speed|attitude|orientation|vision|image\w*|colou?r|cam(era)?([_-]\w*)?|rgbd?|mono|"
    r"gr[ae]y|depth\w*|compressed\w*|info|camera_info|filtered|fused|local\w*|global\w*|position|"
    r"setpoint\w*|estimat\w*|state\w*|vrpn\w*|mavros|px4(?![_-]?\d)|fmu|fcu|out|in|truth|ground_truth|gt|"
    r"calibration|uwb\w*|rang(e|es|ing)([_-]\w*)?|dist(ance|ances)?([_-]\w*)?|peers?|to|from|"
    r"front|rear|back|left|right|up|down(ward)?|top|bottom|forward|floor|ground|tof|lidar\w*|"
    r"laser\w*|sonar\w*|ultraso\w*|flow|optical_flow|multi_?ranger?|zrange|height|altitude|"
    r"range_?finder|sensors?|vl53\w*|tf_?mini\w*|tera_?ranger\w*|h26[45]|theora|video|rect\w*|"
    r"infra\w*|stereo|thermal|mocap\w*|optitrack|vicon\w*|qualisys|natnet\w*|motive)[_-]?\d*",
    re.IGNORECASE,
)
"""Parts of a topic that describe its content and never name a robot."""
HOLDER_PART = re.compile(
    r"swarm|ns|fleet|robots?|drones?|uavs?|vehicles?|agents?|vio|vins\w*|ov_msckf|orb_?slam\w*|slam|"
    r"rtabmap|msf\w*|ekf\w*|ukf\w*|kalman\w*|drivers?|hardware|node|client|realsense\w*|zed\w*",
    re.IGNORECASE,
)
"""Parts that seldom name a robot: they do where no other part can."""
COMMAND_PART = re.compile(
    r"(\w*_)?(setpoint|cmd|command|goal|desired|waypoint)s?(_\w*)?", re.IGNORECASE
)
"""Parts that say that a pose or velocity is what the robot is to have, not what it has."""
DEPTH_NAME = re.compile(r"depth|disparity", re.IGNORECASE)
NUMBERED_NAME = re.compile(r"([A-Za-z][A-Za-z_-]*?)[_-]?\d+")
UWB_PART = re.compile(
    r"uwb\w*|dwm?\d+\w*|lps|loco\w*|p2p|peers?|link_?track|nooploop", re.IGNORECASE
)
"""Parts that say that a range is one between radios."""
RECTIFIED_PART = re.compile(r"(image_)?rect(_\w+|ified\w*)?", re.IGNORECASE)
"""Parts that say that the lens was removed from images, as ``image_proc`` does."""


@dataclass(frozen=True, slots=True)
class TopicPlan:
    """Conversion of one topic: its type, message count, robot, peer.

    ``captured``: a true pose. ``rectified``: a calibration of rectified images.
    """

    topic: str
    kind: str
    count: int
    robot: str
    peer: str = ""
    captured: bool = False
    rectified: bool = False

    @property
    def key(self) -> tuple[str, str]:
        """Topic and type."""
        return self.topic, self.kind


Held = Sequence[tuple[str, str, int]]
"""Topic, type and number of messages of each connection."""


def plan_topics(
    held: Held, options: Options, is_camera: Callable[[str, str], bool] = lambda *_: True
) -> tuple[dict[tuple[str, str], TopicPlan], dict[tuple[str, str], str]]:
    """Return the conversion of each topic, and why topics are left out, by topic and type.

    Parameters
    ----------
    held
        Topic, type and number of messages.
    options
        ``names`` renames robots, or names the robot of a topic; ``robot`` is that of topics that
        name none.
    is_camera
        Return whether a topic of images, by name and type, has images of a camera that can be
        decoded. It is called only for robots with several such topics.

    Raises
    ------
    SettingError
        If ``names`` gives a topic of dmrl's for one of another content.
    """
    _check_names(held, options)
    names = _TopicNames([topic for topic, kind, _ in held if kind in CONVERTERS], options)
    lines: dict[tuple[str, str], TopicPlan] = {}
    why: dict[tuple[str, str], str] = {}
    for topic, kind, count in sorted(held, key=lambda one: one[1] == RANGE):  # robots, then pairs
        if not count:
            continue
        if kind.startswith(DMRL_PREFIX):
            lines[topic, kind] = TopicPlan(topic, kind, count, "")
        elif kind not in CONVERTERS or any(topics.parse_topic(t, topic) for t in NON_CAMERA_TOPICS):
            why[topic, kind] = f"{kind} is not converted"
        elif kind in (POSE, ODOMETRY, TWIST) and names.is_command(topic):
            choice = f"--names {topic}={TARGETS[kind][0].format(robot='ROBOT')} takes it"
            why[topic, kind] = f"its name is that of a command, not of a measurement ({choice})"
        elif kind == RANGE:
            known = {line.robot for line in lines.values()}
            if (pair := names.find_pair(topic, known)) is None:
                why[topic, kind] = (
                    "it names no two robots, so it is no range to a peer "
                    f"(--names {topic}=/ROBOT/range/PEER)"
                )
            else:
                lines[topic, kind] = TopicPlan(topic, kind, count, *pair)
        else:
            captured = bool(MOTION_CAPTURE.search(options.names.get(topic, topic)))
            robot = names.find_robot(topic)
            lines[topic, kind] = TopicPlan(topic, kind, count, robot, captured=captured)
    removed = _remove_depths_and_doubles(lines, options, is_camera)
    return _mark_rectified(lines), why | removed


def _mark_rectified(
    lines: Mapping[tuple[str, str], TopicPlan],
) -> dict[tuple[str, str], TopicPlan]:
    """Mark the calibrations of robots whose images are rectified, by the names of their topics."""
    images = {line.robot: line.topic for line in lines.values() if line.kind in IMAGE_TYPES}
    found = dict(lines)
    for line in lines.values():
        topic = images.get(line.robot, "")
        if line.kind == CAMERA_INFO and any(map(RECTIFIED_PART.fullmatch, topic.split("/"))):
            say(f"{topic} is rectified by its name: the calibration is P of {line.topic}")
            found[line.key] = replace(line, rectified=True)
    return found


def _check_names(held: Held, options: Options) -> None:
    for topic, kind, _ in held:
        wanted = options.names.get(topic, "")
        if "/" in wanted and not any(topics.parse_topic(t, wanted) for t in TARGETS.get(kind, ())):
            raise SettingError(f"--names {topic}={wanted}: {kind} is not converted to {wanted}")


def _remove_depths_and_doubles(
    lines: dict[tuple[str, str], TopicPlan],
    options: Options,
    is_camera: Callable[[str, str], bool],
) -> dict[tuple[str, str], str]:
    """Remove depths and doubles of other topics from the lines, and return why."""
    why = {}
    for line in [one for one in lines.values() if _is_depth(one, options, is_camera)]:
        del lines[line.topic, line.kind]
        choice = f"--names {line.topic}={topics.CAMERA_IMAGE(line.robot)} takes it as images"
        why[line.topic, line.kind] = f"its name and encoding are those of depths ({choice})"
    for line, better in _find_doubles(lines, options, is_camera):
        del lines[line.topic, line.kind]
        why[line.topic, line.kind] = f"another topic has this of {line.robot}, {better.topic}"
    return why


def _is_depth(line: TopicPlan, options: Options, is_camera: Callable[[str, str], bool]) -> bool:
    """Return whether a topic is a map of depths by its name and its encoding (REP 118)."""
    is_named = line.kind in IMAGE_TYPES and DEPTH_NAME.search(line.topic)
    return bool(is_named) and line.topic not in options.names and not is_camera(*line.key)


def _find_doubles(
    lines: Mapping[tuple[str, str], TopicPlan],
    options: Options,
    is_camera: Callable[[str, str], bool],
) -> list[tuple[TopicPlan, TopicPlan]]:
    """Return the topics beside better ones of the same content: mixed, they would contradict.

    A topic that the user names is the best.
    """
    groups: dict[tuple[object, ...], list[TopicPlan]] = {}
    for line in lines.values():
        kind = "image" if line.kind in IMAGE_TYPES else line.kind
        kind = ODOMETRY if kind == POSE and not line.captured else kind
        if not kind.startswith(DMRL_PREFIX):
            groups.setdefault((kind, line.robot, line.peer, line.captured), []).append(line)
    best: dict[tuple[object, ...], TopicPlan] = {}
    cameras: dict[str, str] = {}

    def rank(line: TopicPlan) -> tuple[object, ...]:
        unnamed = line.topic not in options.names
        if line.kind in IMAGE_TYPES:
            is_other = unnamed and not is_camera(line.topic, line.kind)
            return unnamed, is_other, -line.count, line.kind != IMAGE_TYPES[0]
        if line.kind == CAMERA_INFO:
            camera = cameras.get(line.robot, "").split("/")
            shared = sum(map(str.__eq__, camera, line.topic.split("/")))
            return unnamed, -shared, -line.count
        # By REP 145, imu/data_raw has no orientation, which imu/data has. MAVROS's velocity_local
        # does not turn with the robot, as velocity_body does.
        return unnamed, line.kind == POSE, line.topic.endswith(("_raw", "_local")), -line.count

    for key in sorted(groups, key=lambda one: one[0] == CAMERA_INFO):  # after the images
        found = groups[key]
        best[key] = min(found, key=rank) if len(found) > 1 else found[0]
        if key[0] == "image":
            cameras[best[key].robot] = best[key].topic
    return [(x, best[key]) for key, found in groups.items() for x in found if x is not best[key]]


def _is_content(part: str) -> bool:
    """Return whether a part describes its content, as a whole or in each word: ``data_raw``."""
    return bool(CONTENT_PART.fullmatch(part)) or all(map(CONTENT_PART.fullmatch, part.split("_")))


class _TopicNames:
    """Robots by the parts of topics.

    Parameters
    ----------
    known
        Topics that may be converted.
    options
        See `plan_topics`.
    """

    def __init__(self, known: Sequence[str], options: Options) -> None:
        self._options = options
        self._shared = Counter(part for topic in known for part in {*self._candidates(topic)})

    def _candidates(self, topic: str) -> list[str]:
        told, parts = self._options.names, [part for part in topic.split("/") if part]
        own = [part for part in parts if part in told or not _is_content(part)]
        return [part for part in own if part in told or not HOLDER_PART.fullmatch(part)] or own

    def _rename(self, part: str) -> str:
        return re.sub(r"[^A-Za-z0-9_-]", "_", self._options.names.get(part, part))

    def _named(self, topic: str) -> dict[str, str] | None:
        """Return the robot, and the peer, that the user names for a topic."""
        wanted = self._options.names.get(topic, "")
        row = topics.find_topic(wanted)
        if row is not None:
            return topics.parse_topic(row.pattern, wanted)
        return {"robot": wanted} if wanted else None

    def is_command(self, topic: str) -> bool:
        """Return whether a topic is named as a command is, and not by the user."""
        named = topic in self._options.names
        return not named and any(map(COMMAND_PART.fullmatch, topic.split("/")))

    def find_robot(self, topic: str) -> str:
        """Return the robot of a topic."""
        if named := self._named(topic):
            return named["robot"]
        found = self._candidates(topic)
        if not found:
            return self._options.robot
        told = [part for part in found if part in self._options.names]
        numbered = [part for part in found if NUMBERED_NAME.fullmatch(part)]
        best = told or numbered or found
        robot = max(best, key=lambda part: self._shared[part])  # the first of equals
        if len(found) > 1 and not told:
            say(f"{topic} is taken as {self._rename(robot)}'s. --names {topic}=NAME decides")
        return self._rename(robot)

    def find_pair(self, topic: str, robots: set[str]) -> tuple[str, str] | None:
        """Return who ranges to whom; None if the topic does not say so.

        The range is one between radios if a part of the topic says so, if the peer has topics of
        its own, or if the names of both differ in their number only.
        """
        named = self._named(topic) or {}
        if "peer" in named:
            return named["robot"], named["peer"]
        own = [self._rename(part) for part in self._candidates(topic)]
        if len(own) < 2 or own[-2] == own[-1]:
            return None
        robot, peer = own[-2:]
        stems = [NUMBERED_NAME.fullmatch(name) for name in (robot, peer)]
        alike = all(stems) and len({stem[1] for stem in stems if stem}) == 1
        by_radio = any(UWB_PART.fullmatch(part) for part in topic.split("/"))
        return (robot, peer) if by_radio or alike or peer in robots else None
