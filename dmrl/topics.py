"""The one table of topics: message, frame, units, rate, who writes it; of sensors, what is plotted.

A sensor is a message and a row here: conversion from CSV, views, plots while recording, merging,
labelling and the table in README.md follow it.

``<robot>`` carries the camera or sensor; ``<peer>`` is the robot it sees or ranges to.
"""

import re
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

from dmrl.guards.safe_names import topic_part


@dataclass(frozen=True, slots=True)
class Curve:
    """What of a sensor is plotted over time.

    Parameters
    ----------
    title
        Of the panel: what it is, a comma, the unit. Sensors with one title share a panel.
    fields
        Of the message, a line each.
    length
        One line: the length of the vector whose components the fields are.
    name
        What the lines are called; empty: as the robot or, of a pair, the sensor.
    """

    title: str
    fields: tuple[str, ...]
    length: bool = False
    name: str = ""

    def lines(self, topic: str) -> dict[str, tuple[str, ...]]:
        """Where each line of a topic stands in a view, and the fields that it is made of."""
        if self.length or len(self.fields) == 1:
            return {topic: self.fields}
        return {f"{topic}/{field}": (field,) for field in self.fields}


class Doubt(NamedTuple):
    """Values of which a tenth is too large for a small robot: ``perhaps`` of another unit.

    ``field`` of the message, in ``unit``; ``over`` that, plus or minus, it is doubted.
    """

    field: str
    over: float
    unit: str
    perhaps: str


@dataclass(frozen=True, slots=True)
class Topic:
    """One row of the table.

    Parameters
    ----------
    pattern
        Topic with ``{robot}`` and ``{peer}`` left open.
    message
        Full name of its message; a final ``*`` stands for any ending.
    frame
        Frame its values are in.
    units
        Units of its values.
    rate
        How often, as a rule.
    written_by
        Commands that write it, with commas between.
    sensor
        Whether it is what a sensor of the robot says, as it says it: a robot has one stream of it,
        and whoever has one flies.
    curve
        How it is plotted; None: not at all, or in a way of its own.
    csv
        Floating-point fields that a flight's CSV file may have, named as here; for a pair with the
        peer before the unit: ``range_m`` is ``range_<peer>_m``.
    doubts
        Which of its values cannot be in its units.
    """

    pattern: str
    message: str
    frame: str
    units: str
    rate: str
    written_by: str
    sensor: bool = False
    curve: Curve | None = None
    csv: tuple[str, ...] = ()
    doubts: tuple[Doubt, ...] = ()

    @property
    def of_pairs(self) -> bool:
        """Whether it says something of a peer."""
        return "{peer}" in self.pattern

    def carries(self, message: str) -> bool:
        """Whether a message of this full name may be on the topic."""
        if self.message.endswith("*"):
            return message.startswith(self.message[:-1])
        return message == self.message


CAMERA_IMAGE = "/{robot}/camera/image"
CALIBRATION = "/{robot}/camera/calibration"
ATTITUDE = "/{robot}/attitude"
VELOCITY = "/{robot}/velocity"
HEIGHT = "/{robot}/height"
RANGE = "/{robot}/range/{peer}"
POSITION = "/{robot}/peer/{peer}/position"
TRUTH = "/{robot}/peer/{peer}/truth"
LABELS = "/{robot}/labels"
DETECTIONS = "/{robot}/detections"
GRID = "/{robot}/detections/grid"
TRACKS = "/{robot}/tracks"
MASKS = "/{robot}/camera/masks"
DEPTHS = "/{robot}/camera/depth"
POSE = "/{robot}/pose"
TRUE_POSE = "/{robot}/pose/truth"
LOG = "/{robot}/log/{event}"
TRANSFORMS = "/tf"

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
    Topic(DETECTIONS, "dmrl.v1.Detections", "image", "px, m", "per image", "predict"),
    Topic(GRID, "dmrl.v1.GridMap", "image grid", "0..1, m", "per image", "predict, convert"),
    Topic(TRACKS, "dmrl.v1.Tracks", "<robot>/horizontal", "m, m/s", "per image", "track"),
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
            Doubt("roll_rad", 0.8, "rad", "degrees"),
            Doubt("pitch_rad", 0.8, "rad", "degrees"),
            Doubt("yaw_rate_radps", 5.0, "rad/s", "degrees per second"),
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
        curve=Curve("speed, m/s", ("vx_mps", "vy_mps"), length=True),
        csv=("vx_mps", "vy_mps"),
        doubts=(
            Doubt("vx_mps", 20.0, "m/s", "mm/s or cm/s"),
            Doubt("vy_mps", 20.0, "m/s", "mm/s or cm/s"),
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
        curve=Curve("height, m", ("height_m",)),
        csv=("height_m",),
        doubts=(Doubt("height_m", 30.0, "m", "mm or cm"),),
    ),
    Topic(
        RANGE,
        "dmrl.v1.UwbRange",
        "-",
        "m",
        "50 Hz",
        "convert, record, fly",
        sensor=True,
        curve=Curve("distance, m", ("range_m",), name="UWB"),
        csv=("range_m",),
        doubts=(Doubt("range_m", 100.0, "m", "mm or cm"),),
    ),
    Topic(POSITION, "dmrl.v1.PeerPosition", "<robot>/horizontal", "m, m^2", "20 Hz", "label"),
    Topic(
        TRUTH,
        "dmrl.v1.PeerPosition",
        "<robot>/horizontal",
        "m, m^2",
        "20 Hz",
        "convert, render, fly",
    ),
    Topic(POSE, "foxglove.PoseInFrame", "world", "m", "100 Hz", "convert"),
    Topic(TRUE_POSE, "foxglove.PoseInFrame", "world", "m", "100 Hz", "convert"),
    Topic(LOG, "dmrl.log.*", "-", "as logged", "as logged", "convert"),
    Topic(TRANSFORMS, "foxglove.FrameTransforms", "world", "m", "20 Hz", "convert, fly, render"),
)

SENSORS = tuple(row for row in TOPICS if row.sensor)
OWN_SENSORS = tuple(row for row in SENSORS if not row.of_pairs and row.pattern != CAMERA_IMAGE)
"""What a robot measures of itself."""
PAIR_SENSORS = tuple(row for row in SENSORS if row.of_pairs)
"""What a robot measures of a peer."""


def filled(pattern: str, **parts: str) -> str:
    """The topic. A part that holds a slash would be another topic, and another file's name."""
    return pattern.format(**{what: topic_part(name, what) for what, name in parts.items()})


def camera_image(robot: str) -> str:
    """Topic of a robot's images."""
    return filled(CAMERA_IMAGE, robot=robot)


def calibration(robot: str) -> str:
    """Topic of a robot's camera calibration."""
    return filled(CALIBRATION, robot=robot)


def attitude(robot: str) -> str:
    """Topic of a robot's attitude."""
    return filled(ATTITUDE, robot=robot)


def velocity(robot: str) -> str:
    """Topic of a robot's velocity."""
    return filled(VELOCITY, robot=robot)


def height(robot: str) -> str:
    """Topic of a robot's height."""
    return filled(HEIGHT, robot=robot)


def uwb_range(robot: str, peer: str) -> str:
    """Topic of the distances that a robot measures to a peer."""
    return filled(RANGE, robot=robot, peer=peer)


def masks(robot: str) -> str:
    """Topic of images whose values say which peer covers a pixel."""
    return filled(MASKS, robot=robot)


def depths(robot: str) -> str:
    """Topic of images of the distance of peers' surfaces."""
    return filled(DEPTHS, robot=robot)


def labels(robot: str) -> str:
    """Topic of the labels of a robot's images."""
    return filled(LABELS, robot=robot)


def detections(robot: str) -> str:
    """Topic of what the network found in a robot's images."""
    return filled(DETECTIONS, robot=robot)


def grid(robot: str) -> str:
    """Topic of the network's output maps for a robot's images."""
    return filled(GRID, robot=robot)


def tracks(robot: str) -> str:
    """Topic of the peers that a robot's detections are followed as."""
    return filled(TRACKS, robot=robot)


def position(robot: str, peer: str) -> str:
    """Topic of where a robot estimates a peer to be."""
    return filled(POSITION, robot=robot, peer=peer)


def truth(robot: str, peer: str) -> str:
    """Topic of where a peer truly is, seen from a robot."""
    return filled(TRUTH, robot=robot, peer=peer)


def pose(robot: str) -> str:
    """Topic of where a robot estimates itself to be."""
    return filled(POSE, robot=robot)


def true_pose(robot: str) -> str:
    """Topic of where a robot truly is."""
    return filled(TRUE_POSE, robot=robot)


def log(robot: str, event: str) -> str:
    """Topic of a robot's log variables, as they were logged."""
    return filled(LOG, robot=robot, event=event)


@cache
def _expression(pattern: str) -> re.Pattern[str]:
    return re.compile(re.sub(r"\\{(\w+)\\}", r"(?P<\1>[^/]+)", re.escape(pattern)))


def names(pattern: str, topic: str) -> dict[str, str] | None:
    """What ``{robot}``, ``{peer}`` and ``{event}`` of a pattern are in a topic, or None.

    Examples
    --------
    >>> names(RANGE, "/cf1/range/cf2")
    {'robot': 'cf1', 'peer': 'cf2'}
    >>> names(RANGE, "/cf1/labels") is None
    True
    """
    match = _expression(pattern).fullmatch(topic)
    return match.groupdict() if match else None


@cache
def row_of(topic: str) -> Topic | None:
    """The table's row for a topic, or None for a topic that is not dmrl's."""
    return next((row for row in TOPICS if names(row.pattern, topic) is not None), None)


def robots(topics: list[str] | tuple[str, ...], pattern: str = CAMERA_IMAGE) -> list[str]:
    """Robots that have a topic of this pattern, sorted."""
    found = (names(pattern, topic) for topic in topics)
    return sorted({n["robot"] for n in found if n is not None})
