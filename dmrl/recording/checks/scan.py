"""What a check has to see of a recording, gathered in one pass over it."""

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
"""Messages that say of themselves of what time they are."""
HELD = (LABELS, CALIBRATION)

Size = tuple[int, int] | None
"""Width and height of an image; None for data that is no image."""


@dataclass(slots=True)
class Seen:
    """What was seen of a recording.

    Parameters
    ----------
    contents
        Labels and calibrations.
    times
        By topic: log times, in the order of the file, or sorted if only the index was read.
    broken
        By topic: why its messages are not of their type.
    sizes
        By topic of images: how many are of which size; the first one's comes first.
    unset
        By topic: how many messages have a time stamp of 0, and stand at another time.
    values
        How large what sensors say is.
    moved
        What robots measured of their motion, and their poses.
    """

    contents: Contents
    times: dict[str, Ints]
    broken: dict[str, str] = field(default_factory=dict)
    sizes: dict[str, Counter[Size]] = field(default_factory=lambda: defaultdict(Counter))
    unset: Counter[str] = field(default_factory=Counter)
    values: Sizes = field(default_factory=Sizes)
    moved: Moved = field(default_factory=Moved)


def carries(topic: str, schema: str) -> bool:
    """Whether a topic is dmrl's, and carries what it should."""
    row = row_of(topic)
    return row is not None and row.carries(schema)


def look(path: Path) -> Seen:
    """Everything, every message decoded once.

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
    """Times as the index has them; no picture is looked at but the first of some.

    Parameters
    ----------
    contents
        Holds what `HELD` names.

    Raises
    ------
    RecordingError
        If the file is not a complete recording.
    """
    return Seen(contents, log_times(contents.path, contents.topics))


def first_size(seen: Seen, topic: str) -> Size:
    """Width and height of the first image of a topic; None where there is none, or no image."""
    if topic not in seen.sizes and len(seen.times[topic]):
        image = next(columns(seen.contents.path, topic, fields=["data"]))
        seen.sizes[topic][_size(image["data"][0].as_buffer())] += 1
    return next(iter(seen.sizes[topic]), None)


def _held(contents: Contents, topic: str) -> bool:
    of_kind = any(names(pattern, topic) for pattern in HELD)
    return of_kind and carries(topic, contents.topics[topic].schema)


def _stretches(path: Path) -> Iterator[tuple[Block, dict[int, Channel]]]:
    """Every message as the file has them; several chunks at once, so that few calls decode them."""
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
    """Decode messages of a topic of dmrl's, and note what is odd in them."""
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
    """How many messages say that they are of time 0, and stand at another."""
    stamp = batch["timestamp"]
    zero = [pc.equal(pc.fill_null(pc.struct_field(stamp, n), 0), 0) for n in ("seconds", "nanos")]
    # Without any stamp, nothing is said.
    wrong = pc.and_(pc.and_(*zero), pc.and_(stamp.is_valid(), pc.not_equal(batch["log_time"], 0)))
    return int(pc.sum(wrong).as_py() or 0)


def _size(data: pa.Buffer) -> Size:
    try:
        width_px, height_px, _ = size(data.to_pybytes())
    except (DmrlError, ValueError):
        return None
    return width_px, height_px
