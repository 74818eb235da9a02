"""Collect the data that the checks evaluate, in one pass over a recording."""

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pyarrow as pa
import pyarrow.compute as pc

from dmrl.errors import DmrlError, RecordingError
from dmrl.images.codec import is_decodable, read_size
from dmrl.recording.checks.image_checks import ImageSamples
from dmrl.recording.checks.odometry_checks import MotionSamples
from dmrl.recording.checks.topic_times import TopicTimes
from dmrl.recording.checks.unit_checks import FINITE_TOPICS, ValueCounts
from dmrl.recording.loaded import LoadedRecording
from dmrl.recording.log_times import iter_sorted_times
from dmrl.recording.mcap.batch_reader import iter_batches_in_file_order, join_batches
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.message_batch import Ints, MessageBatch
from dmrl.recording.protobuf.arrow_arrays import to_numpy
from dmrl.recording.protobuf.columns import decode_topic, group_by_topic
from dmrl.recording.protobuf.message_types import carries_own_type
from dmrl.recording.reader import iter_columns
from dmrl.recording.summary import TopicInfo
from dmrl.topics import CALIBRATION, CAMERA_IMAGE, CAUSES, GRID, LABELS, parse_topic

STAMPED_TYPES = ("CompressedImage", "PoseInFrame")
"""Message types that contain a time stamp."""
KEPT_TOPICS = (LABELS, CALIBRATION, CAUSES)
"""Topics whose messages are kept in memory."""

FIRST_VALUES, FIRST_IMAGES = 20_000, 500
"""Messages of a topic that are enough to doubt what was just written."""

ImageSize = tuple[int, int] | None
"""Width and height of an image; None for data that are not an image."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A problem of a recording.

    Parameters
    ----------
    level
        "error" or "warning".
    topic
        Topic with the problem; empty for the recording as a whole.
    text
        Description in one line.
    """

    level: Literal["error", "warning"]
    topic: str
    text: str

    def to_line(self) -> str:
        """Return the line that is printed."""
        return f"{self.level}: {self.topic + ': ' if self.topic else ''}{self.text}"


@dataclass(slots=True)
class CheckData:
    """Data collected from a recording.

    Parameters
    ----------
    contents
        The recording, with labels and calibrations in memory.
    times
        Log times by topic, in file order, or sorted if only the index was read.
    image_times_ns
        Log times of the images, by topic.
    broken
        Error text by topic, for messages that are not of their type.
    sizes
        Number of images of each size, by topic; the size of the first image comes first.
    undecodable_ns
        Log times of the images that cannot be decoded, by topic.
    unset_stamps
        Messages with time stamp 0 and another log time, by topic.
    misfit_grids
        Grid maps whose data are not of the size that they state, by topic.
    values
        Counts of the sensor values.
    motion
        Samples of odometry and poses.
    images
        Samples of the images.
    """

    contents: LoadedRecording
    times: dict[str, TopicTimes]
    image_times_ns: dict[str, list[Ints]] = field(default_factory=lambda: defaultdict(list))
    broken: dict[str, str] = field(default_factory=dict)
    sizes: dict[str, Counter[ImageSize]] = field(default_factory=lambda: defaultdict(Counter))
    undecodable_ns: dict[str, list[int]] = field(default_factory=lambda: defaultdict(list))
    unset_stamps: Counter[str] = field(default_factory=Counter)
    misfit_grids: Counter[str] = field(default_factory=Counter)
    values: ValueCounts = field(default_factory=ValueCounts)
    motion: MotionSamples = field(default_factory=MotionSamples)
    images: ImageSamples = field(default_factory=ImageSamples)

    def add_times(self, topic: str, time_ns: Ints) -> None:
        """Add the next log times of a topic, nanoseconds."""
        self.times[topic].add(time_ns)
        if parse_topic(CAMERA_IMAGE, topic):
            self.image_times_ns[topic].append(time_ns)

    def sort_times(self, topic: str) -> TopicTimes:
        """Read the times of a topic that go back in the file, sorted."""
        found = TopicTimes()
        for _, time_ns in iter_sorted_times(self.contents.path, frozenset([topic])):
            found.add(time_ns)
        return found

    def add_batch(self, topic: str, batch: pa.RecordBatch, total: int) -> None:
        """Add the values of a topic that has ``total`` messages."""
        self.values.add_batch(topic, batch)
        self.motion.add_batch(topic, batch)
        if parse_topic(CAMERA_IMAGE, topic):
            self.images.add_batch(topic, batch, total)
        if parse_topic(GRID, topic):
            self.misfit_grids[topic] += _count_misfit_grids(batch)


def is_decoded(topic: str, info: TopicInfo) -> bool:
    """Return whether a check decodes the messages of a topic, at least their time stamps."""
    own = carries_own_type(topic, info.schema)
    return info.encoding == "protobuf" and (own or _is_stamped(info.schema))


def collect(path: Path) -> CheckData:
    """Collect all data, decoding every message once.

    Raises
    ------
    RecordingError
        If the file is not a complete recording.
    """
    contents = LoadedRecording(path)
    data = CheckData(contents, {topic: TopicTimes() for topic in contents.topics})
    kept: dict[str, list[MessageBatch]] = {t: [] for t in contents.topics if _is_kept(contents, t)}
    channels: dict[int, Channel] = {}
    for batch, channels in join_batches(iter_batches_in_file_order(path)):
        for topic, mine in group_by_topic(batch, channels).items():
            data.add_times(topic, mine.time_ns)
            if topic in kept:
                kept[topic].append(mine.compact())
            _collect_from_messages(data, topic, mine, channels)
    parts = [block for batches in kept.values() for block in batches]
    contents.add_topics(frozenset(kept), parts, channels)
    return data


def collect_from_index(contents: LoadedRecording) -> CheckData:
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
    data = CheckData(contents, {topic: TopicTimes() for topic in contents.topics})
    for topic, time_ns in iter_sorted_times(contents.path, frozenset(data.times)):
        data.add_times(topic, time_ns)
    return data


def collect_values(data: CheckData) -> None:
    """Add the first values of sensors and poses, and samples of the first images, of each topic."""
    for topic, info in data.contents.topics.items():
        own, seen = carries_own_type(topic, info.schema), 0
        is_image = parse_topic(CAMERA_IMAGE, topic) is not None
        if not own or not (is_image or any(parse_topic(p, topic) for p in FINITE_TOPICS)):
            continue
        if is_image:
            find_first_size(data, topic)
        limit, fields = (FIRST_IMAGES, ["data"]) if is_image else (FIRST_VALUES, None)
        for batch in iter_columns(data.contents.path, topic, fields=fields):
            seen += len(batch)
            data.add_batch(topic, batch, min(info.count, limit))
            if seen >= limit:
                break


def find_first_size(data: CheckData, topic: str) -> ImageSize:
    """Return the size of the first image of a topic; None without an image."""
    if topic not in data.sizes and len(data.times[topic]):
        image = next(iter_columns(data.contents.path, topic, fields=["data"]))
        data.sizes[topic][_decode_size(image["data"][0].as_buffer())] += 1
    return next(iter(data.sizes[topic]), None)


def _is_kept(contents: LoadedRecording, topic: str) -> bool:
    of_kind = any(parse_topic(pattern, topic) for pattern in KEPT_TOPICS)
    return of_kind and carries_own_type(topic, contents.topics[topic].schema)


def _collect_from_messages(
    collected: CheckData, topic: str, messages: MessageBatch, channels: dict[int, Channel]
) -> None:
    """Decode messages of a topic of dmrl's, and collect their data."""
    path, schema = collected.contents.path, collected.contents.topics[topic].schema
    stamped, own = _is_stamped(schema), carries_own_type(topic, schema)
    if topic in collected.broken or not (own or stamped):
        return
    fields = None if own else ["timestamp"]
    try:
        batch = decode_topic(path, topic, messages, channels, fields)
    except RecordingError as e:
        if fields is None:
            collected.broken[topic] = str(e)
        return
    names = batch.schema.names
    if stamped and "timestamp" in names and pa.types.is_struct(batch["timestamp"].type):
        collected.unset_stamps[topic] += _count_unset_stamps(batch)
    if own:
        collected.add_batch(topic, batch, collected.contents.topics[topic].count)
    if own and parse_topic(CAMERA_IMAGE, topic):
        for time_ns, data in zip(batch["log_time"].to_pylist(), batch["data"], strict=True):
            size = _decode_size(data.as_buffer())
            collected.sizes[topic][size] += 1
            if size is None:
                collected.undecodable_ns[topic].append(time_ns)


def _is_stamped(schema: str) -> bool:
    return schema.rpartition(".")[2] in STAMPED_TYPES


def _count_unset_stamps(batch: pa.RecordBatch) -> int:
    """Count the messages with time stamp 0 and another log time."""
    stamp = batch["timestamp"]
    seconds, nanos = (to_numpy(stamp.field(name)) for name in ("seconds", "nanos"))
    # A message without a stamp is not counted.
    wrong = to_numpy(stamp.is_valid()) & (seconds == 0) & (nanos == 0)
    return int((wrong & (to_numpy(batch["log_time"]) != 0)).sum())


def _count_misfit_grids(batch: pa.RecordBatch) -> int:
    """Count the grid maps that do not have 4 bytes for each cell of each channel."""
    rows, cols = (to_numpy(batch[name]).astype(float) for name in ("rows", "cols"))
    channels = to_numpy(pc.list_value_length(batch["channels"]))
    return int((to_numpy(pc.binary_length(batch["data"])) != 4 * rows * cols * channels).sum())


def _decode_size(data: pa.Buffer) -> ImageSize:
    try:
        width_px, height_px, _ = read_size(data.to_pybytes())
        if not is_decodable(data.to_pybytes()):
            return None
    except (DmrlError, ValueError):
        return None
    return width_px, height_px
