"""Statistics of the log times of a topic: exact, but the times are not held.

The steps from each time to the next are sorted in blocks. The steps of a periodic topic are few
different ones, which are counted; where they differ, each takes four bytes.
"""

from array import array
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

from dmrl.recording.mcap.message_batch import MAX_TIME_NS, Ints

BLOCK_STEPS = 2**17
"""Steps that are sorted at a time."""


@dataclass(frozen=True, slots=True)
class _Block:
    """Sorted steps.

    Parameters
    ----------
    base_ns
        Nanoseconds to add to each value.
    values
        (N,) steps, nanoseconds: all, or the different ones.
    ends
        (N,) number of steps up to each of the different ones; None if ``values`` are all.
    """

    base_ns: int
    values: NDArray[np.uint32] | Ints
    ends: Ints | None

    def count_to(self, step_ns: int) -> int:
        """Return the number of steps that are at most this long."""
        limits, step_ns = np.iinfo(self.values.dtype), step_ns - self.base_ns
        if step_ns < limits.min:
            return 0
        longest = self.values.dtype.type(min(step_ns, limits.max))
        count = int(self.values.searchsorted(longest, "right"))
        return count if self.ends is None or not count else int(self.ends[count - 1])


def _build_block(steps: Ints) -> _Block:
    """Build the block of some steps, which are sorted in place."""
    steps.sort()
    last = np.flatnonzero(np.append(np.diff(steps) != 0, True))
    repeat = 4 * len(last) <= len(steps)
    values, base = (steps[last] if repeat else steps), int(steps[0])
    narrow = int(steps[-1]) - base <= np.iinfo(np.uint32).max
    values = (values - base).astype(np.uint32) if narrow else values
    return _Block(base if narrow else 0, values, last + 1 if repeat else None)


@dataclass(slots=True)
class TopicTimes:
    """Statistics of the log times of a topic, in the order in which they were added.

    Parameters
    ----------
    count, zeros
        Number of messages, and of those at time 0.
    first_ns, last_ns
        Least log time above 0, and largest, nanoseconds.
    shortest_ns, longest_ns
        Least and largest step, nanoseconds.
    """

    count: int = 0
    zeros: int = 0
    first_ns: int = MAX_TIME_NS
    last_ns: int = 0
    shortest_ns: int = MAX_TIME_NS
    longest_ns: int = -MAX_TIME_NS
    _before: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    _pending: "array[int]" = field(default_factory=lambda: array("q"))
    _blocks: list[_Block] = field(default_factory=list)

    @classmethod
    def of(cls, time_ns: Ints) -> Self:
        """Return the statistics of (N,) log times, nanoseconds."""
        made = cls()
        made.add(time_ns)
        return made

    def __len__(self) -> int:
        return self.count

    def add(self, time_ns: Ints) -> None:
        """Add the (N,) next log times, nanoseconds."""
        if not len(time_ns):
            return
        self.count += len(time_ns)
        self.zeros += int((time_ns == 0).sum())
        self.first_ns = int(time_ns.min(where=time_ns > 0, initial=self.first_ns))
        self.last_ns = max(self.last_ns, int(time_ns.max()))
        steps = np.diff(np.concatenate([self._before, time_ns]))
        self._before = time_ns[-1:].copy()
        self.shortest_ns = int(steps.min(initial=self.shortest_ns))
        self.longest_ns = int(steps.max(initial=self.longest_ns))
        for first in range(0, len(steps), BLOCK_STEPS):
            self._pending.frombytes(steps[first : first + BLOCK_STEPS].tobytes())
            if len(self._pending) >= BLOCK_STEPS:
                self._sort_pending()

    def _sort_pending(self) -> None:
        if self._pending:
            self._blocks.append(_build_block(np.array(self._pending, np.int64)))
            self._pending = array("q")

    def count_steps(self, longest_ns: int) -> int:
        """Return the number of steps that are at most this long; negative ones are included."""
        self._sort_pending()
        return sum(block.count_to(longest_ns) for block in self._blocks)

    def compute_median_step_ns(self, over: int) -> float:
        """Return the median of all steps but the ``over`` shortest, nanoseconds, as NumPy does."""
        rest = self.count - 1 - over
        middle = [self._find_step_ns(over + (rest - odd) // 2) for odd in (1, 0)]
        return float(np.median(middle))

    def _find_step_ns(self, rank: int) -> int:
        """Return the step with so many steps before it, if all are sorted."""
        low, high = self.shortest_ns, self.longest_ns
        while low < high:
            middle = (low + high) // 2
            low, high = (low, middle) if self.count_steps(middle) > rank else (middle + 1, high)
        return low
