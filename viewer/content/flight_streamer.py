"""Draw a flight while it is read: frames, positions, trails, errors and ranges, batch by batch.

A trail needs the pose of its robot at the time of a position; an error needs the truth at the time
of an estimate. Rows between two messages of the other topic wait until the second is read. The
result is therefore independent of the limits of a batch.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import pyarrow as pa

from dmrl import topics
from dmrl.geometry.frames import Array
from dmrl.viewer.content.robot_motion import (
    FlightMotion,
    Names,
    Poses,
    Positions,
    Timed,
    Times,
    concatenate_parts,
    parse_poses,
    parse_positions,
    parse_ranges,
    select_rows,
)
from dmrl.viewer.drawing import space, time_plots
from dmrl.viewer.drawing.entity import WORLD_FRAME, Entity, horizontal_frame

Rows = tuple[Times, Entity]


@dataclass(slots=True)
class TopicBuffer:
    """All rows of a topic or frame that were read, in parts."""

    parts: list[Timed] = field(default_factory=list)
    until_ns: int = -1

    def add_part(self, part: Timed) -> None:
        """Add a part."""
        self.parts.append(part)
        self.until_ns = max(self.until_ns, int(part.time_ns[-1]))

    def select_around(self, first_ns: int, last_ns: int) -> Timed:
        """Return the parts that overlap a time span, with one neighbour on each side."""
        within = [k for k, p in enumerate(self.parts) if p.time_ns[-1] >= first_ns]
        within = [k for k in within if self.parts[k].time_ns[0] <= last_ns]
        before = [k for k, p in enumerate(self.parts) if p.time_ns[-1] < first_ns][-1:]
        after = [k for k, p in enumerate(self.parts) if p.time_ns[0] > last_ns][:1]
        return concatenate_parts([self.parts[k] for k in (*before, *within, *after)])


@dataclass(slots=True)
class TimeJoin:
    """Draw the rows of a topic with interpolated rows of another one.

    Parameters
    ----------
    topic
        Topic of the rows.
    other
        Rows of the other topic; None: not needed.
    draw
        Converts rows, and the rows of the other topic around them, to entities.
    waiting
        Rows after the last one of the other topic.
    """

    topic: str
    other: TopicBuffer | None
    draw: Callable[..., Iterator[Entity]]
    waiting: list[Timed] = field(default_factory=list)

    def iter_ready(self, *, all_read: bool = False) -> Iterator[Rows]:
        """Yield the rows that can be drawn."""
        if not self.waiting or (self.other is not None and not self.other.parts):
            return
        rows = concatenate_parts(self.waiting)
        cut = len(rows.time_ns)
        if self.other is not None and not all_read:
            cut = int(np.searchsorted(rows.time_ns, self.other.until_ns, "right"))
        self.waiting = [select_rows(rows, slice(cut, None))] if cut < len(rows.time_ns) else []
        if not cut:
            return
        rows = select_rows(rows, slice(cut))
        times = rows.time_ns
        others = None
        if self.other is not None:
            others = self.other.select_around(int(times[0]), int(times[-1]))
        for entity in self.draw(rows, others):
            yield times, entity


class FlightStreamer:
    """Draw the motion of a flight in one pass over it.

    Parameters
    ----------
    pairs
        Observer and peer of each pair.
    seen
        A sample of the flight, with all its frames and positions.
    begin_ns
        Log time at which frames get their first pose. A 3D view is empty if its frame has no pose
        at the time at which the viewer opens.
    """

    def __init__(self, pairs: Sequence[Names], seen: FlightMotion, begin_ns: int) -> None:
        self._begin_ns = begin_ns
        self._sent: dict[str, Poses] = {}
        self._frames: dict[str, TopicBuffer] = {}
        self._positions: dict[str, tuple[Names, str, TopicBuffer]] = {}
        self._ranges = {topics.RANGE(*pair) for pair in pairs}
        self._derived: list[TimeJoin] = []
        for pair in pairs:
            self._add_pair(pair, seen)

    def _add_pair(self, pair: Names, seen: FlightMotion) -> None:
        estimate, truth = topics.POSITION(*pair), topics.TRUTH(*pair)
        frame = seen.display_frame(pair[0])
        around = None
        if frame == WORLD_FRAME:
            around = self._frames.setdefault(horizontal_frame(pair[0]), TopicBuffer())
        known = {}
        for topic, source, has in (
            (truth, "truth", pair in seen.truths),
            (estimate, "estimate", pair in seen.estimates),
        ):
            if has:
                known[topic] = TopicBuffer()
                self._positions[topic] = pair, source, known[topic]
                self._derived.append(
                    TimeJoin(topic, around, Trajectory(topic, frame, source).draw_steps)
                )
        if len(known) == 2:
            errors = partial(time_plots.draw_errors, estimate)
            self._derived.append(TimeJoin(estimate, known[truth], errors))
        towards = known.get(estimate) or known.get(truth)
        measured = topics.RANGE(*pair)
        lines = partial(space.draw_ranges, measured, pair[0])
        self._derived.append(TimeJoin(measured, towards, lines))

    @property
    def topics(self) -> list[str]:
        """Topics that the streamer reads."""
        return [topics.TRANSFORMS, *self._positions, *self._ranges]

    def draw_batch(self, stretch: Mapping[str, pa.RecordBatch]) -> Iterator[Rows]:
        """Yield the rows that can be drawn after another batch."""
        if topics.TRANSFORMS in stretch:
            yield from self._draw_frames(parse_poses(stretch[topics.TRANSFORMS]))
        fresh: dict[str, Timed] = {}
        for topic in self._ranges & stretch.keys():
            fresh[topic] = parse_ranges(stretch[topic])
        for topic, (pair, source, heard) in self._positions.items():
            if topic in stretch:
                positions = fresh[topic] = parse_positions(stretch[topic])
                heard.add_part(positions)
                for entity in _draw_positions(topic, pair, positions, source):
                    yield positions.time_ns, entity
        for derived in self._derived:
            if derived.topic in fresh:
                derived.waiting.append(fresh[derived.topic])
            yield from derived.iter_ready()

    def draw_remaining(self) -> Iterator[Rows]:
        """Yield the remaining rows after the last batch."""
        for derived in self._derived:
            yield from derived.iter_ready(all_read=True)

    def _draw_frames(self, poses: Mapping[str, Poses]) -> Iterator[Rows]:
        """Yield the frames that moved; a fixed frame gets one row."""
        for frame, part in poses.items():
            if frame in self._frames:
                self._frames[frame].add_part(part)
            last = self._sent.get(frame)
            if last is None:
                first_ns = np.append(min(self._begin_ns, part.time_ns[0]), part.time_ns[1:])
                part = replace(part, time_ns=first_ns)
            rows = np.flatnonzero(part.find_changes(last))
            self._sent[frame] = select_rows(part, slice(-1, None))
            if len(rows):
                moved = select_rows(part, rows)
                yield moved.time_ns, space.draw_transform(frame, moved)


@dataclass(slots=True)
class Trajectory:
    """Draw the trajectory of a robot relative to another one, across batches."""

    topic: str
    frame: str
    source: str
    last: Array | None = None
    last_ns: int = -1

    def draw_steps(self, positions: Positions, poses: Poses | None) -> Iterator[Entity]:
        """Draw the next steps."""
        there = positions.xyz
        if poses is not None:
            there = poses.to_parent(there, positions.time_ns)
        # Earlier times belong to another recording, which starts a new trail.
        goes_on = self.last is not None and positions.time_ns[0] >= self.last_ns
        first = self.last if goes_on else there[:1]
        self.last, self.last_ns = there[-1:], int(positions.time_ns[-1])
        steps = np.stack([np.concatenate([first, there[:-1]]), there], axis=1)
        yield space.draw_trail(f"{self.topic}/trail", self.frame, steps, self.source)


def _draw_positions(topic: str, pair: Names, positions: Positions, source: str) -> Iterator[Entity]:
    """Draw the positions of one topic, which need no other topic."""
    yield from space.draw_positions(topic, pair, positions, source)
    yield time_plots.draw_distance(topic, positions, source)
    if source == "estimate":
        yield from time_plots.draw_status(topic, positions)
