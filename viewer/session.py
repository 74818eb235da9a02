"""What is selected, into a rerun stream or file."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr

from dmrl import images, topics
from dmrl.colours import RGB
from dmrl.errors import OutputError
from dmrl.output import partial_file
from dmrl.progress import track
from dmrl.recording import columns
from dmrl.viewer import entities, layouts
from dmrl.viewer.entities import Entity, Scale, escaped
from dmrl.viewer.layouts import TIMELINE, Eye
from dmrl.viewer.legend import colour_bars, legend
from dmrl.viewer.selection import Selection, Settings, Times, select

Draw = Callable[[str, pa.RecordBatch], Iterator[Entity]]


def save(paths: Sequence[Path], out: Path, settings: Settings) -> int:
    """Write what would be shown, with its layout, as an .rrd file.

    Returns
    -------
    int
        Images in it.

    Raises
    ------
    OutputError
        If ``out`` exists or cannot be written.
    RecordingError
        If no recording has images, or one cannot be read.
    SettingError
        If no image lies in the time asked for.
    """
    selection = select(paths, settings)
    with partial_file(out) as unfinished:
        write(selection, unfinished, settings)
    return sum(times.size for times in selection.image_ns.values())


def write(selection: Selection, path: Path, settings: Settings) -> None:
    """Write an .rrd file, whatever stands at ``path``.

    Raises
    ------
    OutputError
        If the disk is full, or refuses.
    """
    # Misuse of rerun becomes an error, where it would log a warning and go on.
    rr.set_strict_mode(True)
    scales = entities.scales(settings.depth_max_m)
    eyes = [_eye(selection, robot, scales) for robot in sorted(selection.image_ns)]
    stream = rr.RecordingStream("dmrl")
    stream.save(path, default_blueprint=layouts.image(eyes, scales))
    # rerun's own log_time is the time of the call.
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    stream.send_recording_name(" + ".join(recording.stem for recording in selection.recordings))
    for eye in eyes:
        _log_robot(stream, selection, eye, scales)
    try:
        stream.flush()
    except RuntimeError as e:
        # All that rerun tells of a failed write, after the reason went to standard error.
        raise OutputError(f"cannot write {path}: {e}. Free some space, or name another") from e
    finally:
        stream.disconnect()


def _eye(selection: Selection, robot: str, scales: Mapping[str, Scale]) -> Eye:
    topic = topics.camera_image(robot)
    data = _first(selection, topic, "data")
    width_px, height_px, _ = images.size(data, f"the first image of {topic}")
    channels = _first(selection, topics.grid(robot), "channels") or ()
    return Eye(robot, width_px, height_px, tuple(name for name in channels if name in scales))


def _first(selection: Selection, topic: str, field: str) -> Any:
    for path, kept in selection.recordings.items():
        if topic in kept.topics:
            for batch in columns(path, topic, fields=[field]):
                return batch[field][0].as_py()
    return None


def _log_robot(
    stream: rr.RecordingStream, selection: Selection, eye: Eye, scales: Mapping[str, Scale]
) -> None:
    sources: set[str] = set()
    styled: set[str] = set()
    draws: dict[str, Draw] = {
        topics.camera_image(eye.robot): entities.images,
        topics.labels(eye.robot): partial(entities.labels, sources=sources),
        topics.detections(eye.robot): entities.detections,
        topics.grid(eye.robot): partial(entities.grids, scales=scales),
    }
    for time_ns, entity in track(_rows(selection, eye.robot, draws), f"Reading {eye.robot}"):
        if entity.path not in styled:
            styled.add(entity.path)
            _log_style(stream, entity)
        times = [_time_column(selection, time_ns)]
        stream.send_columns(escaped(entity.path), times, entity.columns)
    if topics.detections(eye.robot) in styled:
        sources.add("detection")
    shown = [source for source in RGB if source in sources]
    shown += sorted(sources - set(shown))
    _log_style(stream, legend(eye.robot, shown, eye.width_px, eye.height_px))
    bars = {channel: scales[channel] for channel in eye.channels}
    for entity in colour_bars(eye.robot, bars, eye.width_px, eye.height_px):
        _log_style(stream, entity)


def _log_style(stream: rr.RecordingStream, entity: Entity) -> None:
    for part in entity.style:
        stream.log(escaped(entity.path), part, static=True)


def _rows(
    selection: Selection, robot: str, draws: Mapping[str, Draw]
) -> Iterator[tuple[Times, Entity]]:
    for topic, draw in draws.items():
        for batch in _batches(selection, robot, topic):
            time_ns = batch["log_time"].to_numpy()
            for entity in draw(topic, batch):
                yield time_ns, entity


def _batches(selection: Selection, robot: str, topic: str) -> Iterator[pa.RecordBatch]:
    first_ns, end_ns = selection.first_ns, selection.last_ns + 1
    for path, kept in selection.recordings.items():
        if topic not in kept.topics:
            continue
        for batch in columns(path, topic, start_ns=first_ns, end_ns=end_ns):
            if not selection.all_images:
                shown = np.isin(batch["log_time"].to_numpy(), selection.image_ns[robot])
                batch = batch.filter(pa.array(shown))
            if batch.num_rows:
                yield batch


def _time_column(selection: Selection, time_ns: Times) -> rr.TimeColumn:
    if selection.on_wall_clock:
        return rr.TimeColumn(TIMELINE, timestamp=time_ns.astype("datetime64[ns]"))
    return rr.TimeColumn(TIMELINE, duration=time_ns.astype("timedelta64[ns]"))
