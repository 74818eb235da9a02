"""Which images of which recordings are shown."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter, validators
from numpy.typing import NDArray

from dmrl import topics
from dmrl.errors import RecordingError, SettingError
from dmrl.progress import say
from dmrl.recording import Summary, columns, summary

# Log times below this do not count from 1970 but from the start of a simulation.
DURATION_BELOW_NS = 10 * 365 * 86400 * 10**9

MARKS = (topics.LABELS, topics.DETECTIONS, topics.GRID)

Times = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Settings:
    """What of the recordings is shown.

    Parameters
    ----------
    from_s
        First image shown, seconds from the start of the earliest recording.
    to_s
        First image left out, seconds from the start.
    every
        Show one image in so many, with what belongs to it.
    depth_max_m
        Depth of the last colour of depth maps, metres. The first is 0 m.
    """

    from_s: Annotated[float | None, Parameter(name=["--from-s", "--from"])] = None
    to_s: Annotated[float | None, Parameter(name=["--to-s", "--to"])] = None
    every: Annotated[int, Parameter(validator=validators.Number(gte=1))] = 1
    depth_max_m: Annotated[float, Parameter(validator=validators.Number(gt=0))] = 3.0


@dataclass(frozen=True, slots=True)
class Selection:
    """Recordings, and the log times of the images that are shown.

    Parameters
    ----------
    recordings
        Path to summary.
    start_ns
        Start of the earliest recording.
    image_ns
        Robot to sorted log times, at least one each.
    all_images
        Nothing between the first and the last is left out.
    """

    recordings: Mapping[Path, Summary]
    start_ns: int
    image_ns: Mapping[str, Times]
    all_images: bool

    @property
    def first_ns(self) -> int:
        """Log time of the first image."""
        return min(int(times[0]) for times in self.image_ns.values())

    @property
    def last_ns(self) -> int:
        """Log time of the last image."""
        return max(int(times[-1]) for times in self.image_ns.values())

    @property
    def on_wall_clock(self) -> bool:
        """Whether log times count from 1970."""
        return self.last_ns >= DURATION_BELOW_NS


def select(paths: Sequence[Path], settings: Settings) -> Selection:
    """The images that the settings ask for.

    Raises
    ------
    RecordingError
        If no recording has images, or one cannot be read.
    SettingError
        If no image lies between ``from_s`` and ``to_s``.
    """
    found = {path: summary(path) for path in dict.fromkeys(paths)}
    pairs = [
        (robot, path) for path, kept in found.items() for robot in topics.robots(list(kept.topics))
    ]
    names = ", ".join(str(path) for path in found)
    if not pairs:
        raise RecordingError(
            f"no images (/*/camera/image) in {names}. Name the recording with the images as well"
        )
    _say_blind(found)
    start_ns = min(kept.start_ns for kept in found.values() if kept.count)
    lower_ns, upper_ns = (
        None if s is None else start_ns + round(s * 1e9) for s in (settings.from_s, settings.to_s)
    )
    image_ns: dict[str, Times] = {}
    for robot, path in pairs:
        times = _image_times(path, robot, lower_ns, upper_ns)
        image_ns[robot] = np.union1d(image_ns.get(robot, times), times)
    chosen = {r: times[:: settings.every] for r, times in image_ns.items() if times.size}
    if not chosen:
        length_s = (max(kept.end_ns for kept in found.values()) - start_ns) / 1e9
        raise SettingError(
            f"no image of {names} in that time; it lasts from 0 to {length_s:.3f} s. "
            "Change --from-s or --to-s"
        )
    return Selection(found, start_ns, chosen, settings.every == 1)


def _say_blind(found: Mapping[Path, Summary]) -> None:
    every = [topic for kept in found.values() for topic in kept.topics]
    marked = {r for pattern in MARKS for r in topics.robots(every, pattern)}
    for robot in sorted(marked - set(topics.robots(every))):
        say(f"{robot} has labels or detections but no images: they are not shown")


def at_time(selection: Selection, time_s: float | None) -> Selection:
    """One image of each robot: the one nearest to a time.

    Parameters
    ----------
    selection
        Images to choose from.
    time_s
        Seconds from the start of the earliest recording. None: the first image.
    """
    wanted_ns = selection.first_ns
    if time_s is not None:
        wanted_ns = selection.start_ns + round(time_s * 1e9)
    nearest = {
        robot: times[[np.abs(times - wanted_ns).argmin()]]
        for robot, times in selection.image_ns.items()
    }
    return Selection(selection.recordings, selection.start_ns, nearest, False)


def _image_times(path: Path, robot: str, start_ns: int | None, end_ns: int | None) -> Times:
    batches = columns(path, topics.camera_image(robot), fields=[], start_ns=start_ns, end_ns=end_ns)
    return np.concatenate([np.zeros(0, np.int64), *(b["log_time"].to_numpy() for b in batches)])
