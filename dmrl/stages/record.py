"""``dmrl record``: what robots in flight send, as a recording."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter, validators

from dmrl.atomic_output import partial_of, refuse_existing
from dmrl.errors import OutputError, RecordingError
from dmrl.images.bayer import load_opencv
from dmrl.live.camera_link import CameraClient
from dmrl.live.cflib_session import load_cflib
from dmrl.live.crazyflie_link import Link
from dmrl.live.image_assembly import Colours, Stored
from dmrl.live.links import cameras_of, check, end_all, links_of, nothing_came
from dmrl.live.queue import Feed, Health, Received
from dmrl.live.receive_clocks import HostTime
from dmrl.live.robot_options import Robot, robot_of
from dmrl.live.status_table import LiveTable
from dmrl.messages import message
from dmrl.recording import RecordingWriter, provenance
from dmrl.terminal.arguments import AsJson, Flat
from dmrl.terminal.signals import ended_by_signal
from dmrl.terminal.tables import print_json, print_table

FLUSH_S = 1.0
"""What a killed process loses at most."""
TAKE_S = 0.1


@dataclass(frozen=True, slots=True)
class Settings:
    """What is asked of the robots, and for how long.

    Parameters
    ----------
    duration_s
        Stop after so many seconds. Without it, at Ctrl-C.
    rate_hz
        Log packets per second and block; the firmware has 10 ms steps.
    pixels
        Whether raw images are behind colour filters: colour, or grey for the grey AI-deck.
    images
        How images are stored that are not JPEG already: png, nothing lost, or jpeg, a fifth
        of that.
    peer
        Whose distance ranging.distance<N> is, as N=NAME; repeat for more. Without it, robot
        cf<N>'s.
    """

    duration_s: Annotated[float | None, Parameter(validator=validators.Number(gt=0, lt=1e6))] = None
    rate_hz: Annotated[float, Parameter(validator=validators.Number(gte=1, lte=100))] = 100.0
    pixels: Colours = "colour"
    images: Stored = "png"
    peer: Annotated[tuple[str, ...], Parameter(negative=())] = field(default=())


@dataclass(frozen=True, slots=True)
class Result:
    """What was recorded: messages by topic, and how every link and camera did."""

    messages: dict[str, int]
    healths: list[Health]
    cpu_share: float
    """Processor time per time of the clock; 1 is one core."""


def run(
    out: Path,
    robots: Sequence[Robot],
    settings: Settings,
    *,
    ended: threading.Event | None = None,
    show: Callable[[Received], None] | None = None,
) -> Result:
    """Record until the time is over, or Ctrl-C.

    Parameters
    ----------
    out
        Recording to write. Must not exist.
    robots
        Who is recorded.
    settings
        See `Settings`.
    ended
        Ends it as well when it is set.
    show
        Is given every sample as it comes.

    Raises
    ------
    SettingError
        If two robots have one name, or an address cannot be one.
    RecordingError
        If nothing came from any robot.
    OutputError
        If ``out`` exists or cannot be written.
    MissingExtra
        If cflib is not installed, or OpenCV, which colours are made with.
    """
    refuse_existing(out)
    _refuse_unfinished(out)
    load_cflib()
    if settings.pixels == "colour" and any(robot.camera for robot in robots):
        load_opencv("record", "the colours of a camera")
    check(robots)
    feed, now = Feed(), HostTime()
    links = links_of(robots, settings.peer, settings.rate_hz, feed, now)
    clients = cameras_of(robots, links, (settings.pixels, settings.images), feed, now)
    threads: list[Link | CameraClient] = [*links.values(), *clients]
    table = LiveTable(list(links.values()), [client.health for client in clients])
    made = provenance("record", _as_settings(robots, settings), libraries=("cflib", "numpy"))
    began_s, used_s = time.monotonic(), time.process_time()
    # What was received stays even if this process fails: flights are not repeated.
    with RecordingWriter(out, made, keep_on_error=True) as sink:
        ended = threading.Event() if ended is None else ended
        counts = _record(sink, feed, table, threads, (settings.duration_s, ended), show)
    if not counts:
        out.unlink()
        raise RecordingError(nothing_came(out, [*links.values()]))
    passed_s = max(time.monotonic() - began_s, 1e-9)
    healths = [thread.health for thread in threads]
    return Result(counts, healths, (time.process_time() - used_s) / passed_s)


def _refuse_unfinished(out: Path) -> None:
    unfinished = partial_of(out)
    if unfinished.exists():
        raise OutputError(
            f"{unfinished} is of a session that was cut off. Bring it back with dmrl recover "
            f"{unfinished} OTHER.mcap, or remove it"
        )


def _as_settings(robots: Sequence[Robot], settings: Settings) -> "_Recorded":
    return _Recorded(
        tuple(r.name for r in robots),
        tuple(r.uri for r in robots),
        tuple("" if r.camera is None else f"{r.camera[0]}:{r.camera[1]}" for r in robots),
        settings.rate_hz,
        settings.pixels,
        settings.images,
        settings.peer,
    )


@dataclass(frozen=True, slots=True)
class _Recorded:
    """What the recording says of how it was made."""

    robots: tuple[str, ...]
    uris: tuple[str, ...]
    cameras: tuple[str, ...]
    rate_hz: float
    pixels: str
    images: str
    peer: tuple[str, ...]


def _record(
    sink: RecordingWriter,
    feed: Feed,
    table: LiveTable,
    threads: Sequence[Link | CameraClient],
    until: tuple[float | None, threading.Event],
    show: Callable[[Received], None] | None,
) -> dict[str, int]:
    """Write what comes until the end; messages by topic."""
    duration_s, ended = until
    counts: Counter[str] = Counter()

    def take(timeout_s: float) -> bool:
        """Write what has come, and say what was said; whether there was anything."""
        taken = feed.take(timeout_s)
        for item in taken:
            if isinstance(item, str):
                table.say(item)
                continue
            _write(sink, item)
            counts[item.sample.topic] += 1
            if show is not None:
                show(item)
        return bool(taken)

    with ExitStack() as running:
        running.enter_context(table)
        running.callback(end_all, threads)
        for thread in threads:
            thread.start()
        running.enter_context(ended_by_signal(ended))
        _until(duration_s, ended, take, lambda: _every_second(sink, table, counts))
    while take(0.0):
        pass
    return dict(sorted(counts.items()))


def _write(sink: RecordingWriter, item: Received) -> None:
    """A sample at its own time; the time of its arrival is kept beside it."""
    sample = item.sample
    made = message(sample.message)(**sample.fields)
    sink.write(sample.time_ns, sample.topic, made, publish_ns=item.arrival_ns)


def _until(
    duration_s: float | None,
    ended: threading.Event,
    take: Callable[[float], bool],
    each: Callable[[], None],
) -> None:
    began_s = flushed_s = time.monotonic()
    while not ended.is_set() and (duration_s is None or time.monotonic() - began_s < duration_s):
        take(TAKE_S)
        if time.monotonic() - flushed_s >= FLUSH_S:
            flushed_s = time.monotonic()
            each()


def _every_second(sink: RecordingWriter, table: LiveTable, counts: Mapping[str, int]) -> None:
    sink.flush()
    table.update(sum(counts.values()))


DEFAULTS = Settings()


def command(
    out: Path,
    /,
    *,
    robot: Annotated[list[str], Parameter(negative=())],
    settings: Flat[Settings] = DEFAULTS,
    view: Annotated[bool, Parameter(negative=())] = False,
    as_json: AsJson = False,
) -> None:
    """Record the logs and cameras of Crazyflies in flight, until Ctrl-C.

    Parameters
    ----------
    out
        Recording to write. Must not exist. While it runs it is OUT.partial.
    robot
        NAME=URI[,camera=HOST:PORT][,calibration=FILE.toml]; repeat for more robots.
    view
        Show it in rerun as it comes.
    as_json
        Print one JSON document in place of the tables.
    """
    robots = [robot_of(text) for text in robot]
    with ExitStack() as window:
        show = None
        if view:
            from dmrl.viewer.window.live_view import LiveWindow  # noqa: PLC0415 - an extra

            cameras = [r.name for r in robots if r.camera]
            show = window.enter_context(LiveWindow([r.name for r in robots], cameras)).show
        result = run(out, robots, settings, show=show)
    rows = [(h.source, h.received, h.lost, h.broken, h.connections) for h in result.healths]
    if as_json:
        links = [dict(zip(COLUMNS, row, strict=True)) for row in rows]
        document = {"recording": str(out), "messages": result.messages, "links": links}
        print_json({**document, "cpu_share": round(result.cpu_share, 4)})
        return
    print_table(str(out), ("topic", "messages"), list(result.messages.items()))
    print_table("", COLUMNS, rows)


COLUMNS = ("from", "received", "lost", "broken", "connections")
