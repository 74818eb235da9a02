"""Row schedule of a network, and the number of rows that each tensor must keep for it.

After each row of the image, the deepest step with all input rows computes one output row, until no
step can. `schedule_rows` simulates this, so the derived buffer sizes are exact.
"""

import itertools
from dataclasses import dataclass

from dmrl.deploy.int8.layers import AnyLayer, Conv, MaxPool


def slides_along_row(conv: Conv) -> bool:
    """Return whether the C of a convolution slides along the row; it needs no padding columns."""
    same = conv.stride == 1 and conv.padding == conv.dilation
    return conv.depthwise and conv.kernel == 3 and same


@dataclass(frozen=True, slots=True)
class RowReads:
    """Pointers of a step to rows of its first input, in C: pointer k is one kernel row or weight.

    A pointer refers to one row of the kernel, whose columns are adjacent in memory. With dilation
    they are not, and each weight of the kernel has its own pointer. A pooled step computes two rows
    at once and has twice as many pointers.

    Parameters
    ----------
    taps
        Pointers of the kernel for one row.
    rows
        Rows computed at once.
    across
        Pointers of a row of the kernel.
    dilation, stride
        Rows between two pointers, and between two rows computed at once.
    margin
        Columns of padding that the kernel reads on the left.
    """

    taps: int
    rows: int = 1
    across: int = 1
    dilation: int = 1
    stride: int = 1
    margin: int = 0

    @property
    def count(self) -> int:
        """Number of pointers."""
        return self.taps * self.rows


@dataclass(frozen=True, slots=True)
class Step:
    """Computation of one output row of a layer, or of a convolution and its max-pool.

    Parameters
    ----------
    name
        C identifier.
    layer
        Layer that it computes.
    pooled
        Whether it includes a 2x2 max-pool.
    sources
        Buffers it reads; step i writes buffer i + 1.
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

    @property
    def reads(self) -> RowReads:
        """Rows of the first input that the C reads."""
        conv = self.layer
        if not isinstance(conv, Conv):
            return RowReads(2 if isinstance(conv, MaxPool) else 1)
        across = conv.kernel if conv.dilation > 1 and not conv.depthwise else 1
        margin = 0 if slides_along_row(conv) else conv.padding
        rows = 2 if self.pooled else 1
        return RowReads(conv.kernel * across, rows, across, conv.dilation, conv.stride, margin)


@dataclass(frozen=True, slots=True)
class RowEvent:
    """Computation of one row.

    Parameters
    ----------
    buffer, row
        The row.
    done
        Rows that each buffer has had before.
    oldest
        First row of each buffer that a step still requires; the number of rows if none.
    """

    buffer: int
    row: int
    done: tuple[int, ...]
    oldest: tuple[int, ...]


def schedule_rows(steps: list[Step], rows: list[int]) -> list[RowEvent]:
    """Simulate the computation of an image; return every row in order.

    Parameters
    ----------
    steps
        The steps; step i writes buffer i + 1.
    rows
        Rows of every buffer's tensor.
    """
    done = [0] * len(rows)
    readers = [[k for k, s in enumerate(steps) if b in s.sources] for b in range(len(rows))]
    writes: list[RowEvent] = []

    def oldest_needed(buffer: int) -> int:
        pending = [k for k in readers[buffer] if done[k + 1] < rows[k + 1]]
        starts = [done[k + 1] * steps[k].stride + steps[k].first for k in pending]
        return max(min(starts, default=rows[buffer]), 0)

    def write(buffer: int) -> None:
        oldest = tuple(oldest_needed(b) for b in range(len(rows)))
        writes.append(RowEvent(buffer, done[buffer], tuple(done), oldest))
        done[buffer] += 1

    for _ in range(rows[0]):
        write(0)
        while (step := _find_ready_step(steps, rows, done)) is not None:
            write(step + 1)
    return writes


def _find_ready_step(steps: list[Step], rows: list[int], done: list[int]) -> int | None:
    for index in range(len(steps) - 1, -1, -1):
        step, row = steps[index], done[index + 1]
        if row < rows[index + 1] and all(
            done[k] > min(row * step.stride + step.last, rows[k] - 1) for k in step.sources
        ):
            return index
    return None


def count_ring_rows(writes: list[RowEvent], count: int) -> list[int]:
    """Return the ring size of each buffer: rows from the oldest required to the newest."""
    rings = [1] * count
    for w in writes:
        rings[w.buffer] = max(rings[w.buffer], w.row + 1 - w.oldest[w.buffer])
    return rings


def find_overlaps(writes: list[RowEvent]) -> set[tuple[int, int]]:
    """Return pairs (a, b): a row of b was still required when a row of a was computed."""
    return {
        (w.buffer, other)
        for w in writes
        for other in range(1, len(w.done))
        if other != w.buffer and w.oldest[other] < w.done[other]
    }


def share_ring(chain: list[int], writes: list[RowEvent]) -> tuple[int, list[int]]:
    """Return the rows of a ring that buffers share, and the position of row 0 of each.

    Every row of a buffer replaces a row of the buffer before it that is no longer required: the
    newest such row, so that all required rows are close together.

    Parameters
    ----------
    chain
        The buffers, each computed from the one before.
    writes
        Events from `schedule_rows`.
    """
    behind = {chain[0]: 0}
    for before, buffer in itertools.pairwise(chain):
        lag = max(w.row - w.oldest[before] + 1 for w in writes if w.buffer == buffer)
        behind[buffer] = behind[before] + lag
    ring = max(_ring_span(w, behind) for w in writes if w.buffer in behind)
    return ring, [-behind[buffer] % ring for buffer in chain]


def _ring_span(write: RowEvent, behind: dict[int, int]) -> int:
    """Return the distance from the first to the last position in use, the new row included."""
    places = [write.row - behind[write.buffer]]
    for buffer, lag in behind.items():
        if write.oldest[buffer] < write.done[buffer]:
            places += [write.oldest[buffer] - lag, write.done[buffer] - 1 - lag]
    return max(places) - min(places) + 1
