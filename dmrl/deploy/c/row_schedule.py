"""When every row of a network is made, and how many rows each tensor must hold for that.

After each row of the image the deepest step that has the rows it needs makes one output row, until
none has. `play` plays this through, and what is counted in it is exact.
"""

import itertools
from dataclasses import dataclass

from dmrl.deploy.int8.network import AnyLayer, Conv, MaxPool


@dataclass(frozen=True, slots=True)
class Step:
    """One output row at a time of a layer, or of a convolution and the max-pool after it.

    Parameters
    ----------
    name
        C identifier.
    layer
        What is computed.
    pooled
        Whether a 2x2 max-pool follows within the step.
    sources
        Buffers it reads; it writes the buffer after its own index.
    """

    name: str
    layer: AnyLayer
    pooled: bool
    sources: tuple[int, ...]

    @property
    def stride(self) -> int:
        """Input rows between two output rows."""
        if isinstance(self.layer, Conv):
            return self.layer.stride * (2 if self.pooled else 1)
        return 2 if isinstance(self.layer, MaxPool) else 1

    @property
    def first(self) -> int:
        """First input row that output row 0 reads; negative in the padding."""
        return -self.layer.padding if isinstance(self.layer, Conv) else 0

    @property
    def last(self) -> int:
        """Last input row that output row 0 reads."""
        if isinstance(self.layer, Conv):
            rows = self.layer.dilation * (self.layer.kernel - 1) - self.layer.padding
            return rows + (self.layer.stride if self.pooled else 0)
        return 1 if isinstance(self.layer, MaxPool) else 0


@dataclass(frozen=True, slots=True)
class Write:
    """A row is made.

    Parameters
    ----------
    buffer, row
        Which.
    done
        Rows that each buffer has had before.
    oldest
        First row of each buffer that some step has yet to read; as many as there are: none.
    """

    buffer: int
    row: int
    done: tuple[int, ...]
    oldest: tuple[int, ...]


def play(steps: list[Step], rows: list[int]) -> list[Write]:
    """Every row of an image, in the order in which they are made.

    Parameters
    ----------
    steps
        The steps; step i writes buffer i + 1.
    rows
        Rows of every buffer's tensor.
    """
    done = [0] * len(rows)
    readers = [[k for k, s in enumerate(steps) if b in s.sources] for b in range(len(rows))]
    writes: list[Write] = []

    def oldest_needed(buffer: int) -> int:
        pending = [k for k in readers[buffer] if done[k + 1] < rows[k + 1]]
        starts = [done[k + 1] * steps[k].stride + steps[k].first for k in pending]
        return max(min(starts, default=rows[buffer]), 0)

    def write(buffer: int) -> None:
        oldest = tuple(oldest_needed(b) for b in range(len(rows)))
        writes.append(Write(buffer, done[buffer], tuple(done), oldest))
        done[buffer] += 1

    for _ in range(rows[0]):
        write(0)
        while (step := _deepest_ready(steps, rows, done)) is not None:
            write(step + 1)
    return writes


def _deepest_ready(steps: list[Step], rows: list[int], done: list[int]) -> int | None:
    for index in range(len(steps) - 1, -1, -1):
        step, row = steps[index], done[index + 1]
        if row < rows[index + 1] and all(
            done[k] > min(row * step.stride + step.last, rows[k] - 1) for k in step.sources
        ):
            return index
    return None


def rows_held(writes: list[Write], count: int) -> list[int]:
    """Rows that each of so many buffers holds at a time: from the oldest needed to the newest."""
    rings = [1] * count
    for w in writes:
        rings[w.buffer] = max(rings[w.buffer], w.row + 1 - w.oldest[w.buffer])
    return rings


def needed_together(writes: list[Write]) -> set[tuple[int, int]]:
    """(a, b): a row of b was still needed when a row of a was made."""
    return {
        (w.buffer, other)
        for w in writes
        for other in range(1, len(w.done))
        if other != w.buffer and w.oldest[other] < w.done[other]
    }


def shared_ring(chain: list[int], writes: list[Write]) -> tuple[int, list[int]]:
    """Rows of a ring in which buffers take turns, and the place of row 0 of each.

    Every row of a buffer takes the place of a row of the one before it that is no longer needed:
    the newest such row, so that all that is needed lies close together.

    Parameters
    ----------
    chain
        The buffers, each made from the one before.
    writes
        As `play` gives them.
    """
    behind = {chain[0]: 0}
    for before, buffer in itertools.pairwise(chain):
        lag = max(w.row - w.oldest[before] + 1 for w in writes if w.buffer == buffer)
        behind[buffer] = behind[before] + lag
    ring = max(_span(w, behind) for w in writes if w.buffer in behind)
    return ring, [-behind[buffer] % ring for buffer in chain]


def _span(write: Write, behind: dict[int, int]) -> int:
    """Places from the first to the last that hold a needed row, the one that is made included."""
    places = [write.row - behind[write.buffer]]
    for buffer, lag in behind.items():
        if write.oldest[buffer] < write.done[buffer]:
            places += [write.oldest[buffer] - lag, write.done[buffer] - 1 - lag]
    return max(places) - min(places) + 1
