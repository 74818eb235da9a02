"""Checks of clocks, on given time spans."""

from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest

from dmrl.recording.checks.clock_checks import UNIX_TIME_MIN_NS, check_clocks
from dmrl.recording.checks.topic_times import TopicTimes

S = 1_000_000_000


def find_clock_findings(times: dict[str, list[float]], **unset: int) -> list[tuple[str, str]]:
    """Return the findings about topics with messages at these times, in seconds."""
    held = {
        topic: TopicTimes.of(np.round(np.array(t) * S).astype(np.int64))
        for topic, t in times.items()
    }
    seen = SimpleNamespace(times=held, unset_stamps=Counter(unset))
    return list(check_clocks(seen))  # type: ignore[arg-type]


def test_spans_that_touch_or_overlap_share_a_time() -> None:
    for start_s, apart in ((5, False), (10, False), (10.5, True)):
        found = find_clock_findings(
            {"/cf1/height": [1, 10], "/cf2/height": [start_s, 20], "/cf1/x": [2, 3]}
        )
        assert bool(found) == apart
    assert found[0][0] == "/cf1" and "shares no time with /cf2: 0 s between" in found[0][1]


def test_the_gap_is_from_the_end_of_one_to_the_start_of_the_other() -> None:
    for one, other in (("cf1", "cf2"), ("cf2", "cf1")):
        times = {f"/{one}/height": [1, 4, 10], f"/{other}/height": [47, 50]}
        ((where, text),) = find_clock_findings(times)
        assert where == "/cf1" and "with /cf2: 37 s between" in text
    three = {f"/cf{k}/height": [100 * k, 100 * k + 10] for k in (1, 2, 3)}
    assert [(where, text.split(":")[0][-4:]) for where, text in find_clock_findings(three)] == [
        ("/cf1", "/cf2"),
        ("/cf1", "/cf3"),
        ("/cf2", "/cf3"),
    ]


def test_topic_that_shares_no_time_with_its_robot_is_named() -> None:
    found = find_clock_findings(
        {"/cf1/height": [1, 5], "/cf1/velocity": [30, 40], "/cf1/range/cf2": [3, 20]}
    )
    assert [where for where, _ in found] == ["/cf1/velocity"]
    assert "10 s between" in found[0][1]


@pytest.mark.parametrize("topic", ["/cf1/camera/calibration", "/tf", "height", "/cf1/velocity"])
def test_topics_without_a_robot_clock_are_not_compared(topic: str) -> None:
    """Calibrations, transforms and unknown topics have no robot clock."""
    moments = [90.0] if topic == "/cf1/velocity" else [90, 95]
    assert find_clock_findings({"/cf1/height": [1, 5], topic: moments}) == []
    assert find_clock_findings({"/cf1/height": [1, 5], topic: []}) == []


def test_zero_times_are_reported_beside_unix_times() -> None:
    late = UNIX_TIME_MIN_NS / S
    for last, count in ((late, 1), (late - 1, 0)):
        found = find_clock_findings(
            {"/cf1/height": [0, last - 5, last], "/cf1/velocity": [last - 5, last]}
        )
        assert len(found) == count
    ((where, text),) = find_clock_findings({"/cf1/height": [0, 0, late, late + 1]})
    assert (where, text.split()[0]) == ("/cf1/height", "2")
    assert find_clock_findings({}) == []


def test_messages_without_a_stamp_are_counted() -> None:
    assert find_clock_findings({}, pose=3, other=0) == [
        ("pose", "3 messages have a time stamp of 0")
    ]
