"""Entities to log: rows in a frame, with their style.

An entity has the name of its topic. Frames are named as in the recording's /tf:
``world``, ``<robot>/horizontal``, ``<robot>/camera``, ``<robot>/optical``; ``<robot>/image`` is
the image plane, pixels, u right and v down.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import rerun as rr

WORLD_FRAME = "world"

# rerun treats a negative radius as points of the screen, equal at every zoom.
POINT_UI, FAINT_POINT_UI, LINE_UI = -4.0, -1.5, -1.0
INVISIBLE_RADIUS = 0.01

# Height and width of a text below a point, as shares of the image's width, in the smallest panel
# that a layout opens.
TEXT_HEIGHT, TEXT_WIDTH, DETECTION_TEXT_WIDTH = 1 / 12, 1 / 4, 3 / 10

ELLIPSE_SIGMAS = 2.0
"""Half axes of every ellipse and ellipsoid, in standard deviations."""


@dataclass(frozen=True, slots=True)
class Entity:
    """Some rows of one entity.

    Parameters
    ----------
    path
        Its path, a topic.
    columns
        One row per message; empty for a static entity.
    style
        Static components; logged once.
    frame
        Frame of its coordinates; None for entities without a position, such as a plot.
    """

    path: str
    columns: Iterable[rr.ComponentColumn] = ()
    style: tuple[rr.AsComponents, ...] = ()
    frame: str | None = None


def escape_path(path: str) -> str:
    """Convert a topic to an entity path of rerun; robots may have any name."""
    return rr.new_entity_path(path.strip("/").split("/"))


def image_frame(robot: str) -> str:
    """Return the frame of the image plane of a robot's camera."""
    return f"{robot}/image"


def horizontal_frame(robot: str) -> str:
    """Return the horizontal frame of a robot, which contains the positions of its peers."""
    return f"{robot}/horizontal"


def camera_frame(robot: str) -> str:
    """Return the frame of a robot's body and camera."""
    return f"{robot}/camera"


def optical_frame(robot: str) -> str:
    """Return the frame of a robot's lens: x right, y down, z forward."""
    return f"{robot}/optical"
