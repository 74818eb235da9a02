"""Writer of recordings: messages by topic and fields, images as arrays."""

from collections.abc import Mapping
from threading import Lock
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dmrl import topics
from dmrl.api.recordings import PathLike, Recording
from dmrl.errors import RecordingError, SettingError
from dmrl.geometry.camera_file import find_camera, warn_of_mount
from dmrl.geometry.frames import Camera
from dmrl.guards import limits
from dmrl.guards.safe_names import check_topic_part
from dmrl.images.codec import encode_jpeg, encode_png
from dmrl.messages import message_class
from dmrl.recording import RecordingWriter, build_provenance
from dmrl.samples import sample
from dmrl.storage import to_path

LATEST_TIME_S = 9.2e9
"""Beyond it whole nanoseconds do not fit into 64 bits; seconds, the year 2261."""


@runtime_checkable
class HasFields(Protocol):
    """A message of a recording."""

    DESCRIPTOR: Any

    def SerializeToString(self) -> bytes:  # noqa: N802 - protobuf's name
        """Return the message as bytes."""


def _copy_message(given: HasFields, kind: str) -> Any:
    """Return a copy of a message. Raise TypeError if it is of another kind."""
    wanted = message_class(kind)
    if given.DESCRIPTOR.full_name != wanted.DESCRIPTOR.full_name:
        raise TypeError(f"not a {given.DESCRIPTOR.full_name}")
    return wanted.FromString(given.SerializeToString())


class Writer:
    """Writes a recording, which gets its name when the ``with`` block ends without an error.

    Threads may share it.

    Parameters
    ----------
    path
        File to write. Must not exist.
    settings
        Plain values for the provenance, such as the source of the data.

    Raises
    ------
    OutputError
        If the file exists, is not called ``.mcap``, or cannot be written.
    """

    def __init__(self, path: PathLike, settings: Mapping[str, Any]) -> None:
        self.path = to_path(path)
        self._is_open, self._done = False, False
        self._lock = Lock()
        self._sink = RecordingWriter(self.path, build_provenance("python", dict(settings)))

    def write(self, topic: str, time_s: float, fields: Mapping[str, Any] | HasFields) -> None:
        """Append a message. Times need not increase.

        Parameters
        ----------
        topic
            One of dmrl's, such as ``/cf1/height``; README.md has the table.
        time_s
            The sensor's time, seconds from 0.
        fields
            Of the message, as in its schema: ``{"height_m": 0.4}``. A message within is a
            mapping, a repeated one a list of mappings. Or a message of another recording.

        Raises
        ------
        RecordingError
            If dmrl has no such topic, its message no such field, or no recording such a time.
        UnsafeName
            If the name of a robot in the topic cannot be one.
        SettingError
            Outside of the ``with`` block.
        """
        kind, (time_ns,) = _find_message(topic), self._log_times(topic, [time_s])
        try:
            if isinstance(fields, HasFields):
                made = _copy_message(fields, kind)
            else:
                made = message_class(kind)(**fields)
                _require_values(made.DESCRIPTOR, fields)
        except (TypeError, ValueError) as e:
            raise self._misfit_error(topic, kind, e) from e
        with self._lock:
            self._sink.write(int(time_ns), topic, made)

    def write_columns(self, topic: str, time_s: ArrayLike, fields: Mapping[str, ArrayLike]) -> None:
        """Append many messages of one topic.

        Parameters
        ----------
        topic, time_s, fields
            As `write` takes them; times (N,), and of each field (N, ...).

        Raises
        ------
        RecordingError
            As `write`.
        SettingError
            If a column is not as long as the times.
        """
        times = self._to_seconds(topic, time_s)
        columns = {name: _to_column(topic, name, values) for name, values in fields.items()}
        if wrong := [name for name, column in columns.items() if len(column) != len(times)]:
            raise SettingError(
                f"{topic}: {len(columns[wrong[0]])} values of {wrong[0]} at {len(times)} times. "
                "Give as many of each"
            )
        if any(column.dtype.kind not in "biufUS" for column in columns.values()):
            rows = zip(*(column.tolist() for column in columns.values()), strict=True)
            for time, row in zip(times.tolist(), rows, strict=True):
                self.write(topic, time, dict(zip(columns, row, strict=True)))
            return
        kind, time_ns = _find_message(topic), self._log_times(topic, times)
        try:
            with self._lock:
                self._sink.write_columns(topic, message_class(kind), time_ns, columns)
        except (TypeError, ValueError) as e:
            raise self._misfit_error(topic, kind, e) from e

    def image(
        self, robot: str, time_s: float, rgb: NDArray[np.uint8], *, quality: int | None = None
    ) -> None:
        """Append an image.

        Parameters
        ----------
        robot
            Robot that carries the camera.
        time_s
            Time of its exposure, seconds.
        rgb
            (H, W, 3) uint8, or (H, W) grey.
        quality
            Of a JPEG, 1 to 100. None: PNG, which loses nothing.

        Raises
        ------
        SettingError
            If it is no image, or has more pixels than dmrl reads.
        """
        rgb = np.asarray(rgb)
        grey = rgb.ndim == 2
        coloured = rgb.ndim == 3 and rgb.shape[2] == 3
        if rgb.dtype != np.uint8 or not (grey or coloured) or not rgb.size:
            raise SettingError(
                f"image of {robot}: shape {rgb.shape}, type {rgb.dtype}. Give (H, W, 3), uint8"
            )
        height_px, width_px = rgb.shape[:2]
        if max(height_px, width_px) > limits.SIDE_PX or height_px * width_px > limits.PIXELS:
            raise SettingError(
                f"image of {robot}: {width_px} x {height_px} px are more than a recording may "
                "hold. Scale it"
            )
        if quality is not None and quality not in range(1, 101):
            raise SettingError(f"image of {robot}: quality {quality}. Give 1 to 100")
        every = np.repeat(rgb[..., None], 3, axis=2) if grey else rgb
        whole = np.ascontiguousarray(every)
        data = encode_png(whole) if quality is None else encode_jpeg(whole, quality)
        kind = "png" if quality is None else "jpeg"
        (time_ns,) = self._log_times(topics.CAMERA_IMAGE(robot), [time_s])
        with self._lock:
            self._sink.write_sample(sample.build_image(int(time_ns), robot, data, kind))

    def camera(self, robot: str, camera: Camera | PathLike, time_s: float = 0.0) -> None:
        """Append the calibration of a robot's camera: of a camera file, aideck or published.

        Raises
        ------
        SourceError
            If the file cannot be read.
        """
        known = camera if isinstance(camera, Camera) else find_camera(to_path(camera))
        warn_of_mount(robot, known)
        (time_ns,) = self._log_times(topics.CALIBRATION(robot), [time_s])
        with self._lock:
            self._sink.write_sample(sample.build_calibration(int(time_ns), robot, known))

    def _log_times(self, topic: str, time_s: ArrayLike) -> NDArray[np.int64]:
        """Return (N,) log times, nanoseconds."""
        if self._done:
            raise SettingError(f"{self.path} is written. Open another with dmrl.writer")
        if not self._is_open:
            raise SettingError(f"{self.path} is not open. Use: with dmrl.writer(...) as out")
        times = self._to_seconds(topic, time_s)
        if not ((times >= 0) & (times < LATEST_TIME_S)).all():
            wrong = times[~((times >= 0) & (times < LATEST_TIME_S))][0]
            raise RecordingError(
                f"{self.path}: {topic} at {wrong:g} s. Give seconds from 0 to {LATEST_TIME_S:g}"
            )
        return np.rint(times * 1e9).astype(np.int64)

    def _to_seconds(self, topic: str, time_s: ArrayLike) -> NDArray[np.float64]:
        """Return (N,) times; raise RecordingError unless they are numbers."""
        times = np.asarray(time_s)
        if times.ndim != 1 or (times.size and times.dtype.kind not in "biuf"):
            raise RecordingError(f"{self.path}: {topic} at {time_s!r:.80}. Give seconds as numbers")
        return times.astype(float)

    def _misfit_error(self, topic: str, kind: str, error: Exception) -> RecordingError:
        why = str(error).rstrip(".")
        return RecordingError(f"{self.path}: {topic} carries {kind}: {why}. Fix its fields")

    def flush(self) -> None:
        """Write everything so far to the file, so that a killed process loses none of it."""
        with self._lock:
            self._sink.flush()

    def open(self) -> Recording:
        """Open the recording, after the ``with`` block has ended."""
        return Recording(self.path)

    def __enter__(self) -> Self:
        self._sink.__enter__()
        self._is_open = True
        return self

    def __exit__(self, *raised: Any) -> None:
        with self._lock:
            self._done = True
            self._sink.__exit__(*raised)


def writer(path: PathLike, /, **settings: Any) -> Writer:
    """Return a `Writer`, with the same parameters and errors.

    Examples
    --------
    >>> import dmrl
    >>> with dmrl.writer("own.mcap", sensor="my tags") as out:  # doctest: +SKIP
    ...     out.write("/cf1/range/cf2", 0.02, {"range_m": 1.83})
    """
    return Writer(path, settings)


def _to_column(topic: str, name: str, values: ArrayLike) -> NDArray[Any]:
    """Return the values of a field as an array along times; lists of unlike lengths as objects."""
    try:
        column = np.asarray(values)
    except ValueError:
        column = np.fromiter(iter(values), object)  # type: ignore[arg-type]
    if not column.ndim:
        raise SettingError(f"{topic}: one value of {name} at several times. Give one for each")
    return column


def _require_values(kind: Any, fields: Mapping[str, Any]) -> None:
    """Raise ValueError if a field is None that would be stored as 0 or as an empty text."""
    for name, value in fields.items():
        field = kind.fields_by_name[name]
        if value is None and not field.is_repeated and not field.has_presence:
            raise ValueError(f"{name} has no value")
        if field.message_type is not None:
            for one in value if field.is_repeated and value else [value]:
                if isinstance(one, Mapping):
                    _require_values(field.message_type, one)


def _find_message(topic: str) -> str:
    row = topics.find_topic(topic)
    if row is None or row.message.endswith("*"):
        raise RecordingError(
            f"dmrl has no topic {topic} of a known message. Name one of the table in README.md"
        )
    for what, name in (topics.parse_topic(row.pattern, topic) or {}).items():
        check_topic_part(name, what)
    return row.message
