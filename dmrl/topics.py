"""Table of topics: message, frame, units, rate, writers; for sensors also plots and CSV columns.

A sensor is a message and a row here. Conversion from CSV, views, plots while recording, merging,
labelling and the table in README.md are derived from it.

``<robot>`` carries the camera or sensor; ``<peer>`` is the robot in view or ranged to.
"""

import re
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

from dmrl.guards.safe_names import check_topic_part


@dataclass(frozen=True, slots=True)
class PlotSpec:
    """Plot of a sensor over time.

    Parameters
    ----------
    title
        Title of the panel: the quantity, a comma, the unit. Sensors with one title share a panel.
    fields
        Fields of the message, a line each.
    length
        Plot one line: the length of the vector whose components are the fields.
    name
        Name of the lines; empty: that of the robot or, for a pair, of the sensor.
    """

    title: str
    fields: tuple[str, ...]
    length: bool = False
    name: str = ""

    def list_lines(self, topic: str) -> dict[str, tuple[str, ...]]:
        """Return the path of each line of a topic in a view, and the fields that it shows."""
        if self.length or len(self.fields) == 1:
            return {topic: self.fields}
        return {f"{topic}/{field}": (field,) for field in self.fields}


class UnitCheck(NamedTuple):
    """Check for values in a wrong unit: a tenth is too large for a small robot, or all too small.

    ``field`` of the message, in ``unit``; ``over`` is the largest plausible magnitude, and
    ``perhaps`` the likely unit of larger ones. ``under`` is the smallest plausible one; 0: none.
    """

    field: str
    over: float
    unit: str
    perhaps: str
    under: float = 0.0


@dataclass(frozen=True, slots=True)
class Topic:
    """One row of the table.

    Parameters
    ----------
    pattern
        Topic with ``{robot}`` and ``{peer}`` as placeholders.
    message
        Full name of its message; a final ``*`` matches any ending.
    frame
        Frame of its values.
    units
        Units of its values.
    rate
        Usual rate.
    written_by
        Commands that write it, separated by commas.
    sensor
        Whether it contains the raw readings of a robot's sensor. A robot has one stream of it, and
        a robot with such a topic counts as flying.
    curve
        Plot of its values; None: no plot, or a special one.
    csv
        Floating-point fields that a flight's CSV file may have, with the same names; for a pair
        with the peer before the unit: ``range_m`` is ``range_<peer>_m``.
    doubts
        Checks for values in a wrong unit.
    """

    pattern: str
    message: str
    frame: str
    units: str
    rate: str
    written_by: str
    sensor: bool = False
    curve: PlotSpec | None = None
    csv: tuple[str, ...] = ()
    doubts: tuple[UnitCheck, ...] = ()

    @property
    def is_pairwise(self) -> bool:
        """Whether it describes a peer."""
        return "{peer}" in self.pattern

    def accepts_message(self, message: str) -> bool:
        """Return whether a message of this full name may be on the topic."""
        if self.message.endswith("*"):
            return message.startswith(self.message[:-1])
        return message == self.message


class RobotTopic(str):
    """Pattern of a robot's topic. Call it to fill it: ``HEIGHT("cf1")`` is ``/cf1/height``."""

    __slots__ = ()

    def __call__(self, robot: str) -> str:
        """Return the topic of a robot."""
        return format_topic(self, robot=robot)


class PairTopic(str):
    """Pattern of the topic of a pair: ``RANGE("cf1", "cf2")`` is ``/cf1/range/cf2``."""

    __slots__ = ()

    def __call__(self, robot: str, peer: str) -> str:
        """Return the topic of a robot and its peer."""
        return format_topic(self, robot=robot, peer=peer)


class LogTopic(str):
    """Pattern of the topic of logged variables: ``LOG("cf1", "state")`` is ``/cf1/log/state``."""

    __slots__ = ()

    def __call__(self, robot: str, event: str) -> str:
        """Return the topic of a robot's log variables, as they were logged."""
        return format_topic(self, robot=robot, event=event)


CAMERA_IMAGE = RobotTopic("/{robot}/camera/image")
CALIBRATION = RobotTopic("/{robot}/camera/calibration")
ATTITUDE = RobotTopic("/{robot}/attitude")
VELOCITY = RobotTopic("/{robot}/velocity")
HEIGHT = RobotTopic("/{robot}/height")
RANGE = PairTopic("/{robot}/range/{peer}")
POSITION = PairTopic("/{robot}/peer/{peer}/position")
TRUTH = PairTopic("/{robot}/peer/{peer}/truth")
CAUSES = PairTopic("/{robot}/peer/{peer}/causes")
LABELS = RobotTopic("/{robot}/labels")
DETECTIONS = RobotTopic("/{robot}/detections")
GRID = RobotTopic("/{robot}/detections/grid")
TRACKS = RobotTopic("/{robot}/tracks")
COMMAND = RobotTopic("/{robot}/command")
MASKS = RobotTopic("/{robot}/camera/masks")
DEPTHS = RobotTopic("/{robot}/camera/depth")
POSE = RobotTopic("/{robot}/pose")
TRUE_POSE = RobotTopic("/{robot}/pose/truth")
LOG = LogTopic("/{robot}/log/{event}")
TRANSFORMS = "/tf"

PLACE_DOUBTS = tuple(UnitCheck(f"pose.position.{axis}", 300.0, "m", "mm or cm") for axis in "xyz")
TOPICS = (
    Topic(
        CAMERA_IMAGE,
        "foxglove.CompressedImage",
        "image",
        "png or jpeg",
        "camera",
        "convert, record, render, fly",
        sensor=True,
    ),
    Topic(
        CALIBRATION,
        "foxglove.CameraCalibration",
        "image",
        "px",
        "once",
        "convert, record, render, fly",
    ),
    Topic(
        LABELS, "dmrl.v1.PeerLabels", "image", "px, m", "per image", "convert, render, fly, label"
    ),
    Topic(MASKS, "foxglove.CompressedImage", "image", "number of the peer", "per image", "render"),
    Topic(DEPTHS, "foxglove.CompressedImage", "image", "png, mm", "per image", "render"),
    Topic(DETECTIONS, "dmrl.v1.Detections", "image", "px, m", "per image", "predict, fly"),
    Topic(GRID, "dmrl.v1.GridMap", "image grid", "0..1, m", "per image", "predict, fly, convert"),
    Topic(TRACKS, "dmrl.v1.Tracks", "<robot>/horizontal", "m, m/s", "per image", "track, fly"),
    Topic(
        COMMAND,
        "dmrl.v1.Command",
        "<robot>/horizontal",
        "m/s, rad/s",
        "20 Hz",
        "fly",
        curve=PlotSpec("commands, m/s", ("vx_mps", "vy_mps", "vz_mps")),
    ),
    Topic(
        ATTITUDE,
        "dmrl.v1.Attitude",
        "<robot>/horizontal",
        "rad, rad/s",
        "100 Hz",
        "convert, record, render, fly",
        sensor=True,
        csv=("roll_rad", "pitch_rad", "yaw_rate_radps"),
        doubts=(
            UnitCheck("roll_rad", 0.8, "rad", "degrees"),
            UnitCheck("pitch_rad", 0.8, "rad", "degrees"),
            UnitCheck("yaw_rate_radps", 5.0, "rad/s", "degrees per second"),
        ),
    ),
    Topic(
        VELOCITY,
        "dmrl.v1.Velocity",
        "<robot>/horizontal",
        "m/s",
        "100 Hz",
        "convert, record, fly",
        sensor=True,
        curve=PlotSpec("speed, m/s", ("vx_mps", "vy_mps"), length=True),
        csv=("vx_mps", "vy_mps"),
        doubts=(
            UnitCheck("vx_mps", 20.0, "m/s", "mm/s or cm/s"),
            UnitCheck("vy_mps", 20.0, "m/s", "mm/s or cm/s"),
        ),
    ),
    Topic(
        HEIGHT,
        "dmrl.v1.Height",
        "world z",
        "m",
        "100 Hz",
        "convert, record, fly",
        sensor=True,
        curve=PlotSpec("height, m", ("height_m",)),
        csv=("height_m",),
        doubts=(UnitCheck("height_m", 30.0, "m", "mm or cm", 0.005),),
    ),
    Topic(
        RANGE,
        "dmrl.v1.UwbRange",
        "-",
        "m",
        "50 Hz",
        "convert, record, fly",
        sensor=True,
        curve=PlotSpec("distance, m", ("range_m",), name="UWB"),
        csv=("range_m",),
        doubts=(UnitCheck("range_m", 100.0, "m", "mm or cm", 0.1),),
    ),
    Topic(POSITION, "dmrl.v1.PeerPosition", "<robot>/horizontal", "m, m^2", "20 Hz", "label"),
    Topic(CAUSES, "dmrl.v1.PeerCauses", "-", "s", "once", "label"),
    Topic(
        TRUTH,
        "dmrl.v1.PeerPosition",
        "<robot>/horizontal",
        "m, m^2",
        "20 Hz",
        "convert, render, fly",
    ),
    Topic(POSE, "foxglove.PoseInFrame", "world", "m", "100 Hz", "convert", doubts=PLACE_DOUBTS),
    Topic(
        TRUE_POSE,
        "foxglove.PoseInFrame",
        "world",
        "m",
        "100 Hz",
        "convert",
        doubts=PLACE_DOUBTS,
    ),
    Topic(LOG, "dmrl.log.*", "-", "as logged", "as logged", "convert"),
    Topic(TRANSFORMS, "foxglove.FrameTransforms", "world", "m", "20 Hz", "convert, fly, render"),
)

SENSORS = tuple(row for row in TOPICS if row.sensor)
OWN_SENSORS = tuple(row for row in SENSORS if not row.is_pairwise and row.pattern != CAMERA_IMAGE)
"""Sensors with which a robot measures itself."""
OWN_CURVES = tuple(row for row in TOPICS if row.curve is not None and not row.is_pairwise)
"""Rows with a plot of one robot."""
PAIR_SENSORS = tuple(row for row in SENSORS if row.is_pairwise)
"""Sensors with which a robot measures a peer."""


def format_topic(pattern: str, **parts: str) -> str:
    """Fill a pattern. A part with a slash is rejected: it would change the topic and file name."""
    return pattern.format(**{what: check_topic_part(name, what) for what, name in parts.items()})


@cache
def _compile_pattern(pattern: str) -> re.Pattern[str]:
    return re.compile(re.sub(r"\\{(\w+)\\}", r"(?P<\1>[^/]+)", re.escape(pattern)))


def parse_topic(pattern: str, topic: str) -> dict[str, str] | None:
    """Return the values of a pattern's placeholders in a topic, or None if it does not match.

    Examples
    --------
    >>> parse_topic(RANGE, "/cf1/range/cf2")
    {'robot': 'cf1', 'peer': 'cf2'}
    >>> parse_topic(RANGE, "/cf1/labels") is None
    True
    """
    match = _compile_pattern(pattern).fullmatch(topic)
    return match.groupdict() if match else None


@cache
def find_topic(topic: str) -> Topic | None:
    """Return the table's row for a topic, or None for a topic that is not dmrl's."""
    return next((row for row in TOPICS if parse_topic(row.pattern, topic) is not None), None)


def find_pattern(topic: str) -> str:
    """Return the pattern of a topic; the topic itself if it is not dmrl's."""
    row = find_topic(topic)
    return topic if row is None else row.pattern


def list_robots(topics: list[str] | tuple[str, ...], pattern: str = CAMERA_IMAGE) -> list[str]:
    """Return the robots that have a topic of this pattern, sorted."""
    found = (parse_topic(pattern, topic) for topic in topics)
    return sorted({n["robot"] for n in found if n is not None})
