"""What is logged: rows of an entity, in a frame, with their style.

Entities are named as the topics they come from. Frames are named as in the recording's /tf:
``world``, ``<robot>/horizontal``, ``<robot>/camera``, ``<robot>/optical``; ``<robot>/image`` is
the image plane, pixels, u right and v down.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import rerun as rr

WORLD = "world"

# rerun takes a negative radius in points of the screen: the same at every zoom.
POINT_UI, FAINT_POINT_UI, LINE_UI = -4.0, -1.5, -1.0
INVISIBLE = 0.01

# rerun writes below a point. In the smallest panel that a layout opens with, a text is as high and
# as wide as these shares of an image's width.
TEXT_HEIGHT, TEXT_WIDTH, DETECTION_TEXT_WIDTH = 1 / 12, 1 / 4, 3 / 10

ELLIPSE_SIGMAS = 2.0
"""Half axes of every ellipse and ellipsoid, in standard deviations."""


@dataclass(frozen=True, slots=True)
class Entity:
    """Some rows of one entity.

    Parameters
    ----------
    path
        Where it stands, as a topic.
    columns
        One row per message; none for what does not move.
    style
        What never changes; logged once.
    frame
        Frame its coordinates are in; None for what has no place, such as a plot.
    """

    path: str
    columns: Iterable[rr.ComponentColumn] = ()
    style: tuple[rr.AsComponents, ...] = ()
    frame: str | None = None


def escaped(path: str) -> str:
    """A topic as rerun writes an entity's path; robots may have any name."""
    return rr.new_entity_path(path.strip("/").split("/"))


def image_frame(robot: str) -> str:
    """Frame of what lies in the image plane of a robot's camera."""
    return f"{robot}/image"


def horizontal_frame(robot: str) -> str:
    """Frame of what a robot sees around it."""
    return f"{robot}/horizontal"


def camera_frame(robot: str) -> str:
    """Frame of a robot's body and camera."""
    return f"{robot}/camera"


def optical_frame(robot: str) -> str:
    """Frame of a robot's lens: x right, y down, z forward."""
    return f"{robot}/optical"
