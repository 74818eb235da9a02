"""``dmrl align``: robots that logged on clocks of their own, on one clock."""

import json
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from dmrl import topics
from dmrl.errors import RecordingError, SettingError
from dmrl.estimation.clocks import Array, Clock, connected
from dmrl.estimation.exchanges import estimate_from_exchanges
from dmrl.formats.counters import dejitter
from dmrl.messages import message
from dmrl.output import refuse_existing
from dmrl.progress import say, track
from dmrl.recording import (
    RawMessage,
    RecordingWriter,
    Summary,
    copy_extras,
    provenance,
    read_raw,
    read_table,
    splits,
    summary,
)
from dmrl.tables import print_json, print_table

METADATA = "dmrl.clocks"
STAMPED = ("CompressedImage", "CameraCalibration", "PoseInFrame")


@dataclass(frozen=True, slots=True)
class Settings:
    """Whose clock the others are set by.

    Parameters
    ----------
    reference
        The robot whose times stay. Without it, the first by name.
    steady_cameras
        Pictures that were stamped when they arrived get the even times of a steady camera.
    """

    reference: str | None = None
    steady_cameras: Annotated[bool, Parameter(negative=())] = False


def run(recording: Path, out: Path, settings: Settings) -> dict[str, Clock]:
    """Copy ``recording`` to ``out`` with the times of all robots on the clock of one.

    Parameters
    ----------
    recording
        With ranges of robots to each other, both ways.
    out
        Recording to write. Must not exist.
    settings
        See `Settings`.

    Returns
    -------
    dict
        By robot, how its times were corrected.

    Raises
    ------
    RecordingError
        If the recording cannot be read, or no two robots ranged to each other.
    SettingError
        If there is no such robot, or the recording has a split, which is by time.
    OutputError
        If ``out`` exists.
    """
    refuse_existing(out)
    held = summary(recording)
    if splits(held):
        raise SettingError(f"{recording} has a split by time already. Align before that")
    steady = _steady(recording, held) if settings.steady_cameras else {}
    clocks = {} if steady and not _links(held) else _clocks(recording, held, settings)
    _write(recording, held, out, clocks, steady, settings)
    return clocks


def _links(held: Summary) -> set[tuple[str, str]]:
    return {(n["robot"], n["peer"]) for t in held.topics if (n := topics.names(topics.RANGE, t))}


def _clocks(recording: Path, held: Summary, settings: Settings) -> dict[str, Clock]:
    """Of every robot that ranges tie to the reference."""
    links = _links(held)
    robots = sorted({name for link in links for name in link})
    reference = settings.reference or (robots[0] if robots else "")
    if reference not in robots:
        known = ", ".join(robots) or "none"
        raise SettingError(f"--reference {reference}: no such robot with ranges. Known: {known}")
    pairs = {}
    for one, other in combinations(robots, 2):
        if (one, other) in links and (other, one) in links:
            clock = _clock(recording, held, one, other)
            if clock is not None:
                pairs[one, other] = clock
    clocks = connected(pairs, reference)
    if len(clocks) == 1:
        raise RecordingError(
            f"{recording}: no robot saw what {reference} saw, for 20 s at least. Ranges of both "
            "to each other are wanted"
        )
    for robot in robots:
        if robot not in clocks:
            say(f"{recording}: nothing ties the clock of {robot} to that of {reference}; it stays")
    return clocks


def _steady(recording: Path, held: Summary) -> dict[str, dict[int, int]]:
    """New times by old ones of every topic of pictures that were stamped when they arrived."""
    found = {}
    for topic in held.topics:
        parts = topics.names(topics.CAMERA_IMAGE, topic)
        if parts is None:
            continue
        if topics.labels(parts["robot"]) in held.topics:
            raise SettingError(f"{recording}: {topic} has labels already. Align before that")
        table = read_table(recording, topic, fields=[])
        arrival = table["log_time"].to_numpy()
        if (arrival == table["publish_time"].to_numpy()).all():
            found[topic] = dict(zip(arrival.tolist(), dejitter(arrival).tolist(), strict=True))
    return found


def _clock(recording: Path, held: Summary, one: str, other: str) -> Clock | None:
    here = _ranges(recording, held, topics.uwb_range(one, other))
    there = _ranges(recording, held, topics.uwb_range(other, one))
    return estimate_from_exchanges(*here, *there)


def _ranges(recording: Path, held: Summary, topic: str) -> tuple[Array, Array]:
    table = read_table(recording, topic, fields=["range_m"])
    time_s = (table["log_time"].to_numpy() - held.start_ns) * 1e-9
    values = table["range_m"].to_numpy()
    good = np.isfinite(values) & np.concatenate([[True], np.diff(time_s) > 0])[: len(values)]
    return time_s[good], values[good]


def _write(
    recording: Path,
    held: Summary,
    out: Path,
    clocks: dict[str, Clock],
    steady: dict[str, dict[int, int]],
    settings: Settings,
) -> None:
    made = provenance("align", settings, [recording], libraries=("numpy",))
    # Robots that were switched on earlier would begin before 0: all times move together.
    starts = [held.start_ns] + [
        held.start_ns + _shift_ns(held.start_ns, c, held.start_ns) for c in clocks.values()
    ]
    later_ns = max(0, -min(starts))
    copied = track(read_raw(recording), "Writing", held.count)
    with RecordingWriter(out, made) as sink:
        copy_extras(held, sink)
        told = {robot: json.dumps(_told(c, held.start_ns)) for robot, c in clocks.items()}
        sink.add_metadata(METADATA, told)
        for raw in copied:
            even_ns = steady.get(raw.topic, {}).get(raw.time_ns, raw.time_ns)
            clock = clocks.get(_robot(raw))
            shift_ns = later_ns + (_shift_ns(even_ns, clock, held.start_ns) if clock else 0)
            sink.write_raw(_at(raw, even_ns + shift_ns, max(raw.publish_ns + shift_ns, 0)))


def _told(clock: Clock, start_ns: int) -> dict[str, float]:
    return {
        "offset_s": clock.offset_s,
        "drift": clock.drift,
        "at_ns": start_ns + round(clock.at_s * 1e9),
        "sigma_s": clock.sigma_s,
        "sigma_drift": clock.sigma_drift,
        "correlation": clock.correlation,
    }


def _at(raw: RawMessage, time_ns: int, publish_ns: int) -> RawMessage:
    data = raw.data if time_ns == raw.time_ns else _stamped(raw, time_ns)
    return replace(raw, time_ns=time_ns, publish_ns=publish_ns, data=data)


def _shift_ns(time_ns: int, clock: Clock, start_ns: int) -> int:
    """What a time lacks on the reference's clock. As a float it is exact enough: times are not."""
    elapsed_s = (time_ns - start_ns) * 1e-9
    return round((clock.offset_s + clock.drift * (elapsed_s - clock.at_s)) * 1e9)


def _robot(raw: RawMessage) -> str:
    """Whose message it is; of transforms, whose the first frame is."""
    if raw.topic != topics.TRANSFORMS:
        return raw.topic.split("/")[1] if raw.topic.count("/") > 1 else ""
    frames = message("FrameTransforms").FromString(raw.data).transforms
    return str(frames[0].child_frame_id.split("/")[0]) if frames else ""


def _stamped(raw: RawMessage, time_ns: int) -> bytes:
    """The message with its own time set as well, where it has one."""
    name = raw.schema_name.removeprefix("foxglove.")
    if name not in (*STAMPED, "FrameTransforms"):
        return raw.data
    decoded = message(name).FromString(raw.data)
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
    as_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> None:
    """Set the clocks of robots by each other, from the ranges that both of a pair logged.

    Parameters
    ----------
    recording
        Recording of robots with clocks of their own, such as micro-SD logs.
    out
        Recording to write: all of IN, on one clock. Must not exist.
    as_json
        Print one JSON document in place of the table.
    """
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
        )
        for robot, c in sorted(clocks.items())
    ]
    head = ("robot", "offset, ms", "drift, ppm", "sigma, ms", "sigma, ppm", "correlation")
    print_table(str(out), head, rows)
