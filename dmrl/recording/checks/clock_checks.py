"""Check whether the times of a recording fit together. Findings are topic and text."""

from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations

from dmrl.recording.checks.scan import CheckData
from dmrl.recording.checks.topic_times import TopicTimes
from dmrl.topics import CALIBRATION, TRANSFORMS, parse_topic

Times = Mapping[str, TopicTimes]
Problems = Iterator[tuple[str, str]]
Span = tuple[int, int]
"""Log times of a first and a last message, nanoseconds."""

UNIX_TIME_MIN_NS = 10**18
"""Smallest time that counts from 1970, nanoseconds. It is in 2001."""
MESSAGES_MIN = 2
"""Minimum number of messages from which a topic indicates the span of its clock."""


def check_clocks(data: CheckData) -> Problems:
    """Yield robots, or topics of a robot, that share no time; and zero times and stamps."""
    times = {topic: t for topic, t in data.times.items() if len(t)}
    yield from _find_zero_times(times)
    robots = _collect_spans(times)
    for spans in robots.values():
        yield from _find_separate_topics(spans)
    yield from _find_separate_robots(
        {robot: _enclose_spans(spans.values()) for robot, spans in robots.items()}
    )
    for topic, wrong in data.unset_stamps.items():
        if wrong:
            yield topic, f"{wrong} messages have a time stamp of 0"


def _find_zero_times(times: Times) -> Problems:
    if not times or max(t.last_ns for t in times.values()) < UNIX_TIME_MIN_NS:
        return
    for topic, moments in times.items():
        if zeros := moments.zeros:
            yield topic, f"{zeros} messages are at time 0, others of the recording after 2001"


def _collect_spans(times: Times) -> dict[str, dict[str, Span]]:
    """Return the first and last time of each topic, by robot."""
    robots: dict[str, dict[str, Span]] = {}
    for topic, moments in times.items():
        # A topic without a leading robot name has no clock to compare.
        of_a_robot = topic.startswith("/") and topic != TRANSFORMS
        enough = moments.count - moments.zeros >= MESSAGES_MIN  # zeros are reported separately
        if of_a_robot and enough and not parse_topic(CALIBRATION, topic):
            span = moments.first_ns, moments.last_ns
            robots.setdefault(topic.split("/")[1], {})[topic] = span
    return robots


def _find_separate_topics(spans: Mapping[str, Span]) -> Problems:
    """Yield topics that share no time with any other topic of their robot."""
    for topic, span in spans.items():
        others = [other for name, other in spans.items() if name != topic]
        if others and (gap_s := _compute_gap_s(span, _enclose_spans(others))) > 0:
            yield topic, f"shares no time with the robot's other topics: {gap_s:.0f} s between"


def _find_separate_robots(robots: Mapping[str, Span]) -> Problems:
    """Yield pairs of robots that share no time."""
    for one, other in combinations(sorted(robots), 2):
        if (gap_s := _compute_gap_s(robots[one], robots[other])) > 0:
            between = f"shares no time with /{other}: {gap_s:.0f} s between"
            yield f"/{one}", f"{between}. Separate clocks? Try: dmrl align"


def _enclose_spans(spans: Iterable[Span]) -> Span:
    """Return the shortest span that contains all of these."""
    firsts, lasts = zip(*spans, strict=True)
    return min(firsts), max(lasts)


def _compute_gap_s(one: Span, other: Span) -> float:
    """Return the seconds between two spans; 0 or less if they overlap."""
    return (max(one[0], other[0]) - min(one[1], other[1])) * 1e-9
