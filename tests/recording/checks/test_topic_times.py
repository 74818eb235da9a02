"""Statistics of log times equal those of NumPy over all times."""

import numpy as np
import pytest
from numpy.typing import NDArray

from dmrl.recording.checks import topic_times
from dmrl.recording.checks.topic_times import TopicTimes

MS = 1_000_000
rng = np.random.default_rng(5)
STEPS = {
    "equal": np.full(1000, 10 * MS),
    "few": rng.choice([9 * MS, 10 * MS, 11 * MS, 3000 * MS], 1000),
    "all different": rng.integers(1, 20 * MS, 1000),
    "back and repeated": rng.integers(-3, 4, 1000),
    "more than four bytes hold": rng.integers(-(2**40), 2**41, 999),
    "one": np.array([7]),
    "the whole range": np.array([2**62, -(2**62), 2**62 - 1, 5, 5, 2 - 2**62] * 5),
}


def add_up(steps: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the times, ns, that these steps lie between, none of them negative."""
    times = np.cumsum(steps, dtype=np.int64)
    times -= min(times.min(), 0)
    return np.concatenate([[0], times])


@pytest.mark.parametrize("size", [1, 7, 10_000])
@pytest.mark.parametrize("kind", STEPS)
def test_statistics_equal_those_of_all_times(
    kind: str, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(topic_times, "BLOCK_STEPS", 64)
    times = add_up(STEPS[kind])
    steps = np.sort(np.diff(times))
    found = TopicTimes()
    for first in range(0, len(times), size):
        found.add(times[first : first + size])
    assert (len(found), found.zeros) == (len(times), (times == 0).sum())
    assert (found.first_ns, found.last_ns) == (times[times > 0].min(), times.max())
    assert (found.shortest_ns, found.longest_ns) == (steps[0], steps[-1])
    for limit in [-1, 0, 1, 2**33, int(np.median(steps)), *steps[:: len(steps) // 7 + 1].tolist()]:
        assert found.count_steps(limit) == np.searchsorted(steps, limit, "right")
    for over in {0, len(steps) // 3, len(steps) - 1}:
        assert found.compute_median_step_ns(over) == np.median(steps[over:])


def test_regular_and_irregular_steps_take_little_memory() -> None:
    count = 4 * topic_times.BLOCK_STEPS + 1
    for steps, most_bytes in ((np.full(count, MS), 100), (rng.integers(0, MS, count), 4 * count)):
        found = TopicTimes.of(add_up(steps))
        held = sum(block.values.nbytes for block in found._blocks)
        assert 0 < held <= most_bytes


def test_a_topic_without_messages_has_no_steps() -> None:
    found = TopicTimes.of(np.empty(0, np.int64))
    assert (len(found), found.zeros, found.count_steps(0)) == (0, 0, 0)
