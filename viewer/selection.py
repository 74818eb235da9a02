"""Select the recordings, images and time span that are shown."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.errors import RecordingError, SettingError
from dmrl.recording import Summary, read_log_times, read_summary
from dmrl.terminal.progress import say
from dmrl.viewer.settings import Layout, Settings

DURATION_BELOW_NS = 10 * 365 * 86400 * 10**9
"""Log times below this count from the start of a simulation, not from 1970."""

MAX_DROPPED_LEAD_NS = 1_000_000_000
"""Longest lead of measurements before the first image that is left out."""

MARK_TOPICS = (topics.LABELS, topics.DETECTIONS, topics.GRID)
PAIR_SENSOR_TOPICS = tuple(row.pattern for row in topics.PAIR_SENSORS)
PAIR_TOPICS = (*PAIR_SENSOR_TOPICS, topics.POSITION, topics.TRUTH)
FLIGHT_TOPICS = (*PAIR_TOPICS, topics.TRACKS, *(row.pattern for row in topics.OWN_SENSORS))
"""Topics that the layout ``flight`` shows."""

IMAGE_LAYOUTS = ("image", "compare")
"""Layouts that require images."""

MAX_PAIRS = 6
"""Largest number of pairs of robots that are shown without a choice."""

Times = NDArray[np.int64]
Names = tuple[str, str]


@dataclass(frozen=True, slots=True)
class Selection:
    """Recordings, and the images and time span that are shown.

    Parameters
    ----------
    recordings
        Path to summary.
    layout
        Never ``auto``.
    start_ns
        Start of the earliest recording.
    shown_ns
        First log time that is shown, and the first that is not.
    image_ns
        Robot to sorted log times of its images, at least one each.
    all_images
        No image between the first and the last is left out.
    """

    recordings: Mapping[Path, Summary]
    layout: Layout
    start_ns: int
    shown_ns: tuple[int, int]
    image_ns: Mapping[str, Times]
    all_images: bool

    @property
    def images(self) -> int:
        """Number of images."""
        return sum(times.size for times in self.image_ns.values())

    @property
    def last_image_ns(self) -> int:
        """Log time of the last image; without images, of the first message."""
        return max((int(t[-1]) for t in self.image_ns.values()), default=self.shown_ns[0])

    @property
    def zero_ns(self) -> int | None:
        """Log time that is shown as 0 s; None where log times count from 1970: those are dates."""
        return None if self.shown_ns[1] > DURATION_BELOW_NS else self.start_ns

    @property
    def topics(self) -> list[str]:
        """Topics with messages, sorted."""
        return _list_topics(self.recordings)

    def find_names(self, pattern: str) -> list[dict[str, str]]:
        """Return robots and peers of the topics of a pattern that have messages, sorted."""
        names = (topics.parse_topic(pattern, topic) for topic in self.topics)
        return [n for n in names if n is not None]

    def find_pairs(self, robot: str | None) -> list[Names]:
        """Return the pairs of observer and peer; of one observer, if one is named."""
        found = {(n["robot"], n["peer"]) for p in PAIR_TOPICS for n in self.find_names(p)}
        return sorted(pair for pair in found if robot in (None, pair[0]))


def select_recordings(paths: Sequence[Path], settings: Settings) -> Selection:
    """Select recordings, images and time span by the settings.

    Raises
    ------
    RecordingError
        If no recording has data for the layout, or one cannot be read.
    SettingError
        If nothing lies between ``from_s`` and ``to_s``, or the robot is not in the recordings.
    """
    found = {path: read_summary(path) for path in dict.fromkeys(paths)}
    names = ", ".join(str(path) for path in found)
    layout, robots = _choose_layout(_list_topics(found), names, settings)
    whole = _find_extent(found)
    asked = _parse_span(settings, whole)
    image_ns = _load_image_times(found, robots, *asked)
    chosen = {r: times[:: settings.every] for r, times in image_ns.items() if times.size}
    lasts = max(asked[0], whole[0]) < min(asked[1], whole[1])
    if not lasts or (layout in IMAGE_LAYOUTS and not chosen):
        raise SettingError(
            f"no image of {names} in that time; it lasts from 0 to "
            f"{(whole[1] - 1 - whole[0]) / 1e9:.3f} s. Change --from-s or --to-s"
        )
    shown = _display_span(layout, chosen, asked, whole)
    return Selection(found, layout, whole[0], shown, chosen, settings.every == 1)


def _choose_layout(every: list[str], names: str, settings: Settings) -> tuple[Layout, list[str]]:
    """Choose the layout, and the robots whose images are shown."""
    layout = settings.layout if settings.layout != "auto" else _guess_layout(every)
    if layout == "dataset":
        raise SettingError(f"{names}: layout dataset is for datasets. Make one: dmrl dataset")
    robots = _choose_robots(every, names, settings.robot)
    if not robots and (layout in IMAGE_LAYOUTS or not _has_topic(every, FLIGHT_TOPICS)):
        raise RecordingError(
            f"no images (/*/camera/image) in {names}. Name the recording with the images as well"
        )
    if settings.robot is None:
        _report_missing_images(every)
    return layout, robots


def _list_topics(found: Mapping[Path, Summary]) -> list[str]:
    """Return the topics that have messages, sorted."""
    return sorted({t for kept in found.values() for t, info in kept.topics.items() if info.count})


def _find_extent(found: Mapping[Path, Summary]) -> tuple[int, int]:
    """Return the time span [first, end) of all recordings that have messages."""
    held = [kept for kept in found.values() if kept.count]
    return min(kept.start_ns for kept in held), max(kept.end_ns for kept in held) + 1


def _parse_span(settings: Settings, whole: tuple[int, int]) -> tuple[int, int]:
    """Return the requested time span [from, to); by default, that of the recordings."""
    seconds = settings.from_s, settings.to_s
    lower, upper = (
        edge if s is None else whole[0] + _to_nanoseconds(s)
        for s, edge in zip(seconds, whole, strict=True)
    )
    return lower, upper


def _display_span(
    layout: Layout, image_ns: Mapping[str, Times], asked: tuple[int, int], whole: tuple[int, int]
) -> tuple[int, int]:
    """Return the time span [first, end) of images and all other data that are shown."""
    lower, upper = max(asked[0], whole[0]), min(asked[1], whole[1])
    if not image_ns:
        return lower, upper
    first_image = min(int(times[0]) for times in image_ns.values())
    if layout in IMAGE_LAYOUTS:
        # Messages before the first image or after the last belong to no image.
        return first_image, max(int(times[-1]) for times in image_ns.values()) + 1
    # A viewer opens at the start, which should not be empty.
    return (first_image if first_image - lower <= MAX_DROPPED_LEAD_NS else lower), upper


def _to_nanoseconds(seconds: float) -> int:
    if not np.isfinite(seconds):
        raise SettingError(f"{seconds} s is not a time. Give seconds from the start")
    return round(seconds * 1e9)


def _guess_layout(every: Sequence[str]) -> Layout:
    measured = _has_topic(every, (*PAIR_SENSOR_TOPICS, topics.POSITION, topics.TRACKS))
    # Labels and detections need their images, which are in another recording.
    blind = not topics.list_robots(list(every)) and not _has_topic(every, MARK_TOPICS)
    return "flight" if measured or (blind and _has_topic(every, FLIGHT_TOPICS)) else "image"


def _has_topic(every: Iterable[str], patterns: Sequence[str]) -> bool:
    return any(topics.parse_topic(p, topic) for topic in every for p in patterns)


def _choose_robots(every: list[str], names: str, wanted: str | None) -> list[str]:
    """Return the robots with images, or the requested one."""
    robots = topics.list_robots(every)
    if wanted is None:
        return robots
    known = sorted({topic.split("/")[1] for topic in every if topic.count("/") > 1})
    if wanted not in known:
        raise SettingError(f"no robot {wanted} in {names}. It has: {', '.join(known)}")
    return [robot for robot in robots if robot == wanted]


def _report_missing_images(every: list[str]) -> None:
    marked = {r for pattern in MARK_TOPICS for r in topics.list_robots(every, pattern)}
    for robot in sorted(marked - set(topics.list_robots(every))):
        say(f"{robot} has labels or detections but no images: they are not shown")


def select_time(selection: Selection, time_s: float | None) -> Selection:
    """Select one image of each robot, the nearest to a time. Plots keep the whole time span.

    Parameters
    ----------
    selection
        Images to choose from.
    time_s
        Seconds from the start of the earliest recording. None: the first image.
    """
    wanted_ns = min((int(t[0]) for t in selection.image_ns.values()), default=selection.shown_ns[0])
    if time_s is not None:
        wanted_ns = selection.start_ns + _to_nanoseconds(time_s)
    every = selection.image_ns.items()
    nearest = {robot: times[[np.abs(times - wanted_ns).argmin()]] for robot, times in every}
    moment = replace(selection, image_ns=nearest, all_images=False)
    # A screenshot of a layout with plots shows their whole time span.
    if selection.layout != "image":
        return moment
    first = min(int(times[0]) for times in nearest.values())
    return replace(moment, shown_ns=(first, moment.last_image_ns + 1))


def choose_moment_ns(selection: Selection, time_s: float | None) -> int:
    """Return the log time of a screenshot: of the chosen image, or the requested time."""
    if selection.image_ns or time_s is None:
        return selection.last_image_ns
    first, end = selection.shown_ns
    return min(max(selection.start_ns + _to_nanoseconds(time_s), first), end - 1)


def _load_image_times(
    found: Mapping[Path, Summary], robots: Sequence[str], start_ns: int, end_ns: int
) -> dict[str, Times]:
    of_topic = {topics.CAMERA_IMAGE(robot): robot for robot in robots}
    parts: dict[str, list[Times]] = {robot: [np.zeros(0, np.int64)] for robot in robots}
    for path in found:
        for topic, times in read_log_times(
            path, of_topic, start_ns=start_ns, end_ns=end_ns
        ).items():
            parts[of_topic[topic]].append(times)
    return {robot: np.unique(np.concatenate(times)) for robot, times in parts.items()}
