"""Entities to log with their timeline and layout, and the stream that logs them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from dmrl.viewer.content.robot_motion import Times
from dmrl.viewer.drawing.entity import Entity, escape_path

TimedEntity = tuple[rr.TimeColumn | None, Entity]


@dataclass(frozen=True, slots=True)
class Show:
    """Input of a viewer.

    Parameters
    ----------
    title
        Name of the recording.
    blueprint
        Its layout.
    logged
        Yields rows with their times, in display order; time None: static.
    images
        Number of images.
    cursor
        Timeline and position on it, for a screenshot.
    moment
        The same position in words.
    """

    title: str
    blueprint: rrb.Blueprint
    logged: Callable[[], Iterator[TimedEntity]]
    images: int
    cursor: tuple[str, np.generic | int]
    moment: str


@dataclass(slots=True)
class EntityLogger:
    """Log entities to a stream, the style of each once."""

    stream: rr.RecordingStream
    styled: set[str] = field(default_factory=set)

    def log_entity(self, times: rr.TimeColumn | None, entity: Entity) -> None:
        """Log some rows, or a static entity."""
        path = escape_path(entity.path)
        if times is None or entity.path not in self.styled:
            self.styled.add(entity.path)
            for part in entity.style:
                self.stream.log(path, part, static=True)
            if entity.frame is not None:
                self.stream.log(path, rr.CoordinateFrame(entity.frame), static=True)
        if times is not None:
            self.stream.send_columns(path, [times], entity.columns)


def open_stream() -> rr.RecordingStream:
    """Open a stream without a sink. From then on, misuse of rerun raises an error."""
    # The default logs a warning and continues.
    rr.set_strict_mode(True)
    stream = rr.RecordingStream("dmrl")
    # rerun's own log_time is the time of the call.
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    return stream


def build_time_column(timeline: str, time_ns: Times, start_ns: int | None) -> rr.TimeColumn:
    """Convert log times to seconds from a start, as in ``--time``; without a start, to dates."""
    if start_ns is None:
        return rr.TimeColumn(timeline, timestamp=time_ns.astype("datetime64[ns]"))
    return rr.TimeColumn(timeline, duration=(time_ns - start_ns).astype("timedelta64[ns]"))


def build_cursor(timeline: str, time_ns: int, start_ns: int | None) -> tuple[str, np.generic]:
    """Convert a log time to the cursor of a `Show`."""
    if start_ns is None:
        return timeline, np.datetime64(time_ns, "ns")
    return timeline, np.timedelta64(time_ns - start_ns, "ns")
