"""A session with live robots and cameras, written as it comes."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from dmrl.atomic_output import refuse_existing, to_partial_path
from dmrl.errors import OutputError, RecordingError
from dmrl.images.bayer import load_opencv
from dmrl.ingest.settings import RecordSettings
from dmrl.live.camera_link import CameraClient
from dmrl.live.cflib_session import load_cflib
from dmrl.live.crazyflie_link import CrazyflieLink
from dmrl.live.links import build_cameras, build_links, check_robots, describe_no_data
from dmrl.live.queue import LinkStatus, ReceivedSample, SampleQueue
from dmrl.live.receive_clocks import HostClock
from dmrl.live.robot_options import RobotOptions
from dmrl.live.status_table import StatusTable
from dmrl.live.threads import stop_all
from dmrl.recording import RecordingWriter, build_provenance
from dmrl.terminal.progress import say
from dmrl.terminal.signals import set_on_signal

FLUSH_S = 1.0
"""Time between flushes, seconds: a killed process loses no more."""
POLL_S = 0.1
"""Longest wait for samples, seconds."""


@dataclass(frozen=True, slots=True)
class Result:
    """Messages by topic, and the health of every link and camera."""

    messages: dict[str, int]
    healths: list[LinkStatus]
    cpu_share: float
    """Processor time per time of the clock; 1 is one core."""


def record_session(
    out: Path,
    robots: Sequence[RobotOptions],
    settings: RecordSettings,
    *,
    ended: threading.Event | None = None,
    show: Callable[[ReceivedSample], None] | None = None,
) -> Result:
    """Record until the time is over, or Ctrl-C.

    Parameters
    ----------
    out
        Recording to write. Must not exist.
    robots
        Who is recorded.
    settings
        See `RecordSettings`.
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
    check_robots(robots)
    feed, now = SampleQueue(), HostClock()
    links = build_links(robots, settings.peer, settings.rate_hz, feed, now)
    clients = build_cameras(robots, links, (settings.pixels, settings.images), feed, now)
    threads: list[CrazyflieLink | CameraClient] = [*links.values(), *clients]
    table = StatusTable(list(links.values()), [client.health for client in clients])
    made = build_provenance("record", _describe(robots, settings), libraries=("cflib", "numpy"))
    began_s, used_s = time.monotonic(), time.process_time()
    # What was received stays even if this process fails: flights are not repeated.
    with _name_unfinished(out), RecordingWriter(out, made, keep_on_error=True) as sink:
        ended = threading.Event() if ended is None else ended
        counts = _write_samples(sink, feed, table, threads, (settings.duration_s, ended), show)
    if not counts:
        out.unlink()
        raise RecordingError(describe_no_data(out, [*links.values()]))
    passed_s = max(time.monotonic() - began_s, 1e-9)
    healths = [thread.health for thread in threads]
    return Result(counts, healths, (time.process_time() - used_s) / passed_s)


@contextmanager
def _name_unfinished(out: Path) -> Iterator[None]:
    """Print the name of the file that holds the flight if the block fails."""
    try:
        yield
    except BaseException:
        unfinished = to_partial_path(out)
        if unfinished.exists():
            say(
                f"{unfinished} holds the flight until then. Bring it back with: dmrl recover "
                f"{unfinished} OTHER.mcap"
            )
        raise


def _refuse_unfinished(out: Path) -> None:
    unfinished = to_partial_path(out)
    if unfinished.exists():
        raise OutputError(
            f"{unfinished} is of a session that was cut off. Bring it back with dmrl recover "
            f"{unfinished} OTHER.mcap, or remove it"
        )


def _describe(robots: Sequence[RobotOptions], settings: RecordSettings) -> dict[str, Any]:
    """Return the settings and addresses that the provenance lists."""
    cameras = ["" if r.camera is None else f"{r.camera[0]}:{r.camera[1]}" for r in robots]
    addresses = {"robots": [r.name for r in robots], "uris": [r.uri for r in robots]}
    told = {key: value for key, value in asdict(settings).items() if key != "duration_s"}
    return addresses | {"cameras": cameras} | told


def _write_samples(
    sink: RecordingWriter,
    feed: SampleQueue,
    table: StatusTable,
    threads: Sequence[CrazyflieLink | CameraClient],
    until: tuple[float | None, threading.Event],
    show: Callable[[ReceivedSample], None] | None,
) -> dict[str, int]:
    """Write samples until the end; return the number of messages by topic."""
    duration_s, ended = until
    counts: Counter[str] = Counter()

    def take(timeout_s: float) -> bool:
        """Write samples and print texts that have come; return whether there were any."""
        taken = feed.get_batch(timeout_s)
        for item in taken:
            if isinstance(item, str):
                table.print_message(item)
                continue
            _write_sample(sink, item)
            counts[item.sample.topic] += 1
            if show is not None:
                show(item)
        return bool(taken)

    with ExitStack() as running:
        running.enter_context(table)
        running.callback(stop_all, threads)
        for thread in threads:
            thread.start()
        running.enter_context(set_on_signal(ended))
        _poll_until(duration_s, ended, take, lambda: _flush_and_show(sink, table, counts))
    while take(0.0):
        pass
    return dict(sorted(counts.items()))


def _write_sample(sink: RecordingWriter, item: ReceivedSample) -> None:
    """Write a sample at its own time, with the time of its arrival."""
    sink.write_sample(replace(item.sample, publish_ns=item.arrival_ns))


def _poll_until(
    duration_s: float | None,
    ended: threading.Event,
    take: Callable[[float], bool],
    each: Callable[[], None],
) -> None:
    began_s = flushed_s = time.monotonic()
    while not ended.is_set() and (duration_s is None or time.monotonic() - began_s < duration_s):
        take(POLL_S)
        if time.monotonic() - flushed_s >= FLUSH_S:
            flushed_s = time.monotonic()
            each()


def _flush_and_show(sink: RecordingWriter, table: StatusTable, counts: Mapping[str, int]) -> None:
    sink.flush()
    table.update(sum(counts.values()))
