"""Do the times of a recording belong together? Topic and text of what does not."""

from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from dmrl.recording.check_seen import Seen
from dmrl.topics import CALIBRATION, TRANSFORMS, names

Times = Mapping[str, NDArray[np.int64]]
Found = Iterator[tuple[str, str]]

EPOCH_NS = 10**18
"""Times from here on count from 1970: it is 2001."""
SPARSE = 2
"""Topics with fewer messages tell nothing of a clock."""


def clocks(seen: Seen) -> Found:
    """Robots, or topics of a robot, that share no time; times and stamps of 0."""
    times = {topic: np.sort(t) for topic, t in seen.times.items() if len(t)}
    yield from _zeros(times)
    yield from _apart(times)
    for topic, wrong in seen.unset.items():
        if wrong:
            yield topic, f"{wrong} messages have a time stamp of 0"


def _zeros(times: Times) -> Found:
    if not times or max(int(t[-1]) for t in times.values()) < EPOCH_NS:
        return
    for topic, moments in times.items():
        if zeros := int((moments == 0).sum()):
            yield topic, f"{zeros} messages are at time 0, others of the recording after 2001"


def _apart(times: Times) -> Found:
    robots: dict[str, dict[str, tuple[int, int]]] = {}
    for topic, moments in times.items():
        root, _, rest = topic.partition("/")
        robot = rest.split("/")[0]
        moments = moments[moments > 0]  # those at 0 are said already
        if root or topic == TRANSFORMS or len(moments) < SPARSE or names(CALIBRATION, topic):
            continue  # a stranger's topic without a robot in front has no clock to compare
        robots.setdefault(robot, {})[topic] = (int(moments[0]), int(moments[-1]))
    for spans in robots.values():
        for topic, span in spans.items():
            others = [other for name, other in spans.items() if name != topic]
            gap_s = _gap_s(span, _around(others)) if others else 0.0
            if gap_s > 0:
                yield topic, f"shares no time with the robot's other topics: {gap_s:.0f} s between"
    whole = {robot: _around(list(spans.values())) for robot, spans in robots.items()}
    for one, other in combinations(sorted(whole), 2):
        gap_s = _gap_s(whole[one], whole[other])
        if gap_s > 0:
            yield (
                f"/{one}",
                f"shares no time with /{other}: {gap_s:.0f} s between. Clocks of their own? "
                "Try: dmrl align",
            )


def _around(spans: list[tuple[int, int]]) -> tuple[int, int]:
    return min(first for first, _ in spans), max(last for _, last in spans)


def _gap_s(one: tuple[int, int], other: tuple[int, int]) -> float:
    """Seconds between two stretches of time; 0 or less where they overlap."""
    return (max(one[0], other[0]) - min(one[1], other[1])) * 1e-9
