"""The interface of a format: how to recognise a source, the user's options, and the samples.

A format is one file with two functions, ``can_read(source) -> bool`` and
``load_content(source, options) -> Content``, and a ``FORMAT``, by which `dmrl.formats.registry`
finds it.
"""

from collections import ChainMap, Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, cast

from dmrl.errors import SettingError, SourceError
from dmrl.geometry.frames import Camera
from dmrl.guards import limits
from dmrl.samples.flight import merge_by_time
from dmrl.samples.sample import Columns, Intervals, Sample


@dataclass(frozen=True, slots=True)
class Content:
    """All samples of a source.

    Parameters
    ----------
    samples
        All samples, in log-time order.
    total
        Number of samples; None if it is unknown before they are read.
    split
        Inclusive intervals of log time by split name; empty if the source has no split.
    series, others
        The same samples for fast writing: topics as columns, and the remaining samples in log-time
        order.
    """

    samples: Iterator[Sample]
    total: int | None = None
    split: Intervals = field(default_factory=dict)
    series: tuple[Columns, ...] = ()
    others: Iterator[Sample] = field(default_factory=lambda: iter(()))


def build_content(streams: Iterable[Iterable[Sample]]) -> Content:
    """Build the content of several streams, of which some may be columns.

    The content can be iterated once: either ``samples``, or ``series`` and ``others``.

    Raises
    ------
    SettingError
        If two columns are of the same topic: ``--names`` made one robot of two.
    """
    held = list(streams)
    series = tuple(stream for stream in held if isinstance(stream, Columns))
    refuse_doubles(stream.topic for stream in series)
    others = merge_by_time(stream for stream in held if not isinstance(stream, Columns))
    return Content(merge_by_time(held), series=series, others=others)


def add_names(names: Mapping[str, str], others: Mapping[str, str]) -> Mapping[str, str]:
    """Return new names with others below them; `Names` still sees which are asked for."""
    return ChainMap(cast("dict[str, str]", names), dict(others))  # it is only read


def refuse_doubles(topics: Iterable[str]) -> None:
    """Raise SettingError if two robots of a source would write the same topic."""
    counts = Counter(topics)
    if twice := [topic for topic, count in counts.items() if count > 1]:
        raise SettingError(
            f"two robots of the source, or two logs of one, would write {twice[0]}. "
            "Name the robots: --names. Or remove a log"
        )


class Names(dict[str, str]):
    """New names by old ones, which knows those that a source did not ask for."""

    def __init__(self, names: Mapping[str, str]) -> None:
        super().__init__(names)
        self.unused = set(names)

    def __contains__(self, name: object) -> bool:
        self.unused.discard(name)
        return super().__contains__(name)

    def get(self, name: str, default: Any = None) -> Any:
        """Return the new name."""
        self.unused.discard(name)
        return super().get(name, default)


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a source, given by the user. A format uses those that apply to it.

    Parameters
    ----------
    robot
        Robot that carries the camera, or that wrote the log.
    names
        Names of robots by the names, or numbers, that the source uses for them.
    rate_hz
        Images per second, for a source without times.
    labels
        CSV file with labels; None: the source's own.
    camera
        Camera that took the images as they are stored; None: the source's own.
    size_px
        Width and height to crop and scale images to; None: no change.
    raw
        Grey images are raw images of a colour sensor (RGGB).
    columns
        TOML file that maps the columns of a CSV file; None: not given.
    bits
        Significant bits of 16-bit pixels: 2^bits - 1 becomes 255.
    as_stored
        Do not turn images upright by their EXIF orientation. None: turn those without labels and
        camera, refuse the others.
    robot_width_m
        Width of the robots, metres, from which boxes give depths; None: they give none.
    unlabelled
        Pictures without a label file are not labelled; else they show nobody.
    """

    robot: str = "cf1"
    names: Mapping[str, str] = field(default_factory=dict)
    rate_hz: float = 10.0
    labels: Path | None = None
    camera: Camera | None = None
    size_px: tuple[int, int] | None = None
    raw: bool = False
    columns: Path | None = None
    bits: int = 16
    as_stored: bool | None = None
    robot_width_m: float | None = None
    unlabelled: bool = False

    def refuse(self, name: str, why: str) -> None:
        """Raise SettingError if the user gave an option that has no effect on the source.

        Parameters
        ----------
        name
            Field of this class.
        why
            Reason, as the rest of a sentence: "has no effect on a recorded stream".
        """
        if getattr(self, name) != getattr(Options(), name):
            flags = FLAGS.get(name) or f"--{name.replace('_', '-')}"
            raise SettingError(f"{flags} {why}. Leave it out")


def read_text(path: Path, encoding: str = "utf-8-sig") -> str:
    """Read a text file of a source.

    Raises
    ------
    SourceError
        If it cannot be read, is in another encoding, or is larger than `limits.TEXT_BYTES`.
    """
    try:
        if (size := path.stat().st_size) > limits.TEXT_BYTES:
            raise SourceError(
                f"{path} has {size / limits.MB:.0f} MB, and a text file of this kind may have "
                f"{limits.TEXT_BYTES // limits.MB}. Split it, or leave it out"
            )
        return path.read_text(encoding=encoding)
    except (OSError, UnicodeDecodeError) as e:
        raise SourceError(f"{path} cannot be read as text: {e}. Restore the file") from None


FLAGS = {"size_px": "--width-px and --height-px"}
"""Flags of the options that are not called like them."""
SOURCE_OPTIONS = frozenset({"robot", "names"})
"""Options that a log of robots uses."""


@dataclass(frozen=True, slots=True)
class Format:
    """One foreign format: how to recognise it, and how to read it.

    Parameters
    ----------
    name
        Value of ``--from``.
    what
        Description in a few words: an article and a noun.
    recognises
        Return whether a file or folder appears to have this format. Reads a few bytes only.
    content
        Return the samples of a source.
    uses
        Options that have an effect, by field of `Options`; others are refused. None: all.
    """

    name: str
    what: str
    recognises: Callable[[Path], bool]
    content: Callable[[Path, Options], Content]
    uses: frozenset[str] | None = None

    def refuse_unused(self, options: Options) -> None:
        """Raise SettingError if the user gave an option that this format does not use."""
        for one in fields(options):
            if self.uses is not None and one.name not in self.uses:
                options.refuse(one.name, f"has no effect on {self.what}")
