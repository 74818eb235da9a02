"""``dmrl align``: robots that logged on clocks of their own, on one clock."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dmrl import topics
from dmrl.errors import RecordingError, SettingError
from dmrl.estimation.clocks import Clock, connected
from dmrl.formats.counters import dejitter
from dmrl.labelling.clocks import camera_clock, mocap_clocks, range_clocks, ranging
from dmrl.messages import message
from dmrl.output import refuse_existing
from dmrl.pipeline.folders import is_many, over_folder
from dmrl.recording import (
    Contents,
    RawMessage,
    RecordingWriter,
    copy_extras,
    parsed,
    provenance,
    read_raw,
    read_table,
    splits,
    summary,
)
from dmrl.terminal.arguments import Workers
from dmrl.terminal.progress import say, track
from dmrl.terminal.tables import print_json, print_table

METADATA = "dmrl.clocks"
MOCAP = "mocap"
"""Stands where a robot's name does."""
ALL = "*"
"""Stands for all of a recording, where all of it had to be moved."""
TELLING = (topics.ATTITUDE, topics.VELOCITY, topics.HEIGHT, topics.RANGE, topics.TRUE_POSE)
"""What clocks are told by, beside images and transforms."""
STAMPED = ("CompressedImage", "CameraCalibration", "PoseInFrame")


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
    later_ns = max(0, -_earliest_ns(held, clocks, steady))
    if later_ns:
        say(f"{recording}: all times are moved by {later_ns / 1e9:.9g} s, as one would be before 0")
        clocks[ALL] = Clock(later_ns * 1e-9, by="no time before 0")
    _write(held, out, clocks, steady, later_ns, settings)
    return clocks


def _earliest_ns(
    held: Contents,
    clocks: Mapping[str, Clock],
    steady: Mapping[str, Mapping[int, int]],
) -> int:
    """The first time of all messages, corrected: every robot's own first one counts."""
    found = []
    for topic in held.topics:
        if topic == topics.TRANSFORMS:  # whose they are stands inside
            raws = list(read_raw(held.path, topic))
            found += [raw.time_ns + _correction_ns(raw, raw.time_ns, clocks, held) for raw in raws]
            continue
        times = held.times(topic)
        if len(times):
            first = int(min(steady.get(topic, {}).values(), default=times.min()))
            clock = _clock_of(topic, topic.split("/")[1] if topic.count("/") > 1 else "", clocks)
            found.append(first + (_shift_ns(first, clock, held.start_ns) if clock else 0))
    return min(found, default=0)


def _robots(held: Contents, settings: Settings) -> dict[str, Clock]:
    """Of every robot that ranges or motion capture tie to the reference."""
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
    reference = settings.reference or min(robots - {MOCAP}, default="")
    if not robots:
        raise RecordingError(
            f"{held.path}: no robot ranged to another. --mocap and --cameras set clocks by other "
            "signals"
        )
    if reference not in robots:
        known = ", ".join(sorted(robots))
        raise SettingError(f"--reference {reference}: no such robot with ranges. Known: {known}")
    clocks = connected(pairs, reference)
    if len(clocks) == 1 and not (settings.cameras or settings.steady_cameras):
        raise RecordingError(
            f"{held.path}: no robot saw what {reference} saw, for 20 s at least. Ranges of both "
            "to each other are wanted, or motion capture (--mocap)"
        )
    for robot in sorted(robots - clocks.keys()):
        say(f"{held.path}: nothing ties the clock of {robot} to that of {reference}; it stays")
    return clocks


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


def _write(
    held: Contents,
    out: Path,
    clocks: dict[str, Clock],
    steady: dict[str, dict[int, int]],
    later_ns: int,
    settings: Settings,
) -> None:
    made = provenance("align", settings, [held.path], libraries=("numpy",))
    copied = track(read_raw(held.path), "Writing", held.summary.count)
    with RecordingWriter(out, made) as sink:
        copy_extras(held.summary, sink)
        told = {robot: json.dumps(_told(c, held.start_ns)) for robot, c in clocks.items()}
        sink.add_metadata(METADATA, told)
        for raw in copied:
            even_ns = steady.get(raw.topic, {}).get(raw.time_ns, raw.time_ns)
            shift_ns = later_ns + _correction_ns(raw, even_ns, clocks, held)
            times_ns = even_ns + shift_ns, max(raw.publish_ns + shift_ns, 0)
            sink.write_raw(_at(raw, *times_ns, held.path))


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


def _at(raw: RawMessage, time_ns: int, publish_ns: int, recording: Path) -> RawMessage:
    data = raw.data if time_ns == raw.time_ns else _stamped(raw, time_ns, recording)
    return replace(raw, time_ns=time_ns, publish_ns=publish_ns, data=data)


def _shift_ns(time_ns: int, clock: Clock, start_ns: int) -> int:
    """What a time lacks on the reference's clock. As a float it is exact enough: times are not."""
    elapsed_s = (time_ns - start_ns) * 1e-9
    return round((clock.offset_s + clock.drift * (elapsed_s - clock.at_s)) * 1e9)


def _correction_ns(
    raw: RawMessage,
    time_ns: int,
    clocks: Mapping[str, Clock],
    held: Contents,
) -> int:
    clock = _clock_of(raw.topic, _robot(raw, held.path), clocks)
    return _shift_ns(time_ns, clock, held.start_ns) if clock else 0


def _clock_of(topic: str, robot: str, clocks: Mapping[str, Clock]) -> Clock | None:
    """What corrects a message's times: its robot's clock, its camera's, or motion capture's."""
    if topic.startswith(f"/{robot}/camera/") and f"{robot}/camera" in clocks:
        return clocks[f"{robot}/camera"]
    if MOCAP in clocks and (topic == topics.TRANSFORMS or topic.endswith("/truth")):
        return clocks[MOCAP]
    return clocks.get(robot)


def _robot(raw: RawMessage, recording: Path) -> str:
    """Whose message it is; of transforms, whose the first frame is."""
    if raw.topic != topics.TRANSFORMS:
        return raw.topic.split("/")[1] if raw.topic.count("/") > 1 else ""
    frames = parsed(raw, message("FrameTransforms"), recording).transforms
    return str(frames[0].child_frame_id.split("/")[0]) if frames else ""


def _stamped(raw: RawMessage, time_ns: int, recording: Path) -> bytes:
    """The message with its own time set as well, where it has one."""
    name = raw.schema_name.removeprefix("foxglove.")
    if name not in (*STAMPED, "FrameTransforms"):
        return raw.data
    decoded = parsed(raw, message(name), recording)
    for part in decoded.transforms if name == "FrameTransforms" else [decoded]:
        part.timestamp.seconds, part.timestamp.nanos = divmod(time_ns, 1_000_000_000)
    return bytes(decoded.SerializeToString())


DEFAULTS = Settings()


def command(
    recording: Annotated[Path, Parameter(name="IN")],
    out: Path,
    /,
    *,
    settings: Annotated[Settings, Parameter(name="*")] = DEFAULTS,
    workers: Workers = None,
    as_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
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
    if is_many(recording):
        over_folder("align", recording, out, settings, workers=workers, as_json=as_json)
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
