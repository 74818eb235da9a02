"""Draw the topics of a selection in one pass over the recordings, batch by batch."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun.blueprint as rrb

from dmrl import topics
from dmrl.colours import RGB
from dmrl.images import codec
from dmrl.recording import stretches
from dmrl.terminal.progress import track
from dmrl.viewer.content.flight_streamer import Follower
from dmrl.viewer.content.robot_motion import Times
from dmrl.viewer.drawing import archetypes as entities
from dmrl.viewer.drawing.archetypes import Colour, Scale
from dmrl.viewer.drawing.entity import Entity, image_frame
from dmrl.viewer.drawing.label_overlay import labels
from dmrl.viewer.drawing.legend import colour_bars, legend
from dmrl.viewer.layouts import TIMELINE, Eye
from dmrl.viewer.selection import Selection
from dmrl.viewer.show import Logged, time_column

Still = tuple[Times | None, Entity]
Stretch = dict[str, pa.RecordBatch]

ROWS_AT_ONCE = 20_000
"""Messages without an image are drawn in batches of this size: half a minute of two robots."""


@dataclass(frozen=True, slots=True)
class Draw:
    """How the messages of a topic are drawn.

    Parameters
    ----------
    topic
        Topic.
    entities
        Converts columns of its messages to entities.
    robot
        Only messages with the log time of an image of this robot that is shown. None: all.
    recording
        Only messages of this recording. None: of all.
    """

    topic: str
    entities: Callable[[pa.RecordBatch], Iterator[Entity]]
    robot: str | None = None
    recording: Path | None = None


@dataclass(slots=True)
class Scene:
    """Everything that is drawn.

    Parameters
    ----------
    blueprint
        The layout.
    draws
        How topics are drawn, image by image or message by message.
    stills
        Entities that need no reading: with log times, or static.
    eyes
        Cameras that have a legend.
    sources
        Robot to sources of its labels; updated as they are read.
    named
        Names and colours of further entries of the legends.
    follower
        Makes a streamer that draws the joined topics of a flight; None: not needed.
    """

    blueprint: rrb.Blueprint
    draws: list[Draw]
    stills: list[Still]
    eyes: Sequence[Eye]
    sources: dict[str, set[str]] = field(default_factory=dict)
    named: dict[str, Colour] = field(default_factory=dict)
    follower: Callable[[], Follower] | None = None

    def topics(self, path: Path) -> list[str]:
        """Return the topics that are read from a recording."""
        drawn = [draw.topic for draw in self.draws if draw.recording in (None, path)]
        return drawn + (self.follower().topics if self.follower else [])


def logged(selection: Selection, scene: Scene) -> Iterator[Logged]:
    """Yield the whole scene: static entities, then the others by time, images first."""
    yield from _timed(selection, scene.stills)
    follower = scene.follower() if scene.follower else None
    of_images = {draw.topic for draw in scene.draws if draw.robot is not None}
    shown: dict[str, set[str]] = {}
    for path in selection.recordings:
        parts = track(_stretches(selection, scene, path), f"Reading {path.name}")
        for stretch in _gathered(parts, of_images):
            for draw in scene.draws:
                if draw.topic in stretch and draw.recording in (None, path):
                    yield from _drawn(selection, draw, stretch[draw.topic])
            yield from _legends(scene, shown)
            if follower:
                yield from _timed(selection, follower.take(stretch))
    if follower:
        yield from _timed(selection, follower.rest())


def _gathered(parts: Iterable[Stretch], of_images: Set[str]) -> Iterator[Stretch]:
    """Yield images at once and all other messages in larger batches: each call of rerun is slow.

    The first part is yielded whole.
    """
    held: dict[str, list[pa.RecordBatch]] = {}
    count = ROWS_AT_ONCE
    for part in parts:
        yield {topic: batch for topic, batch in part.items() if topic in of_images}
        for topic in part.keys() - of_images:
            held.setdefault(topic, []).append(part[topic])
            count += part[topic].num_rows
        if count >= ROWS_AT_ONCE:
            yield _joined(held)
            held, count = {}, 0
    yield _joined(held)


def _joined(held: Mapping[str, Sequence[pa.RecordBatch]]) -> Stretch:
    return {topic: pa.concat_batches(batches) for topic, batches in held.items()}


def _timed(selection: Selection, stills: Iterable[Still]) -> Iterator[Logged]:
    for time_ns, entity in stills:
        yield (None if time_ns is None else _times(selection, time_ns)), entity


def _legends(scene: Scene, shown: dict[str, set[str]]) -> Iterator[Logged]:
    """Yield the legends that differ from those already ``shown``."""
    for robot, eye in {eye.robot: eye for eye in scene.eyes}.items():
        sources = scene.sources.get(robot, set())
        if shown.get(robot) != sources and (sources or scene.named):
            shown[robot] = set(sources)
            yield None, _legend(eye, sources, scene.named)


def _stretches(selection: Selection, scene: Scene, path: Path) -> Iterator[Stretch]:
    wanted = dict.fromkeys(scene.topics(path))
    around_images = {draw.topic: None for draw in scene.draws if draw.robot is not None}
    first_ns, end_ns = selection.shown_ns
    if selection.all_images or not selection.image_ns:
        yield from stretches(path, wanted, start_ns=first_ns, end_ns=end_ns)
        return
    few = {topic: None for topic in wanted if topic in around_images}
    image_ns = min(int(times[0]) for times in selection.image_ns.values())
    yield from stretches(path, few, start_ns=image_ns, end_ns=selection.last_image_ns + 1)
    always = {topic: None for topic in wanted if topic not in around_images}
    yield from stretches(path, always, start_ns=first_ns, end_ns=end_ns)


def _drawn(selection: Selection, draw: Draw, batch: pa.RecordBatch) -> Iterator[Logged]:
    if draw.robot is not None and not selection.all_images:
        own = np.isin(batch["log_time"].to_numpy(), selection.image_ns[draw.robot])
        batch = batch.filter(pa.array(own))
    if batch.num_rows:
        times = _times(selection, batch["log_time"].to_numpy())
        for entity in draw.entities(batch):
            yield times, entity


def _times(selection: Selection, time_ns: Times) -> Any:
    return time_column(TIMELINE, time_ns, selection.zero_ns)


def _legend(eye: Eye, sources: set[str], named: Mapping[str, Colour]) -> Entity:
    first = [name for name in RGB if name in sources]
    ordered = [*first, *sorted(sources - set(first))]
    colours = {name: RGB.get(name, RGB["other"]) for name in ordered} | dict(named)
    return legend(eye.robot, colours, eye.width_px, eye.height_px)


def firsts(
    selection: Selection, wanted: Iterable[str], only: Path | None = None
) -> dict[str, dict[str, Any]]:
    """Read the first message of each of these topics, if any."""
    wanted, found = list(wanted), dict[str, dict[str, Any]]()
    for path, kept in selection.recordings.items():
        if only not in (None, path):
            continue
        missing = {t: None for t in wanted if t in kept.topics and t not in found}
        missing = {t: None for t in missing if kept.topics[t].count}
        for stretch in stretches(path, missing):
            for topic in set(stretch) & set(missing):
                found[topic] = stretch[topic].slice(0, 1).to_pylist()[0]
                del missing[topic]
            if not missing:
                break
    return found


def eyes_of(
    selection: Selection,
    robots: Sequence[str],
    scales: Mapping[str, Scale],
    *,
    model: Path | None = None,
) -> list[Eye]:
    """Build the panels of robots' cameras, with detections of one recording's model or any.

    Raises
    ------
    SourceError
        If a first image cannot be decoded.
    """
    first = firsts(selection, map(topics.camera_image, robots))
    grids = firsts(selection, map(topics.grid, robots), model) if scales else {}
    prefix = "" if model is None else f"/{model.stem}"
    eyes = []
    for robot in robots:
        picture, grid = topics.camera_image(robot), topics.grid(robot)
        width_px, height_px, _ = codec.size(first[picture]["data"], f"the first image of {picture}")
        channels = grids[grid]["channels"] if grid in grids else ()
        eyes.append(
            Eye(
                robot,
                robot if model is None else model.stem,
                width_px,
                height_px,
                picture,
                topics.labels(robot),
                prefix + topics.detections(robot),
                prefix + grid,
                tuple(name for name in channels if name in scales),
            )
        )
    return eyes


def picture_draws(eye: Eye, sources: set[str]) -> list[Draw]:
    """Return how a camera's images and their labels are drawn."""
    frame = image_frame(eye.robot)
    return [
        Draw(eye.picture, partial(entities.images, eye.picture, frame), eye.robot),
        Draw(
            eye.labels,
            partial(
                labels,
                eye.labels,
                frame,
                sources=sources,
                size_px=(eye.width_px, eye.height_px),
            ),
            eye.robot,
        ),
    ]


def model_draws(
    eye: Eye,
    scales: Mapping[str, Scale],
    colour: Colour = RGB["detection"],
    *,
    smooth: bool,
    recording: Path | None = None,
) -> list[Draw]:
    """Return how the detections and maps of a camera are drawn."""
    frame, robot = image_frame(eye.robot), eye.robot
    shown = {name: scales[name] for name in eye.channels if name in scales}
    found = partial(
        entities.detections, eye.detections, frame, width_px=eye.width_px, colour=colour
    )
    maps = partial(entities.grids, eye.grid, frame, scales=shown, smooth=smooth)
    draws = [Draw(topics.detections(robot), found, robot, recording)]
    return [*draws, Draw(topics.grid(robot), maps, robot, recording)] if shown else draws


def bars(eye: Eye, scales: Mapping[str, Scale]) -> list[Still]:
    """Return the colour bars of a camera's maps."""
    shown = {channel: scales[channel] for channel in eye.channels}
    drawn = colour_bars(eye.robot, shown, eye.width_px, eye.height_px)
    return [(None, entity) for entity in drawn]
