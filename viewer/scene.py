"""What of a selection is drawn, and how: read in one pass, stretch by stretch."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun.blueprint as rrb

from dmrl import images, topics
from dmrl.colours import RGB
from dmrl.progress import track
from dmrl.recording import columns, stretches
from dmrl.viewer import entities
from dmrl.viewer.entities import Colour, Scale
from dmrl.viewer.entity import Entity, image_frame
from dmrl.viewer.layouts import TIMELINE, Eye
from dmrl.viewer.legend import colour_bars, legend
from dmrl.viewer.motion import Times
from dmrl.viewer.selection import Selection
from dmrl.viewer.show import Logged, time_column

Still = tuple[Times | None, Entity]


@dataclass(frozen=True, slots=True)
class Draw:
    """How the messages of a topic are drawn.

    Parameters
    ----------
    topic
        Topic.
    entities
        From columns of its messages.
    robot
        Only messages with the log time of an image of this robot that is shown. None: all.
    recording
        Only from this recording. None: from all.
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
        What is known before: with log times, or for ever.
    eyes
        Cameras that have a legend.
    sources
        Robot to sources of its labels; grows as they are read.
    named
        Names and colours of what else the legends explain.
    """

    blueprint: rrb.Blueprint
    draws: list[Draw]
    stills: list[Still]
    eyes: Sequence[Eye]
    sources: dict[str, set[str]] = field(default_factory=dict)
    named: dict[str, Colour] = field(default_factory=dict)


def logged(selection: Selection, scene: Scene) -> Iterator[Logged]:
    """The whole scene: what stands still, then all that moves, by time."""
    for time_ns, entity in scene.stills:
        yield (None if time_ns is None else _times(selection, time_ns)), entity
    shown: dict[str, set[str]] = {}
    for path in selection.recordings:
        for stretch in track(_stretches(selection, scene, path), f"Reading {path.name}"):
            for draw in scene.draws:
                if draw.topic in stretch and draw.recording in (None, path):
                    yield from _drawn(selection, draw, stretch[draw.topic])
            for robot, eye in {eye.robot: eye for eye in scene.eyes}.items():
                sources = scene.sources.get(robot, set())
                if shown.get(robot) != sources:
                    shown[robot] = set(sources)
                    yield None, _legend(eye, sources, scene.named)


def _stretches(
    selection: Selection, scene: Scene, path: Path
) -> Iterator[dict[str, pa.RecordBatch]]:
    wanted = {draw.topic: None for draw in scene.draws if draw.recording in (None, path)}
    around_images = {draw.topic: None for draw in scene.draws if draw.robot is not None}
    first_ns, end_ns = selection.shown_ns
    if selection.all_images or not selection.image_ns:
        yield from stretches(path, wanted, start_ns=first_ns, end_ns=end_ns)
        return
    always = {topic: None for topic in wanted if topic not in around_images}
    yield from stretches(path, always, start_ns=first_ns, end_ns=end_ns)
    few = {topic: None for topic in wanted if topic in around_images}
    first_ns = min(int(times[0]) for times in selection.image_ns.values())
    yield from stretches(path, few, start_ns=first_ns, end_ns=selection.last_image_ns + 1)


def _drawn(selection: Selection, draw: Draw, batch: pa.RecordBatch) -> Iterator[Logged]:
    if draw.robot is not None and not selection.all_images:
        own = np.isin(batch["log_time"].to_numpy(), selection.image_ns[draw.robot])
        batch = batch.filter(pa.array(own))
    if batch.num_rows:
        times = _times(selection, batch["log_time"].to_numpy())
        for entity in draw.entities(batch):
            yield times, entity


def _times(selection: Selection, time_ns: Times) -> Any:
    return time_column(TIMELINE, time_ns, on_wall_clock=selection.on_wall_clock)


def _legend(eye: Eye, sources: set[str], named: Mapping[str, Colour]) -> Entity:
    first = [name for name in RGB if name in sources]
    ordered = [*first, *sorted(sources - set(first))]
    colours = {name: RGB.get(name, RGB["other"]) for name in ordered} | dict(named)
    return legend(eye.robot, colours, eye.width_px, eye.height_px)


def eye_of(
    selection: Selection, robot: str, scales: Mapping[str, Scale], *, model: Path | None = None
) -> Eye:
    """A robot's camera, with what one recording's model found, or any.

    Raises
    ------
    SourceError
        If its first image is none.
    """
    picture, grid = topics.camera_image(robot), topics.grid(robot)
    data = first_of(selection, picture, ("data",))
    assert data is not None
    width_px, height_px, _ = images.size(data["data"], f"the first image of {picture}")
    said = first_of(selection, grid, ("channels",), model)
    prefix = "" if model is None else f"/{model.stem}"
    return Eye(
        robot,
        robot if model is None else model.stem,
        width_px,
        height_px,
        picture,
        topics.labels(robot),
        prefix + topics.detections(robot),
        prefix + grid,
        tuple(name for name in (said or {"channels": ()})["channels"] if name in scales),
    )


def first_of(
    selection: Selection, topic: str, fields: Sequence[str] | None = None, only: Path | None = None
) -> dict[str, Any] | None:
    """Fields of the first message of a topic; None if there is none."""
    for path, kept in selection.recordings.items():
        if topic in kept.topics and only in (None, path):
            for batch in columns(path, topic, fields=fields):
                return dict(batch.slice(0, 1).to_pylist()[0])
    return None


def picture_draws(eye: Eye, sources: set[str]) -> list[Draw]:
    """A camera's images and their labels."""
    frame = image_frame(eye.robot)
    return [
        Draw(eye.picture, partial(entities.images, eye.picture, frame), eye.robot),
        Draw(
            eye.labels,
            partial(entities.labels, eye.labels, frame, sources=sources),
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
    """What a model found in a camera's images."""
    frame, robot = image_frame(eye.robot), eye.robot
    shown = {name: scales[name] for name in eye.channels if name in scales}
    found = partial(entities.detections, eye.detections, frame, colour=colour)
    maps = partial(entities.grids, eye.grid, frame, scales=shown, smooth=smooth)
    draws = [Draw(topics.detections(robot), found, robot, recording)]
    return [*draws, Draw(topics.grid(robot), maps, robot, recording)] if shown else draws


def bars(eye: Eye, scales: Mapping[str, Scale]) -> list[Still]:
    """The colour bars of a camera's maps."""
    shown = {channel: scales[channel] for channel in eye.channels}
    drawn = colour_bars(eye.robot, shown, eye.width_px, eye.height_px)
    return [(None, entity) for entity in drawn]
