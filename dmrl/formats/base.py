"""What a format is: how to know it, what a user says of it, and the samples it gives.

A format is one file with two functions, ``recognises(source) -> bool`` and
``content(source, options) -> Content``, and a ``FORMAT``, by which `dmrl.formats.registry` finds it.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from dmrl.geometry.frames import Camera
from dmrl.samples.flight import in_order
from dmrl.samples.sample import Columns, Intervals, Sample


@dataclass(frozen=True, slots=True)
class Content:
    """Everything a source holds.

    Parameters
    ----------
    samples
        All of it, in log-time order.
    total
        Number of samples; None where it is not known beforehand.
    split
        Inclusive intervals of log time by split name; empty where the source has no split.
    series, others
        The same once more, for whoever writes it fast: topics as columns, and what is not among
        them, in log-time order.
    """

    samples: Iterator[Sample]
    total: int | None = None
    split: Intervals = field(default_factory=dict)
    series: tuple[Columns, ...] = ()
    others: Iterator[Sample] = field(default_factory=lambda: iter(()))


def content_of(streams: Iterable[Iterable[Sample]]) -> Content:
    """What streams hold, of which some may be columns. One of both ways to read it can be taken."""
    held = list(streams)
    series = tuple(stream for stream in held if isinstance(stream, Columns))
    others = in_order(stream for stream in held if not isinstance(stream, Columns))
    return Content(in_order(held), series=series, others=others)


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
    columns
        TOML file that says what the columns of a CSV file are; None: none is given.
    """

    robot: str = "cf1"
    names: Mapping[str, str] = field(default_factory=dict)
    rate_hz: float = 10.0
    labels: Path | None = None
    camera: Camera | None = None
    size_px: tuple[int, int] | None = None
    raw: bool = False
    columns: Path | None = None


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
