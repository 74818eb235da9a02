"""Base class of pilots, which map the sensor readings of a drone to a command.

A pilot of another package is a subclass of `Pilot` with an entry point in the group
``dmrl.pilots``. All vectors are in the robot's own horizontal frame: x forward, y left, z up.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from dmrl.geometry.frames import Array


class Command(NamedTuple):
    """Wanted velocity and yaw rate of a robot.

    Parameters
    ----------
    vx_mps, vy_mps, vz_mps
        Velocity in the robot's horizontal frame, metres per second.
    yaw_rate_radps
        Positive to the left.
    """

    vx_mps: float = 0.0
    vy_mps: float = 0.0
    vz_mps: float = 0.0
    yaw_rate_radps: float = 0.0


@dataclass(frozen=True, slots=True)
class PeerTrack:
    """A peer that the robot tracks, predicted to the present.

    Parameters
    ----------
    number
        Number of the track, constant during its life.
    peer
        Name of the peer; empty while it is unknown.
    position_m
        (3,) metres.
    velocity_mps
        (3,) velocity over ground along the axes of the robot's horizontal frame.
    covariance
        (3, 3) of the position now, m^2.
    age_s
        Seconds since the exposure of the last image in which the peer was detected.
    """

    number: int
    peer: str
    position_m: Array
    velocity_mps: Array
    covariance: Array
    age_s: float


@dataclass(frozen=True, slots=True)
class Observation:
    """Measurements of the sensors of a drone, and its tracks.

    Parameters
    ----------
    time_s
        Seconds since the start of the flight.
    roll_rad, pitch_rad, yaw_rate_radps
        Attitude and yaw rate.
    velocity_mps
        (2,) velocity from optical flow.
    height_m
        Above the floor.
    range_m
        Last UWB range to each peer, metres.
    tracks
        Peers that the camera tracks.
    image_age_s
        Seconds since the exposure of the last image that the tracks contain; infinite before it.
    detections
        u and v (pixels), depth (metres) and confidence of each detection in that image, best first.
    """

    time_s: float
    roll_rad: float
    pitch_rad: float
    yaw_rate_radps: float
    velocity_mps: Array
    height_m: float
    range_m: Mapping[str, float] = field(default_factory=dict)
    tracks: tuple[PeerTrack, ...] = ()
    image_age_s: float = float("inf")
    detections: tuple[tuple[float, float, float, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Task:
    """Task of a pilot.

    Parameters
    ----------
    robot, number
        Robot that it flies, and its number among the flown robots, from 0.
    leader
        Robot to follow; empty: there is none.
    distance_m
        Distance to keep.
    """

    robot: str
    number: int = 0
    leader: str = ""
    distance_m: float = 0.7


class Pilot(ABC):
    """Base class of pilots. A new object flies one robot for one flight.

    Parameters
    ----------
    task
        Task of the pilot.
    """

    def __init__(self, task: Task) -> None:
        self.task = task

    @abstractmethod
    def command(self, seen: Observation) -> Command:
        """Return the command that the robot flies until the next call, 0.05 s later."""
