"""``dmrl align``: robots that logged on clocks of their own, on one clock."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter
from numpy.typing import NDArray

from dmrl import topics
from dmrl.atomic_output import refuse_existing
from dmrl.errors import RecordingError, SettingError
from dmrl.estimation.signals.clock_alignment import Clock, connected
from dmrl.formats.timestamps import dejitter
from dmrl.labelling.retiming import MOCAP, Corrected
from dmrl.labelling.time_alignment import camera_clock, mocap_clocks, range_clocks, ranging
from dmrl.pipeline.batch import is_many, over_folder
from dmrl.recording import (
    Contents,
    RecordingWriter,
    copy_extras,
    provenance,
    read_table,
    splits,
    summary,
)
from dmrl.terminal.arguments import AsJson, Flat, In, On, Workers
from dmrl.terminal.progress import say
from dmrl.terminal.tables import print_json, print_table

METADATA = "dmrl.clocks"
ALL = "*"
"""Stands for all of a recording, where all of it had to be moved."""
TELLING = (topics.ATTITUDE, topics.VELOCITY, topics.HEIGHT, topics.RANGE, topics.TRUE_POSE)
"""What clocks are told by, beside images and transforms."""
LIBRARIES = ("numpy",)


Times = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Settings:
    """Whose clock the others are set by.

    Parameters
    ----------
    reference
        The robot whose times stay, or mocap. Without it, the first by name.
    mocap
        Poses on /tf and /<robot>/pose/truth have motion capture's clock: tie robots to it.
    cameras
        Cameras have clocks of their own: set each by the turns it and its robot both saw.
    steady_cameras
        Pictures that were stamped when they arrived get the even times of a steady camera.
    """

    reference: str | None = None
    mocap: Annotated[bool, Parameter(negative=())] = False
    cameras: Annotated[bool, Parameter(negative=())] = False
    steady_cameras: Annotated[bool, Parameter(negative=())] = False


def run(recording: Path, out: Path, settings: Settings) -> dict[str, Clock]:
    """Copy ``recording`` to ``out`` with the times of all robots on the clock of one.

    Parameters
    ----------
    recording
        With ranges of robots to each other, both ways, or what the settings name.
    out
        Recording to write. Must not exist.
    settings
        See `Settings`.

    Returns
    -------
    dict
        By robot, camera (``cf1/camera``) and ``mocap``, how its times were corrected; ``*``: by
        how much all times were moved besides, where one would be before 0.

    Raises
    ------
    RecordingError
        If the recording cannot be read, or no two clocks can be tied to each other.
    SettingError
        If there is no such robot, or the recording has a split or labels, which are by time.
    OutputError
        If ``out`` exists.
    """
    refuse_existing(out)
    held = Contents(recording, *TELLING)
    if splits(recording, held.summary):
        raise SettingError(f"{recording} has a split by time already. Align before that")
    steady = _steady(held) if settings.steady_cameras else {}
    clocks = {}
    if ranging(held) or settings.mocap or not (settings.cameras or settings.steady_cameras):
        clocks = _robots(held, settings)
    if settings.cameras:
        clocks |= _cameras(held, clocks, steady)
    corrected = Corrected(held, dict(clocks), steady)
    later_ns = max(0, -corrected.earliest_ns())
    if later_ns:
        say(f"{recording}: all times are moved by {later_ns / 1e9:.9g} s, as one would be before 0")
        clocks[ALL] = Clock(later_ns * 1e-9, by="no time before 0")
    with RecordingWriter(
        out, provenance("align", settings, [recording], libraries=LIBRARIES)
    ) as sink:
        copy_extras(held.summary, sink)
        told = {robot: json.dumps(_told(c, held.start_ns)) for robot, c in clocks.items()}
        sink.add_metadata(METADATA, told)
        replace(corrected, later_ns=later_ns).write(sink)
    return clocks


def _robots(held: Contents, settings: Settings) -> dict[str, Clock]:
    """Clocks of every robot that ranges or motion capture tie to the reference."""
    pairs = range_clocks(held)
    robots = {name for link in ranging(held) for name in link}
    if settings.mocap:
        seen = mocap_clocks(held)
        if not seen:
            raise RecordingError(
                f"{held.path} has no poses of robots on /tf or /<robot>/pose/truth. "
                "Leave out --mocap"
            )
        pairs |= {(MOCAP, robot): clock for robot, clock in seen.items() if clock is not None}
        robots |= {MOCAP, *seen}
    reference = _reference(held, robots, settings)
    clocks = connected(pairs, reference)
    if len(clocks) == 1 and not (settings.cameras or settings.steady_cameras):
        raise RecordingError(
            f"{held.path}: no robot saw what {reference} saw, for 20 s at least. Ranges of both "
            "to each other are wanted, or motion capture (--mocap)"
        )
    for robot in sorted(robots - clocks.keys()):
        say(f"{held.path}: nothing ties the clock of {robot} to that of {reference}; it stays")
    return clocks


def _reference(held: Contents, robots: set[str], settings: Settings) -> str:
    """The robot whose times stay, or motion capture."""
    if not robots:
        raise RecordingError(
            f"{held.path}: no robot ranged to another. --mocap and --cameras set clocks by other "
            "signals"
        )
    reference = settings.reference or min(robots - {MOCAP}, default="")
    if reference not in robots:
        known = ", ".join(sorted(robots))
        raise SettingError(f"--reference {reference}: no such robot with ranges. Known: {known}")
    return reference


def _cameras(
    held: Contents,
    clocks: Mapping[str, Clock],
    steady: Mapping[str, Mapping[int, int]],
) -> dict[str, Clock]:
    """Of every camera whose images show the turns of its robot."""
    found = {}
    for topic, robot in _pictured(held).items():
        clock = camera_clock(held, robot, steady.get(topic, {}))
        if clock is None:
            say(
                f"{held.path}: images and attitude of {robot} show no common turn, for 20 s at "
                "least; its camera's times stay with the robot's"
            )
            continue
        found[f"{robot}/camera"] = clocks.get(robot, Clock(0.0)).after(clock)
    if not found and len(clocks) < 2 and not steady:
        raise RecordingError(
            f"{held.path}: no camera saw its robot turn. Fly before a background with texture, "
            "and turn now and then"
        )
    return found


def _pictured(held: Contents) -> dict[str, str]:
    """Robot by topic of images; none may have results that know their times."""
    found = {t: n["robot"] for t in held.topics if (n := topics.names(topics.CAMERA_IMAGE, t))}
    for topic, robot in found.items():
        for made in (topics.LABELS, topics.DETECTIONS, topics.TRACKS):
            if made.format(robot=robot) in held.topics:
                what = made.rpartition("/")[2]
                raise SettingError(f"{held.path}: {topic} has {what} already. Align before that")
    return found


def _steady(held: Contents) -> dict[str, dict[int, int]]:
    """New times by old ones of every topic of pictures that were stamped when they arrived."""
    found = {}
    for topic in _pictured(held):
        table = read_table(held.path, topic, fields=[])
        arrival = table["log_time"].to_numpy()
        if (arrival == table["publish_time"].to_numpy()).all():
            found[topic] = dict(zip(arrival.tolist(), dejitter(arrival).tolist(), strict=True))
    return found


def _told(clock: Clock, start_ns: int) -> dict[str, float | str]:
    return {
        "offset_s": clock.offset_s,
        "drift": clock.drift,
        "at_ns": start_ns + round(clock.at_s * 1e9),
        "sigma_s": clock.sigma_s,
        "sigma_drift": clock.sigma_drift,
        "correlation": clock.correlation,
        "by": clock.by,
    }


DEFAULTS = Settings()


def command(
    recording: In,
    out: Path,
    /,
    *,
    settings: Flat[Settings] = DEFAULTS,
    workers: Workers = None,
    on: On = None,
    as_json: AsJson = False,
) -> None:
    """Set clocks by each other: from ranges of pairs, images, or motion capture.

    Parameters
    ----------
    recording
        Recording of robots with clocks of their own, such as micro-SD logs; or a folder of them.
    out
        Recording to write: all of IN, on one clock. Must not exist. For a folder: the folder of
        what is made, under the same names.
    workers
        Of a folder: recordings at a time, at most. Without it, as many as there are cores.
        Changes no byte.
    as_json
        Print one JSON document in place of the table.
    """
    if is_many(recording) or on is not None:
        over_folder("align", recording, out, settings, workers=workers, on=on, as_json=as_json)
        return
    clocks = run(recording, out, settings)
    if as_json:
        start_ns = summary(recording).start_ns
        told = {robot: _told(clock, start_ns) for robot, clock in clocks.items()}
        print_json({"recording": str(out), "clocks": told})
        return
    rows = [
        (
            robot,
            f"{c.offset_s * 1e3:.3f}",
            f"{c.drift * 1e6:.3f}",
            f"{c.sigma_s * 1e3:.3f}",
            f"{c.sigma_drift * 1e6:.3f}",
            f"{c.correlation:.3f}",
            c.by,
        )
        for robot, c in sorted(clocks.items())
    ]
    head = ("clock", "offset, ms", "drift, ppm", "sigma, ms", "sigma, ppm", "correlation", "by")
    print_table(str(out), head, rows)
