"""Collect the data that the checks evaluate, in one pass over a recording."""

from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from dmrl.errors import DmrlError, RecordingError
from dmrl.images.codec import size
from dmrl.recording.checks.odometry_checks import Moved
from dmrl.recording.checks.unit_checks import Sizes
from dmrl.recording.loaded import Contents
from dmrl.recording.log_times import log_times
from dmrl.recording.mcap.batch_reader import in_file_order
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.message_batch import Block, Ints, joined
from dmrl.recording.protobuf.columns import apart, decoded
from dmrl.recording.reader import STRETCH_BYTES, columns
from dmrl.topics import CALIBRATION, CAMERA_IMAGE, LABELS, names, row_of

STAMPED = ("CompressedImage", "PoseInFrame")
"""Message types that contain a time stamp."""
HELD = (LABELS, CALIBRATION)
"""Topics whose messages are kept in memory."""

Size = tuple[int, int] | None
"""Width and height of an image; None for data that are not an image."""


@dataclass(slots=True)
class Seen:
    """Data collected from a recording.

    Parameters
    ----------
    contents
        The recording, with labels and calibrations in memory.
    times
        Log times by topic, in file order, or sorted if only the index was read.
    broken
        Error text by topic, for messages that are not of their type.
    sizes
        Number of images of each size, by topic; the size of the first image comes first.
    unset_stamps
        Messages with time stamp 0 and another log time, by topic.
    magnitudes
        Histograms of the sensor values.
    motion
        Samples of odometry and poses.
    """

    contents: Contents
    times: dict[str, Ints]
    broken: dict[str, str] = field(default_factory=dict)
    sizes: dict[str, Counter[Size]] = field(default_factory=lambda: defaultdict(Counter))
    unset: Counter[str] = field(default_factory=Counter)
    values: Sizes = field(default_factory=Sizes)
    moved: Moved = field(default_factory=Moved)


def carries(topic: str, schema: str) -> bool:
    """Return whether a topic is one of dmrl's and has the right message type."""
    row = row_of(topic)
    return row is not None and row.carries(schema)


def look(path: Path) -> Seen:
    """Collect all data, decoding every message once.

    Raises
    ------
    RecordingError
        If the file is not a complete recording.
    """
    contents = Contents(path)
    seen = Seen(contents, {})
    times: dict[str, list[Ints]] = {topic: [np.empty(0, np.int64)] for topic in contents.topics}
    kept: dict[str, list[Block]] = {t: [] for t in contents.topics if _held(contents, t)}
    channels: dict[int, Channel] = {}
    for block, channels in _stretches(path):
        for topic, mine in apart(block, channels).items():
            times[topic].append(mine.time_ns)
            if topic in kept:
                kept[topic].append(mine.compact())
            _decode(seen, topic, mine, channels)
    seen.times = {topic: np.concatenate(parts) for topic, parts in times.items()}
    parts = [block for blocks in kept.values() for block in blocks]
    contents.hold(frozenset(kept), parts, channels)
    return seen


def glimpse(contents: Contents) -> Seen:
    """Collect the log times from the index. No image is decoded.

    Parameters
    ----------
    contents
        A recording with the messages of `KEPT_TOPICS` in memory.

    Raises
    ------
    RecordingError
        If the file is not a complete recording.
    """
    return Seen(contents, log_times(contents.path, contents.topics))


def first_size(seen: Seen, topic: str) -> Size:
    """Return the size of the first image of a topic; None without an image."""
    if topic not in seen.sizes and len(seen.times[topic]):
        image = next(columns(seen.contents.path, topic, fields=["data"]))
        seen.sizes[topic][_size(image["data"][0].as_buffer())] += 1
    return next(iter(seen.sizes[topic]), None)


def _held(contents: Contents, topic: str) -> bool:
    of_kind = any(names(pattern, topic) for pattern in HELD)
    return of_kind and carries(topic, contents.topics[topic].schema)


def _stretches(path: Path) -> Iterator[tuple[Block, dict[int, Channel]]]:
    """Yield every message in file order, joining chunks so that few calls decode them."""
    held: list[Block] = []
    size = 0
    channels: dict[int, Channel] = {}
    for block, channels in in_file_order(path):
        held.append(block)
        size += len(block.data)
        if size >= STRETCH_BYTES:
            yield joined(held), channels
            held, size = [], 0
    if held:
        yield joined(held), channels


def _decode(seen: Seen, topic: str, block: Block, channels: dict[int, Channel]) -> None:
    """Decode messages of a topic of dmrl's, and collect their data."""
    path, schema = seen.contents.path, seen.contents.topics[topic].schema
    stamped = schema.rpartition(".")[2] in STAMPED
    if topic in seen.broken or not (carries(topic, schema) or stamped):
        return
    fields = None if carries(topic, schema) else ["timestamp"]
    try:
        batch = decoded(path, topic, block, channels, fields)
    except RecordingError as e:
        if fields is None:
            seen.broken[topic] = str(e)
        return
    if stamped and "timestamp" in batch.schema.names:
        seen.unset[topic] += _unset(batch)
    seen.values.add(topic, batch)
    seen.moved.add(topic, batch)
    if names(CAMERA_IMAGE, topic):
        seen.sizes[topic].update(_size(data.as_buffer()) for data in batch["data"])


def _unset(batch: pa.RecordBatch) -> int:
    """Count the messages with time stamp 0 and another log time."""
    stamp = batch["timestamp"]
    zero = [pc.equal(pc.fill_null(pc.struct_field(stamp, n), 0), 0) for n in ("seconds", "nanos")]
    # A message without a stamp is not counted.
    wrong = pc.and_(pc.and_(*zero), pc.and_(stamp.is_valid(), pc.not_equal(batch["log_time"], 0)))
    return int(pc.sum(wrong).as_py() or 0)


def _size(data: pa.Buffer) -> Size:
    try:
        width_px, height_px, _ = size(data.to_pybytes())
    except (DmrlError, ValueError):
        return None
    return width_px, height_px
