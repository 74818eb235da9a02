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
from dmrl.errors import SourceError
from dmrl.images import codec
from dmrl.recording import LoadedRecording, iter_topic_batches
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import track
from dmrl.viewer.content.flight_streamer import FlightStreamer
from dmrl.viewer.content.robot_motion import Times
from dmrl.viewer.drawing import archetypes as entities
from dmrl.viewer.drawing.archetypes import Colour, ColourScale
from dmrl.viewer.drawing.entity import Entity, image_frame
from dmrl.viewer.drawing.label_overlay import draw_labels
from dmrl.viewer.drawing.legend import draw_colour_bars, draw_legend
from dmrl.viewer.layouts import TIMELINE, CameraPanel
from dmrl.viewer.selection import Selection
from dmrl.viewer.show import TimedEntity, build_time_column

PreparedEntity = tuple[Times | None, Entity]
TopicBatches = dict[str, pa.RecordBatch]

MIN_BATCH_ROWS = 20_000
"""Messages without an image are drawn in batches of this size: half a minute of two robots."""


@dataclass(frozen=True, slots=True)
class DrawRule:
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
    cameras
        Cameras that have a legend.
    sources
        Robot to sources of its labels; updated as they are read.
    named
        Names and colours of further entries of the legends.
    follower
        Makes a streamer that draws the joined topics of a flight; None: not needed.
    """

    blueprint: rrb.Blueprint
    draws: list[DrawRule]
    stills: list[PreparedEntity]
    cameras: Sequence[CameraPanel]
    sources: dict[str, set[str]] = field(default_factory=dict)
    named: dict[str, Colour] = field(default_factory=dict)
    follower: Callable[[], FlightStreamer] | None = None

    def list_topics(self, path: Path) -> list[str]:
        """Return the topics that are read from a recording."""
        drawn = [draw.topic for draw in self.draws if draw.recording in (None, path)]
        return drawn + (self.follower().topics if self.follower else [])


def iter_scene(selection: Selection, scene: Scene) -> Iterator[TimedEntity]:
    """Yield the whole scene: static entities, then the others by time, images first."""
    yield from _with_times(selection, scene.stills)
    follower = scene.follower() if scene.follower else None
    of_images = {draw.topic for draw in scene.draws if draw.robot is not None}
    shown: dict[str, set[str]] = {}
    for path in selection.recordings:
        parts = track(_iter_batches(selection, scene, path), f"Reading {path.name}")
        for stretch in _merge_batches(parts, of_images):
            for draw in scene.draws:
                if draw.topic in stretch and draw.recording in (None, path):
                    yield from _draw_batch(selection, draw, stretch[draw.topic])
            yield from _iter_changed_legends(scene, shown)
            if follower:
                yield from _with_times(selection, follower.draw_batch(stretch))
    if follower:
        yield from _with_times(selection, follower.draw_remaining())


def _merge_batches(parts: Iterable[TopicBatches], of_images: Set[str]) -> Iterator[TopicBatches]:
    """Yield images at once and all other messages in larger batches: each call of rerun is slow.

    The first part is yielded whole.
    """
    held: dict[str, list[pa.RecordBatch]] = {}
    count = MIN_BATCH_ROWS
    for part in parts:
        yield {topic: batch for topic, batch in part.items() if topic in of_images}
        for topic in part.keys() - of_images:
            held.setdefault(topic, []).append(part[topic])
            count += part[topic].num_rows
        if count >= MIN_BATCH_ROWS:
            yield _concatenate(held)
            held, count = {}, 0
    yield _concatenate(held)


def _concatenate(held: Mapping[str, Sequence[pa.RecordBatch]]) -> TopicBatches:
    return {topic: pa.concat_batches(batches) for topic, batches in held.items()}


def _with_times(selection: Selection, stills: Iterable[PreparedEntity]) -> Iterator[TimedEntity]:
    for time_ns, entity in stills:
        yield (None if time_ns is None else _time_column(selection, time_ns)), entity


def _iter_changed_legends(scene: Scene, shown: dict[str, set[str]]) -> Iterator[TimedEntity]:
    """Yield the legends that differ from those already ``shown``."""
    for robot, camera in {camera.robot: camera for camera in scene.cameras}.items():
        sources = scene.sources.get(robot, set())
        if shown.get(robot) != sources and (sources or scene.named):
            shown[robot] = set(sources)
            yield None, _build_legend(camera, sources, scene.named)


def _iter_batches(selection: Selection, scene: Scene, path: Path) -> Iterator[TopicBatches]:
    wanted = dict.fromkeys(scene.list_topics(path))
    around_images = {draw.topic: None for draw in scene.draws if draw.robot is not None}
    first_ns, end_ns = selection.shown_ns
    if selection.all_images or not selection.image_ns:
        yield from iter_topic_batches(path, wanted, start_ns=first_ns, end_ns=end_ns)
        return
    few = {topic: None for topic in wanted if topic in around_images}
    image_ns = min(int(times[0]) for times in selection.image_ns.values())
    yield from iter_topic_batches(path, few, start_ns=image_ns, end_ns=selection.last_image_ns + 1)
    always = {topic: None for topic in wanted if topic not in around_images}
    yield from iter_topic_batches(path, always, start_ns=first_ns, end_ns=end_ns)


def _draw_batch(
    selection: Selection, draw: DrawRule, batch: pa.RecordBatch
) -> Iterator[TimedEntity]:
    if draw.robot is not None and not selection.all_images:
        own = np.isin(batch["log_time"].to_numpy(), selection.image_ns[draw.robot])
        batch = batch.filter(pa.array(own))
    if topics.parse_topic(topics.CAMERA_IMAGE, draw.topic):
        batch = _select_decodable(batch, draw.topic)
    if batch.num_rows:
        times = _time_column(selection, batch["log_time"].to_numpy())
        for entity in draw.entities(batch):
            yield times, entity


def _select_decodable(batch: pa.RecordBatch, topic: str) -> pa.RecordBatch:
    """Return the images that can be decoded; leave out the others."""
    found = [codec.is_decodable(data.as_py()) for data in batch["data"]]
    for time_ns, good in zip(batch["log_time"].to_pylist(), found, strict=True):
        leave_out(codec.UNDECODABLE, f"{topic} at {time_ns} ns", not good)
    return batch if all(found) else batch.filter(pa.array(found))


def _time_column(selection: Selection, time_ns: Times) -> Any:
    return build_time_column(TIMELINE, time_ns, selection.zero_ns)


def _build_legend(camera: CameraPanel, sources: set[str], named: Mapping[str, Colour]) -> Entity:
    first = [name for name in RGB if name in sources]
    ordered = [*first, *sorted(sources - set(first))]
    colours = {name: RGB.get(name, RGB["other"]) for name in ordered} | dict(named)
    return draw_legend(camera.robot, colours, camera.width_px, camera.height_px)


def load_first_messages(
    selection: Selection, wanted: Iterable[str], only: Path | None = None
) -> dict[str, dict[str, Any]]:
    """Read the first message of each of these topics, if any."""
    wanted, found = list(wanted), dict[str, dict[str, Any]]()
    for path, kept in selection.recordings.items():
        if only not in (None, path):
            continue
        missing = {t: None for t in wanted if t in kept.topics and t not in found}
        missing = {t: None for t in missing if kept.topics[t].count}
        for stretch in iter_topic_batches(path, missing):
            for topic in set(stretch) & set(missing):
                found[topic] = stretch[topic].slice(0, 1).to_pylist()[0]
                del missing[topic]
            if not missing:
                break
    return found


def build_camera_panels(
    selection: Selection,
    robots: Sequence[str],
    scales: Mapping[str, ColourScale],
    *,
    model: Path | None = None,
) -> list[CameraPanel]:
    """Build the panels of robots' cameras, with detections of one recording's model or any.

    Raises
    ------
    SourceError
        If no image of a robot can be decoded.
    """
    grids = load_first_messages(selection, map(topics.GRID, robots), model) if scales else {}
    prefix = "" if model is None else f"/{model.stem}"
    cameras = []
    for robot in robots:
        picture, grid = topics.CAMERA_IMAGE(robot), topics.GRID(robot)
        width_px, height_px = _find_image_size(selection, picture)
        channels = grids[grid]["channels"] if grid in grids else ()
        cameras.append(
            CameraPanel(
                robot,
                robot if model is None else model.stem,
                width_px,
                height_px,
                picture,
                topics.LABELS(robot),
                prefix + topics.DETECTIONS(robot),
                prefix + grid,
                tuple(name for name in channels if name in scales),
            )
        )
    return cameras


def _find_image_size(selection: Selection, picture: str) -> tuple[int, int]:
    paths = (path for path, kept in selection.recordings.items() if picture in kept.topics)
    found = (LoadedRecording(path).read_image_size(picture) for path in paths)
    if (size_px := next(filter(None, found), None)) is None:
        raise SourceError(f"no image of {picture} can be decoded. Restore the recording")
    return size_px


def build_image_rules(camera: CameraPanel, sources: set[str]) -> list[DrawRule]:
    """Return how a camera's images and their labels are drawn."""
    frame = image_frame(camera.robot)
    return [
        DrawRule(
            camera.picture, partial(entities.draw_images, camera.picture, frame), camera.robot
        ),
        DrawRule(
            camera.labels,
            partial(
                draw_labels,
                camera.labels,
                frame,
                sources=sources,
                size_px=(camera.width_px, camera.height_px),
            ),
            camera.robot,
        ),
    ]


def build_model_rules(
    camera: CameraPanel,
    scales: Mapping[str, ColourScale],
    colour: Colour = RGB["detection"],
    *,
    smooth: bool,
    recording: Path | None = None,
) -> list[DrawRule]:
    """Return how the detections and maps of a camera are drawn."""
    frame, robot = image_frame(camera.robot), camera.robot
    shown = {name: scales[name] for name in camera.channels if name in scales}
    found = partial(
        entities.draw_detections, camera.detections, frame, width_px=camera.width_px, colour=colour
    )
    maps = partial(entities.draw_grids, camera.grid, frame, scales=shown, smooth=smooth)
    draws = [DrawRule(topics.DETECTIONS(robot), found, robot, recording)]
    return [*draws, DrawRule(topics.GRID(robot), maps, robot, recording)] if shown else draws


def build_colour_bars(
    camera: CameraPanel, scales: Mapping[str, ColourScale]
) -> list[PreparedEntity]:
    """Return the colour bars of a camera's maps."""
    shown = {channel: scales[channel] for channel in camera.channels}
    drawn = draw_colour_bars(camera.robot, shown, camera.width_px, camera.height_px)
    return [(None, entity) for entity in drawn]
