"""Clocks of a recording's robots and cameras, relative to one of them."""

from collections.abc import Mapping
from dataclasses import dataclass

from dmrl import topics
from dmrl.errors import RecordingError, SettingError
from dmrl.estimation.signals.clock_estimation import Clock, connect_clocks
from dmrl.formats.timestamps import dejitter
from dmrl.labelling.clocks import time_alignment
from dmrl.labelling.clocks.retiming import MOCAP, Corrected
from dmrl.labelling.flight_log import FlightLog, to_flight_log
from dmrl.recording import LoadedRecording, read_splits, read_table
from dmrl.recording.protobuf.arrow_arrays import to_numpy
from dmrl.terminal.progress import say

SIGNALS = (topics.ATTITUDE, topics.VELOCITY, topics.HEIGHT, topics.RANGE, topics.TRUE_POSE)
"""Topics that clocks are compared by, beside images and transforms."""


@dataclass(frozen=True, slots=True)
class Sources:
    """Signals that clocks are compared by.

    Parameters
    ----------
    reference
        The robot whose times stay, or mocap. None: the first by name.
    mocap
        Tie robots to motion capture.
    cameras
        Align each camera with its robot, by turns that both measure.
    steady_cameras
        Give images stamped on arrival the even times of a steady camera.
    """

    reference: str | None = None
    mocap: bool = False
    cameras: bool = False
    steady_cameras: bool = False


def align_clocks(held: LoadedRecording, wanted: Sources) -> tuple[dict[str, Clock], Corrected]:
    """Return the correction of every clock, and the recording with corrected times.

    Raises
    ------
    RecordingError
        If no two clocks can be tied to each other.
    SettingError
        If there is no such robot, or the recording has a split or labels, which are by time.
    """
    if read_splits(held.path, held.summary):
        raise SettingError(f"{held.path} has a split by time already. Align before that")
    names = [*SIGNALS, *([topics.TRANSFORMS] if wanted.mocap else [])]
    flight = to_flight_log(held, *names)
    steady = _even_times(held) if wanted.steady_cameras else {}
    clocks = {}
    if flight.ranges or wanted.mocap or not (wanted.cameras or wanted.steady_cameras):
        clocks = _robot_clocks(flight, wanted)
    if wanted.cameras:
        clocks |= _camera_clocks(flight, clocks, steady)
    return clocks, Corrected(held, dict(clocks), steady)


def _robot_clocks(held: FlightLog, wanted: Sources) -> dict[str, Clock]:
    """Return the clocks of all robots that ranges or motion capture tie to the reference."""
    pairs = time_alignment.estimate_range_clocks(held)
    robots = {name for link in held.ranges for name in link}
    if wanted.mocap:
        seen = time_alignment.estimate_mocap_clocks(held)
        if not seen:
            raise RecordingError(
                f"{held.path} has no poses of robots on /tf or /<robot>/pose/truth. "
                "Leave out --mocap"
            )
        pairs |= {(MOCAP, robot): clock for robot, clock in seen.items() if clock is not None}
        robots |= {MOCAP, *seen}
    reference = _choose_reference(held, robots, wanted)
    clocks = connect_clocks(pairs, reference)
    if len(clocks) == 1 and not (wanted.cameras or wanted.steady_cameras):
        raise RecordingError(
            f"{held.path}: no robot has 20 s of ranges or motion capture in common with "
            f"{reference}. Record ranges of both to each other, or pass --mocap"
        )
    for robot in sorted(robots - clocks.keys()):
        say(f"{held.path}: nothing ties the clock of {robot} to that of {reference}; it stays")
    return clocks


def _choose_reference(held: FlightLog, robots: set[str], wanted: Sources) -> str:
    """Return the robot whose times stay, or motion capture."""
    if not robots:
        raise RecordingError(
            f"{held.path}: no robot ranged to another. --mocap and --cameras set clocks by other "
            "signals"
        )
    reference = wanted.reference or min(robots - {MOCAP}, default="")
    if reference not in robots:
        known = ", ".join(sorted(robots))
        raise SettingError(f"--reference {reference}: no such robot with ranges. Known: {known}")
    return reference


def _camera_clocks(
    held: FlightLog, clocks: Mapping[str, Clock], steady: Mapping[str, Mapping[int, int]]
) -> dict[str, Clock]:
    """Return the clock of every camera whose images show the turns of its robot."""
    found = {}
    for topic, robot in _camera_topics(held).items():
        clock = time_alignment.estimate_camera_clock(held, robot, steady.get(topic, {}))
        if clock is None:
            say(
                f"{held.path}: images and attitude of {robot} show no common turn, for 20 s at "
                "least; its camera's times stay with the robot's"
            )
            continue
        found[f"{robot}/camera"] = clocks.get(robot, Clock(0.0)).compose_after(clock)
    if not found and len(clocks) < 2 and not steady:
        raise RecordingError(
            f"{held.path}: no camera saw its robot turn. Fly before a background with texture, "
            "and turn now and then"
        )
    return found


def _camera_topics(held: LoadedRecording | FlightLog) -> dict[str, str]:
    """Return the robot of every topic of images.

    Raises
    ------
    SettingError
        If images have labels, detections or tracks already, which refer to their times.
    """
    found = {
        t: n["robot"] for t in held.topics if (n := topics.parse_topic(topics.CAMERA_IMAGE, t))
    }
    for topic, robot in found.items():
        for made in (topics.LABELS, topics.DETECTIONS, topics.TRACKS):
            if made.format(robot=robot) in held.topics:
                what = made.rpartition("/")[2]
                raise SettingError(f"{held.path}: {topic} has {what} already. Align before that")
    return found


def _even_times(held: LoadedRecording) -> dict[str, dict[int, int]]:
    """Return even times by arrival times, for every topic of images stamped on arrival."""
    found = {}
    for topic in _camera_topics(held):
        table = read_table(held.path, topic, fields=[])
        arrival = to_numpy(table["log_time"])
        if (arrival == to_numpy(table["publish_time"])).all():
            found[topic] = dict(zip(arrival.tolist(), dejitter(arrival).tolist(), strict=True))
    return found


def describe_clock(clock: Clock, start_ns: int) -> dict[str, float | str]:
    """Return the correction of a clock as JSON values, its reference time as a log time."""
    return {
        "offset_s": clock.offset_s,
        "drift": clock.drift,
        "at_ns": start_ns + round(clock.at_s * 1e9),
        "sigma_s": clock.sigma_s,
        "sigma_drift": clock.sigma_drift,
        "correlation": clock.correlation,
        "by": clock.by,
    }
