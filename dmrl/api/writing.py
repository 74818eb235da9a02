"""Writer of recordings: messages by topic and fields, images as arrays."""

from collections.abc import Mapping
from threading import Lock
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dmrl import topics
from dmrl.api.given_values import is_plain, require_values, to_column, to_log_times
from dmrl.api.recordings import PathLike, Recording
from dmrl.errors import RecordingError, SettingError
from dmrl.geometry.camera_file import find_camera, warn_of_mount
from dmrl.geometry.frames import Camera
from dmrl.guards import limits
from dmrl.guards.safe_names import check_topic_part
from dmrl.images.codec import encode_jpeg, encode_png
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, build_provenance
from dmrl.samples import sample
from dmrl.storage import to_path

MISFITS = (TypeError, ValueError, OverflowError)
"""What values that do not fit their fields raise."""


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
    made
        Its provenance; or plain values for one, such as the source of the data.

    Raises
    ------
    OutputError
        If the file exists, is not called ``.mcap``, or cannot be written.
    """

    def __init__(self, path: PathLike, made: Mapping[str, Any] | Provenance) -> None:
        self.path = to_path(path)
        self._is_open, self._done = False, False
        self._lock = Lock()
        if not isinstance(made, Provenance):
            made = build_provenance("python", dict(made))
        self._sink = RecordingWriter(self.path, made)

    def write(
        self,
        topic: str,
        time_s: float | None = None,
        fields: Mapping[str, Any] | HasFields | None = None,
        *,
        time_ns: int | None = None,
    ) -> None:
        """Append a message. Times need not increase.

        Parameters
        ----------
        topic
            One of dmrl's, such as ``/cf1/height``; docs/formats.md has the table.
        time_s
            The sensor's time, seconds of log time: from 0, not from the start of a recording.
        fields
            Of the message, as in its schema: ``{"height_m": 0.4}``. A message within is a
            mapping, a repeated one a list of mappings. Or a message of another recording.
        time_ns
            In place of ``time_s``: whole nanoseconds of log time, as a recording has them.

        Raises
        ------
        RecordingError
            If dmrl has no such topic, its message no such field, or no recording such a time.
        UnsafeName
            If the name of a robot in the topic cannot be one.
        SettingError
            Outside of the ``with`` block, without fields, or without exactly one of the times.
        """
        kind, moment = _find_message(topic), self._log_time(topic, time_s, time_ns)
        made = self._build_message(topic, kind, fields)
        with self._lock:
            self._sink.write(moment, topic, made)

    def write_columns(
        self,
        topic: str,
        time_s: ArrayLike | None = None,
        fields: Mapping[str, ArrayLike] | None = None,
        *,
        time_ns: ArrayLike | None = None,
    ) -> None:
        """Append many messages of one topic: all of them, or none if one does not fit.

        Parameters
        ----------
        topic, time_s, fields, time_ns
            As `write` takes them; times (N,), and of each field (N, ...).

        Raises
        ------
        RecordingError
            As `write`.
        SettingError
            If a column is not as long as the times.
        """
        times = self._log_times(topic, time_s, time_ns)
        if fields is None:
            raise SettingError(f"{self.path}: {topic} without fields. Give a mapping of them")
        columns = {name: to_column(topic, name, values) for name, values in fields.items()}
        if wrong := [name for name, column in columns.items() if len(column) != len(times)]:
            raise SettingError(
                f"{topic}: {len(columns[wrong[0]])} values of {wrong[0]} at {len(times)} times. "
                "Give as many of each"
            )
        kind = _find_message(topic)
        message = message_class(kind)
        if all(is_plain(message.DESCRIPTOR, name, column) for name, column in columns.items()):
            try:
                with self._lock:
                    self._sink.write_columns(topic, message, times, columns)
            except MISFITS as e:
                raise self._misfit_error(topic, kind, e) from e
            return
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        made = [
            self._build_message(topic, kind, dict(zip(columns, row, strict=True))) for row in rows
        ]
        with self._lock:
            for moment, one in zip(times.tolist(), made, strict=True):
                self._sink.write(moment, topic, one)

    def image(
        self,
        robot: str,
        time_s: float | None = None,
        rgb: NDArray[np.uint8] | None = None,
        *,
        quality: int | None = None,
        time_ns: int | None = None,
    ) -> None:
        """Append an image.

        Parameters
        ----------
        robot
            Robot that carries the camera.
        time_s
            Time of its exposure, as `write` takes it.
        rgb
            (H, W, 3) uint8, or (H, W) grey.
        quality
            Of a JPEG, 1 to 100. None: PNG, which loses nothing.
        time_ns
            In place of ``time_s``, as `write` takes it.

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
        moment = self._log_time(topics.CAMERA_IMAGE(robot), time_s, time_ns)
        with self._lock:
            self._sink.write_sample(sample.build_image(moment, robot, data, kind))

    def camera(
        self,
        robot: str,
        camera: Camera | PathLike,
        time_s: float | None = None,
        *,
        time_ns: int | None = None,
    ) -> None:
        """Append the calibration of a robot's camera: of a camera file, aideck or published.

        Its time is that of `write`; without one, 0.

        Raises
        ------
        SourceError
            If the file cannot be read.
        """
        known = camera if isinstance(camera, Camera) else find_camera(to_path(camera))
        warn_of_mount(robot, known)
        if time_s is None and time_ns is None:
            time_ns = 0
        moment = self._log_time(topics.CALIBRATION(robot), time_s, time_ns)
        with self._lock:
            self._sink.write_sample(sample.build_calibration(moment, robot, known))

    def _log_time(self, topic: str, time_s: float | None, time_ns: int | None) -> int:
        seconds, whole = (None if time is None else [time] for time in (time_s, time_ns))
        return int(self._log_times(topic, seconds, whole)[0])

    def _log_times(
        self, topic: str, time_s: ArrayLike | None, time_ns: ArrayLike | None
    ) -> NDArray[np.int64]:
        """Return (N,) log times, nanoseconds."""
        if self._done:
            raise SettingError(f"{self.path} is written. Open another with dmrl.writer")
        if not self._is_open:
            raise SettingError(f"{self.path} is not open. Use: with dmrl.writer(...) as out")
        return to_log_times(f"{self.path}: {topic}", time_s, time_ns)

    def _build_message(
        self, topic: str, kind: str, fields: Mapping[str, Any] | HasFields | None
    ) -> Any:
        """Return the message of a topic; raise RecordingError unless the fields fit."""
        if fields is None:
            raise SettingError(f"{self.path}: {topic} without fields. Give a mapping of them")
        try:
            if isinstance(fields, HasFields):
                return _copy_message(fields, kind)
            message = message_class(kind)
            require_values(message.DESCRIPTOR, fields)
            return message(**fields)
        except MISFITS as e:
            raise self._misfit_error(topic, kind, e) from e

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


def writer(path: PathLike, provenance: Provenance | None = None, /, **settings: Any) -> Writer:
    """Return a `Writer`.

    Parameters
    ----------
    path
        File to write. Must not exist.
    provenance
        Stage, settings and inputs, of `dmrl.plugins.build_provenance`. None: a stage "python".
    **settings
        In place of it: plain values, such as the source of the data.

    Raises
    ------
    SettingError
        If there are both.
    OutputError
        As `Writer`.

    Examples
    --------
    >>> import dmrl
    >>> with dmrl.writer("own.mcap", sensor="my tags") as out:  # doctest: +SKIP
    ...     out.write("/cf1/range/cf2", 0.02, {"range_m": 1.83})
    """
    if provenance is not None and settings:
        raise SettingError(f"{path}: {', '.join(settings)}: give settings to build_provenance")
    return Writer(path, settings if provenance is None else provenance)


def _find_message(topic: str) -> str:
    row = topics.find_topic(topic)
    if row is None or row.message.endswith("*"):
        raise RecordingError(
            f"dmrl has no topic {topic} of a known message. Name one of docs/formats.md"
        )
    for what, name in (topics.parse_topic(row.pattern, topic) or {}).items():
        check_topic_part(name, what)
    return row.message
