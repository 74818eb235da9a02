"""Show robots in rerun's viewer during a flight: images, heights, speeds, distances."""

import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Self

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from dmrl import topics
from dmrl.errors import SettingError
from dmrl.live.queue import ReceivedSample
from dmrl.samples.sample import Sample
from dmrl.viewer.drawing.entity import escape_path
from dmrl.viewer.layouts import BACKGROUND, TIMELINE, build_window
from dmrl.viewer.window.desktop import open_window

PLOT_INTERVAL_NS = 100_000_000
"""Interval between points of a curve: a shorter one is invisible and slows the recorder."""
HISTORY_S = 30.0
"""Length of the curves, seconds."""


def build_layout(robots: Sequence[str], cameras: Sequence[str]) -> rrb.Blueprint:
    """Build a layout with images on the left and curves of all robots on the right.

    Parameters
    ----------
    robots
        All robots.
    cameras
        Robots with a camera.
    """
    pictures = [
        rrb.Spatial2DView(
            origin=escape_path(topics.CAMERA_IMAGE(robot)), name=robot, background=BACKGROUND
        )
        for robot in cameras
    ]
    window = rrb.VisibleTimeRange(
        TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-HISTORY_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    contents: dict[str, list[str]] = {}
    for row in topics.SENSORS:
        if row.curve is not None:
            below = [row.pattern.format(robot=r, peer="*").split("/*")[0] for r in robots]
            contents.setdefault(row.curve.title, []).extend(f"{escape_path(b)}/**" for b in below)
    curves = [
        rrb.TimeSeriesView(name=title, contents=lines, time_ranges=window)
        for title, lines in contents.items()
    ]
    columns = [rrb.Vertical(*pictures), rrb.Vertical(*curves)] if pictures else curves
    return build_window(rrb.Horizontal(*columns), play="following")


class LiveView:
    """Log samples as they arrive.

    Parameters
    ----------
    stream
        Receives the samples.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._drawn_ns: dict[str, int] = {}
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)

    def show(self, received: ReceivedSample) -> None:
        """Log one sample, if its topic is drawn."""
        sample = received.sample
        if topics.parse_topic(topics.CAMERA_IMAGE, sample.topic):
            kind = sample.fields["format"]
            self._log_entity(
                sample, rr.EncodedImage(contents=sample.fields["data"], media_type=f"image/{kind}")
            )
            return
        row = topics.find_topic(sample.topic)
        late = sample.time_ns - self._drawn_ns.get(sample.topic, 0) >= PLOT_INTERVAL_NS
        if row is not None and row.curve is not None and late:
            self._drawn_ns[sample.topic] = sample.time_ns
            for path, fields in row.curve.list_lines(sample.topic).items():
                values = [float(sample.fields[field]) for field in fields]
                value = float(np.hypot.reduce(values)) if len(values) > 1 else values[0]
                self._log_entity(sample, rr.Scalars(value), path)

    def _log_entity(self, sample: Sample, drawn: rr.AsComponents, path: str = "") -> None:
        self._stream.set_time(TIMELINE, timestamp=np.datetime64(sample.time_ns, "ns"))
        self._stream.log(escape_path(path or sample.topic), drawn)


class LiveWindow:
    """A window of rerun's viewer that shows samples; open inside the block.

    Parameters
    ----------
    robots
        All robots.
    cameras
        Robots with a camera.
    headless
        Without a window, for tests.

    Raises
    ------
    SettingError
        If there is no screen for a window.
    """

    def __init__(
        self, robots: Sequence[str], cameras: Sequence[str], *, headless: bool = False
    ) -> None:
        self._layout, self._headless = build_layout(robots, cameras), headless
        self._process: subprocess.Popen[bytes] | None = None
        self.url = ""

    def __enter__(self) -> Self:
        self._process, self.url = open_window(headless=self._headless)
        time.sleep(1.0)
        if self._process.poll() is not None:
            raise SettingError("no screen for a window. Record without --view")
        self._stream = rr.RecordingStream("dmrl-live")
        self._stream.connect_grpc(self.url, default_blueprint=self._layout)
        self.show = LiveView(self._stream).show
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(RuntimeError):  # the user may have closed the window
            self._stream.flush(timeout_sec=2.0)
        self._stream.disconnect()
        if self._headless and self._process is not None:
            self._process.kill()
            self._process.wait()
