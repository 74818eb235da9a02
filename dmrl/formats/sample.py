"""What every format gives: rows for a recording, named but not yet messages.

A format is one file with two functions, ``recognises(source) -> bool`` and
``content(source, options) -> Content``, its ``FORMAT``, and one row in ``dmrl.formats.known``.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dmrl import topics
from dmrl.geometry import Camera
from dmrl.messages import LogType

Intervals = dict[str, list[tuple[int, int]]]


@dataclass(frozen=True, slots=True)
class Sample:
    """One message to be.

    Parameters
    ----------
    time_ns
        Log time: the sensor's, nanoseconds.
    topic
        Where it goes.
    message
        The message, as ``dmrl.messages.message`` takes it: its name, or variables of a log.
    fields
        Its fields; a nested message is a mapping, a repeated one a list of mappings.
    """

    time_ns: int
    topic: str
    message: str | LogType
    fields: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Content:
    """Everything a source holds.

    Parameters
    ----------
    samples
        In log-time order.
    total
        Number of samples; None where it is not known beforehand.
    split
        Inclusive intervals of log time by split name; empty where the source has no split.
    """

    samples: Iterator[Sample]
    total: int | None = None
    split: Intervals = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Options:
    """What the user says of a source. A format takes what it has use for.

    Parameters
    ----------
    robot
        Robot that carries the camera, or whose log it is.
    names
        Names of robots by those, or the numbers, that the source has for them.
    rate_hz
        Pictures per second where the source has no times.
    labels
        CSV file with labels; None: the source's own.
    camera
        Camera that took the pictures as they are stored; None: the source's own.
    size_px
        Width and height to crop and scale pictures to; None: they stay as they are.
    raw
        Grey pictures are as a colour sensor gave them (RGGB).
    """

    robot: str = "cf1"
    names: Mapping[str, str] = field(default_factory=dict)
    rate_hz: float = 10.0
    labels: Path | None = None
    camera: Camera | None = None
    size_px: tuple[int, int] | None = None
    raw: bool = False


@dataclass(frozen=True, slots=True)
class Format:
    """One foreign format: how to know it, how to read it.

    Parameters
    ----------
    name
        As ``--from`` takes it.
    what
        What it is, in a few words: an article and a noun.
    recognises
        Whether a file or folder looks like it; looks at a few bytes only.
    content
        Samples of a source.
    """

    name: str
    what: str
    recognises: Callable[[Path], bool]
    content: Callable[[Path, Options], Content]


def intervals(moments: Iterable[tuple[int, str | None]]) -> Intervals:
    """Inclusive intervals of log time in which every moment has the same split.

    Parameters
    ----------
    moments
        (time_ns, split) in time order; None: in no split.

    Examples
    --------
    >>> intervals([(0, "train"), (1, "train"), (2, None), (3, "train"), (4, "test")])
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


def _stamp(time_ns: int) -> dict[str, int]:
    seconds, nanos = divmod(time_ns, 1_000_000_000)
    return {"seconds": seconds, "nanos": nanos}


def image(time_ns: int, robot: str, data: bytes, kind: str) -> Sample:
    """An encoded picture as foxglove.CompressedImage.

    Parameters
    ----------
    time_ns
        Time of exposure.
    robot
        Robot that carries the camera.
    data
        The encoded picture.
    kind
        "png" or "jpeg".
    """
    fields = {
        "timestamp": _stamp(time_ns),
        "frame_id": f"{robot}/optical",
        "data": data,
        "format": kind,
    }
    return Sample(time_ns, topics.camera_image(robot), "CompressedImage", fields)


def calibration(time_ns: int, robot: str, camera: Camera) -> Sample:
    """A camera as foxglove.CameraCalibration, K and P in pixel-edge coordinates.

    Pixel-edge means that cx and cy are 0.5 px more than in OpenCV, whose first pixel has
    its centre at (0, 0).
    """
    k = camera.image_from_optical
    fields = {
        "timestamp": _stamp(time_ns),
        "frame_id": f"{robot}/optical",
        "width": camera.width_px,
        "height": camera.height_px,
        "distortion_model": "plumb_bob" if camera.distortion else "",
        "D": list(camera.distortion),
        "K": k.ravel().tolist(),
        "R": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "P": [value for row in k.tolist() for value in (*row, 0.0)],
    }
    return Sample(time_ns, topics.calibration(robot), "CameraCalibration", fields)


def labels(
    time_ns: int, robot: str, peers: Sequence[Mapping[str, Any]], sources: Iterable[str]
) -> Sample:
    """All peers of one picture as PeerLabels, and who looked; no peers: "none in view"."""
    fields = {"peers": list(peers), "sources": sorted(sources)}
    return Sample(time_ns, topics.labels(robot), "PeerLabels", fields)
