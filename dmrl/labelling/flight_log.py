"""One flight as arrays: everything that labelling takes from a recording, read once.

Times are log times in nanoseconds. Values have the units and frames of their topics.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from dmrl import topics
from dmrl.estimation.model.pair import Array
from dmrl.guards.memory import return_freed_memory
from dmrl.labelling.peer_positions import PeerPositions
from dmrl.recording import LoadedRecording, Stamped, TopicInfo
from dmrl.recording.protobuf.arrow_arrays import to_numpy
from dmrl.storage.shared_file import share_file

SENSOR_FIELDS = {
    topics.ATTITUDE: ("roll_rad", "pitch_rad", "yaw_rate_radps"),
    topics.VELOCITY: ("vx_mps", "vy_mps"),
    topics.HEIGHT: ("height_m",),
    topics.RANGE: ("range_m",),
}
"""Columns of the sensors' samples, by pattern of topics."""
SENSOR_TOPICS = tuple(SENSOR_FIELDS)
"""Topics that positions are estimated from."""
OBSERVER_TOPICS = (topics.DETECTIONS, topics.CALIBRATION, *SENSOR_TOPICS)
"""Topics that an observer's log is made of."""
TRUTH_TOPICS = (topics.TRUTH, topics.TRUE_POSE)
"""Topics that hold true positions."""

POSITION_FIELDS = ("x", "y", "z", "covariance", "status")
COLUMN_FIELDS = {
    **SENSOR_FIELDS,
    topics.POSITION: POSITION_FIELDS,
    topics.TRUTH: POSITION_FIELDS,
    topics.TRUE_POSE: ("pose",),
}
"""Fields of the topics with one row a message, by pattern of topics."""

Times = NDArray[np.int64]
RobotPair = tuple[str, str]
"""An observer and its peer."""


class Samples(NamedTuple):
    """Messages of one topic: (N,) log times and (N, C) values.

    ``set_back`` is the number of messages that were published a second before the previous one.
    """

    time_ns: Times
    set_back: int
    values: Array


class DetectionTable(NamedTuple):
    """Detections of one robot's images.

    ``time_ns`` (K,) log times of the images, ``threshold`` (K,) the detector's least confidence,
    ``first`` (K + 1,) row of each image's first detection and the end, ``rows`` (M, 5) u, v in
    pixels, depth, its standard deviation in metres (0: unknown) and confidence. ``rates`` holds the
    fields of the first message's DetectorRates, None without one.
    """

    time_ns: Times
    threshold: Array
    first: Times
    rows: Array
    rates: dict[str, Any] | None


@dataclass(frozen=True, slots=True)
class FlightLog:
    """The topics of a recording as arrays, by robot or by pair of robots.

    A topic that the recording lacks, or that was not asked for, has no entry.

    Parameters
    ----------
    path
        The recording.
    topics
        All topics of the recording, read or not.
    start_ns
        First log time of the recording.
    metadata
        Named strings of the recording.
    attitude, velocity, height
        Columns: roll, pitch (rad), yaw rate (rad/s); forward, left (m/s); metres.
    ranges
        Distances of both directions, metres, by the robot that measured and the other.
    images_ns
        Log times of the images.
    image_size_px
        Width and height of the first image.
    calibrations
        The first CameraCalibration message.
    detections
        Detections of all images.
    labels, tracks
        PeerLabels and Tracks messages, in time order.
    positions, true_positions
        Estimated and true positions; the covariance is NaN where the message has none.
    true_poses
        Columns: x, y, z in the world, metres, and the quaternion x, y, z, w.
    transforms
        FrameTransforms messages, in time order.
    """

    path: Path
    topics: Mapping[str, TopicInfo]
    start_ns: int
    metadata: Mapping[str, list[dict[str, str]]] = field(default_factory=dict)
    attitude: dict[str, Samples] = field(default_factory=dict)
    velocity: dict[str, Samples] = field(default_factory=dict)
    height: dict[str, Samples] = field(default_factory=dict)
    ranges: dict[RobotPair, Samples] = field(default_factory=dict)
    images_ns: dict[str, Times] = field(default_factory=dict)
    image_size_px: dict[str, tuple[int, int]] = field(default_factory=dict)
    calibrations: dict[str, Any] = field(default_factory=dict)
    detections: dict[str, DetectionTable] = field(default_factory=dict)
    labels: dict[str, list[Stamped]] = field(default_factory=dict)
    tracks: dict[str, list[Stamped]] = field(default_factory=dict)
    positions: dict[RobotPair, PeerPositions] = field(default_factory=dict)
    true_positions: dict[RobotPair, PeerPositions] = field(default_factory=dict)
    true_poses: dict[str, Samples] = field(default_factory=dict)
    transforms: list[Stamped] = field(default_factory=list)

    def to_seconds(self, time_ns: Times) -> Array:
        """Return log times as seconds since the start of the recording."""
        return np.asarray((time_ns - self.start_ns) * 1e-9)


def read_flight(path: Path, *wanted: str, sizes_of: Collection[str] = ()) -> FlightLog:
    """Read some topics of a recording in one pass.

    Parameters
    ----------
    path
        A complete recording.
    wanted
        Patterns of topics: rows of `READERS`, ``topics.TRANSFORMS``, and ``topics.CAMERA_IMAGE``
        for the times of the images. Without any, all of these.
    sizes_of
        Robots whose first image is opened for its size.

    Raises
    ------
    RecordingError
        If the recording is not complete, or a topic carries another message.
    SourceError
        If the first image of such a robot is broken.
    """
    wanted = wanted or (*READERS, topics.CAMERA_IMAGE, topics.TRANSFORMS)
    with share_file(path):
        columns = {
            pattern: COLUMN_FIELDS[pattern] for pattern in wanted if pattern in COLUMN_FIELDS
        }
        messages = [p for p in wanted if p not in columns and p != topics.CAMERA_IMAGE]
        held = LoadedRecording(path, *messages, columns=columns)
        log = to_flight_log(held, *wanted)
        images = _find_topics(log.topics, topics.CAMERA_IMAGE)
        if topics.CAMERA_IMAGE in wanted:
            log.images_ns.update({robot: held.get_times(topic) for robot, topic in images.items()})
        for robot in images.keys() & sizes_of:
            if (size_px := held.read_image_size(images[robot])) is not None:
                log.image_size_px[robot] = size_px
    del held
    return_freed_memory()
    return log


def to_flight_log(held: LoadedRecording, *wanted: str) -> FlightLog:
    """Convert loaded topics of a recording to arrays.

    Parameters
    ----------
    held
        The recording, best with the wanted topics loaded.
    wanted
        Rows of `READERS`, or ``topics.TRANSFORMS``.
    """
    log = FlightLog(held.path, held.topics, held.start_ns, held.summary.metadata)
    for pattern in wanted:
        if pattern in READERS:
            name, convert = READERS[pattern]
            for key, topic in _find_topics(held.topics, pattern).items():
                if (made := convert(held, topic)) is not None:
                    getattr(log, name)[key] = made
    if topics.TRANSFORMS in wanted and topics.TRANSFORMS in held.topics:
        log.transforms.extend(held.iter_messages(topics.TRANSFORMS))
    return log


def _find_topics(held: Collection[str], pattern: str) -> dict[Any, str]:
    """Return the topics of a pattern by robot, or by observer and peer."""
    found = {}
    for topic in held:
        if names := topics.parse_topic(pattern, topic):
            found[(names["robot"], names["peer"]) if "peer" in names else names["robot"]] = topic
    return found


def _to_samples(table: pa.Table, columns: list[Any]) -> Samples:
    values = np.column_stack([to_numpy(column) for column in columns]).astype(float)
    # Messages are in log-time order; their order of arrival shows a clock that was set back.
    set_back = int((np.diff(to_numpy(table["publish_time"])) < -1_000_000_000).sum())
    return Samples(to_numpy(table["log_time"]), set_back, values)


def _sample_reader(pattern: str) -> Callable[[LoadedRecording, str], Samples]:
    """Return a function that reads the fields of a sensor's topic."""
    fields = SENSOR_FIELDS[pattern]

    def read_samples(held: LoadedRecording, topic: str) -> Samples:
        table = held.get_table(topic, fields)
        return _to_samples(table, [table[name] for name in fields])

    return read_samples


def _read_poses(held: LoadedRecording, topic: str) -> Samples:
    table = held.get_table(topic, COLUMN_FIELDS[topics.TRUE_POSE])
    pose = pa.Table.from_struct_array(table["pose"])
    place, turn = (pa.Table.from_struct_array(pose[n]) for n in ("position", "orientation"))
    return _to_samples(table, [place[n] for n in "xyz"] + [turn[n] for n in "xyzw"])


def _read_positions(held: LoadedRecording, topic: str) -> PeerPositions:
    """Read PeerPosition messages; a covariance that is missing becomes NaN."""
    table = held.get_table(topic, POSITION_FIELDS)
    lists = table["covariance"]
    lengths = to_numpy(pc.list_value_length(lists))
    full = lengths == 9
    covariance = np.broadcast_to(np.nan, (len(table), 9))
    if full.any():  # ground truth has none, and an hour of it is 100,000 positions
        covariance = covariance.copy()
        flat = to_numpy(pc.list_flatten(lists))
        covariance[full] = flat[np.repeat(full, lengths)].reshape(-1, 9)
    return PeerPositions(
        to_numpy(table["log_time"]),
        np.column_stack([to_numpy(table[axis]) for axis in "xyz"]),
        covariance.reshape(-1, 3, 3),
        to_numpy(table["status"]),
    )


def _read_detections(held: LoadedRecording, topic: str) -> DetectionTable:
    table = held.get_table(topic).combine_chunks()
    lists = table["detections"].combine_chunks()
    if hasattr(lists, "chunks"):
        lists = lists.chunk(0)
    flat = lists.flatten()
    known = {column.name for column in flat.type}  # recordings of before have no sigma
    zero = np.zeros(len(flat))
    rows = [
        to_numpy(flat.field(n)) if n in known else zero
        for n in ("u_px", "v_px", "depth_m", "sigma_depth_m", "confidence")
    ]
    threshold = np.array(to_numpy(table["threshold"]))
    first = to_numpy(lists.offsets) - lists.offsets[0].as_py()
    columns = to_numpy(table["log_time"]), threshold, first, np.column_stack(rows)
    return DetectionTable(*columns, _read_rates(_read_first(held, topic)))


def _read_rates(message: Any) -> dict[str, Any] | None:
    """Return the detector's rates in a Detections message; recordings of before have none."""
    rates = getattr(message, "rates", None)
    if rates is None or not message.HasField("rates"):
        return None
    return {
        field.name: tuple(value)
        if isinstance(value := getattr(rates, field.name), Sequence)
        else value
        for field in rates.DESCRIPTOR.fields
    }


def _read_first(held: LoadedRecording, topic: str) -> Any:
    first = next(held.iter_messages(topic), None)
    return None if first is None else first.message


def _read_messages(held: LoadedRecording, topic: str) -> list[Stamped]:
    return list(held.iter_messages(topic))


READERS: dict[str, tuple[str, Callable[[LoadedRecording, str], Any]]] = {
    topics.ATTITUDE: ("attitude", _sample_reader(topics.ATTITUDE)),
    topics.VELOCITY: ("velocity", _sample_reader(topics.VELOCITY)),
    topics.HEIGHT: ("height", _sample_reader(topics.HEIGHT)),
    topics.RANGE: ("ranges", _sample_reader(topics.RANGE)),
    topics.CALIBRATION: ("calibrations", _read_first),
    topics.DETECTIONS: ("detections", _read_detections),
    topics.LABELS: ("labels", _read_messages),
    topics.TRACKS: ("tracks", _read_messages),
    topics.POSITION: ("positions", _read_positions),
    topics.TRUTH: ("true_positions", _read_positions),
    topics.TRUE_POSE: ("true_poses", _read_poses),
}
"""By pattern of topics: the field of `FlightLog`, and the function that reads a topic."""
