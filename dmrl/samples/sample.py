"""A sample: the fields of a message that is not built yet, as formats and simulations yield it."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.geometry.frames import Camera
from dmrl.messages import LogType

LABEL_SOURCES = ("truth", "estimate", "hand", "published")
"""Sources of labels, best first."""
DECIMALS = 8
"""Decimals of computed values: metres, radians and pixels."""
ROWS_PER_SLICE = 256
"""Rows converted to Python numbers at a time, which take ten times the memory of an array."""
Intervals = dict[str, list[tuple[int, int]]]


@dataclass(frozen=True, slots=True)
class Sample:
    """One message that is not built yet.

    Parameters
    ----------
    time_ns
        Log time: the sensor's, nanoseconds.
    topic
        Topic of the message.
    message
        Type for ``dmrl.messages.message_class``: its name, or the variables of a log.
    fields
        Its fields; a nested message is a mapping, a repeated one a list of mappings.
    publish_ns
        Time of reception, nanoseconds; None: unknown, the log time replaces it.
    """

    time_ns: int
    topic: str
    message: str | LogType
    fields: Mapping[str, Any]
    publish_ns: int | None = None


def round_samples(samples: Iterable[Sample]) -> Iterator[Sample]:
    """Round the values of computed samples; see `round_values`."""
    return (replace(one, fields=round_values(one.fields)) for one in samples)


def round_values(value: Any) -> Any:
    """Round computed values, nested in any way, to `DECIMALS`.

    Sines and exponentials differ in their last bits between processors. Values computed
    from them have the same bytes after rounding, but for one in some millions.
    """
    if isinstance(value, float):
        return round(value, DECIMALS) + 0.0  # no negative zero
    if isinstance(value, str | int):  # most of the others; a test for Mapping takes far longer
        return value
    if isinstance(value, Mapping):
        return {name: round_values(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [round_values(inner) for inner in value]
    return value


@dataclass(frozen=True, slots=True)
class Columns:
    """Many samples of one topic: written at once, in a tenth of the time, or one by one.

    Parameters
    ----------
    topic, message
        See `Sample`.
    time_ns
        (N,) log times, nanoseconds.
    fields
        By name: (N,) values, one value for all, or the fields of a nested message.
    """

    topic: str
    message: str | LogType
    time_ns: NDArray[np.int64]
    fields: Mapping[str, Any]

    def __iter__(self) -> Iterator[Sample]:
        rows = _iter_rows(self.fields, len(self.time_ns))
        for moment, fields in zip(_iter_values(self.time_ns), rows, strict=True):
            yield Sample(moment, self.topic, self.message, fields)

    def crop_to_time(self, first_ns: int, end_ns: int) -> "Columns":
        """Return the samples with log times in [first_ns, end_ns)."""
        there = (self.time_ns >= first_ns) & (self.time_ns < end_ns)
        return replace(self, time_ns=self.time_ns[there], fields=_select_rows(self.fields, there))


def _iter_rows(fields: Mapping[str, Any], count: int) -> Iterator[dict[str, Any]]:
    """Yield the fields of one sample after another."""
    columns: list[Iterable[Any]] = []
    for value in fields.values():
        if isinstance(value, Mapping):
            columns.append(_iter_rows(value, count))
        else:
            columns.append(
                _iter_values(value) if isinstance(value, np.ndarray) else repeat(value, count)
            )
    if not columns:
        yield from ({} for _ in range(count))
    for row in zip(*columns, strict=True) if columns else ():
        yield dict(zip(fields, row, strict=True))


def iter_slices(count: int) -> Iterator[slice]:
    """Yield slices of a column, short enough for hundreds of streams in memory."""
    return (slice(first, first + ROWS_PER_SLICE) for first in range(0, count, ROWS_PER_SLICE))


def _iter_values(column: NDArray[Any]) -> Iterator[Any]:
    for part in iter_slices(len(column)):
        yield from column[part].tolist()


def _select_rows(fields: Mapping[str, Any], there: NDArray[np.bool_]) -> dict[str, Any]:
    return {
        name: _select_rows(value, there)
        if isinstance(value, Mapping)
        else value[there]
        if isinstance(value, np.ndarray)
        else value
        for name, value in fields.items()
    }


def find_intervals(moments: Iterable[tuple[int, str | None]]) -> Intervals:
    """Return inclusive intervals of log time in which every moment has the same split.

    Parameters
    ----------
    moments
        (time_ns, split) in time order; None: in no split.

    Examples
    --------
    >>> find_intervals([(0, "train"), (1, "train"), (2, None), (3, "train"), (4, "test")])
    {'train': [(0, 1), (3, 3)], 'test': [(4, 4)]}
    """
    found: Intervals = {}
    last: str | None = None
    for time_ns, split in moments:
        if split is not None and split == last:
            found[split][-1] = (found[split][-1][0], time_ns)
        elif split is not None:
            found.setdefault(split, []).append((time_ns, time_ns))
        last = split
    return found


def to_timestamp(time_ns: int) -> dict[str, int]:
    """Return a time as the fields of a protobuf Timestamp."""
    seconds, nanos = divmod(time_ns, 1_000_000_000)
    return {"seconds": seconds, "nanos": nanos}


def build_image(time_ns: int, robot: str, data: bytes, kind: str) -> Sample:
    """Build a sample of an encoded image, as foxglove.CompressedImage.

    Parameters
    ----------
    time_ns
        Time of exposure.
    robot
        Robot that carries the camera.
    data
        The encoded image.
    kind
        "png" or "jpeg".
    """
    fields = {
        "timestamp": to_timestamp(time_ns),
        "frame_id": f"{robot}/optical",
        "data": data,
        "format": kind,
    }
    return Sample(time_ns, topics.CAMERA_IMAGE(robot), "CompressedImage", fields)


def build_calibration(time_ns: int, robot: str, camera: Camera) -> Sample:
    """Build a sample of a camera, as foxglove.CameraCalibration, K and P in pixel-edge coordinates.

    In pixel-edge coordinates, cx and cy are 0.5 px larger than in OpenCV, where the centre of the
    first pixel is (0, 0).
    """
    k = camera.image_from_optical
    fields = {
        "timestamp": to_timestamp(time_ns),
        "frame_id": f"{robot}/optical",
        "width": camera.width_px,
        "height": camera.height_px,
        "distortion_model": "plumb_bob" if camera.distortion else "",
        "D": list(camera.distortion),
        "K": k.ravel().tolist(),
        "R": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "P": [value for row in k.tolist() for value in (*row, 0.0)],
    }
    return Sample(time_ns, topics.CALIBRATION(robot), "CameraCalibration", fields)


def build_labels(
    time_ns: int, robot: str, peers: Sequence[Mapping[str, Any]], sources: Iterable[str]
) -> Sample:
    """Build the PeerLabels of one image with the labellers as sources; no peers: "none in view"."""
    fields = {"peers": list(peers), "sources": sorted(sources)}
    return Sample(time_ns, topics.LABELS(robot), "PeerLabels", fields)
