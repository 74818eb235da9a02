"""Placement in two memories: long rings in a large far one (L2), scratch in a near one (L1).

A GAP8 has 64 kB of L1, which its cores access without waiting, and 512 kB of L2. While a step
computes a row, its tables and the rows that it reads from far rings are in the scratch buffer, a
part of the near memory. A row of a far ring is computed there and then copied out.
"""

import itertools
from dataclasses import dataclass, replace

from dmrl.deploy.c.buffer_plan import SHARED_PREFIX, BufferPlan, count_pointers, round_up
from dmrl.deploy.c.row_schedule import Step
from dmrl.deploy.int8.network import Conv, MaxPool
from dmrl.errors import SettingError

MAX_FAR_CANDIDATES = 12
"""Number of rings, the largest ones, that may be far; all their subsets are tried."""


@dataclass(frozen=True, slots=True)
class StagedBuffer:
    """Items of one kind in the scratch buffer while a step computes a row.

    Parameters
    ----------
    size_bytes, count
        Size of each, and how many.
    at
        Offset of the first.
    """

    size_bytes: int
    count: int
    at: int

    @property
    def end(self) -> int:
        """Offset of the next kind."""
        return round_up(self.at + self.size_bytes * self.count, 4)


def list_staged_buffers(plan: BufferPlan, index: int) -> dict[str, StagedBuffer]:
    """Return the content of the scratch buffer of a step: its tables, and rows of far rings.

    Returns
    -------
    dict
        By kind: "scales", "gains", "weights", "0" and "1" of the inputs, "out"; empty with one
        memory.
    """
    if not plan.l1_scratch_bytes:
        return {}
    step, out = plan.steps[index], plan.buffers[index + 1]
    inputs = [plan.buffers[k] for k in step.sources]
    sizes: list[tuple[str, int, int]] = []
    if isinstance(step.layer, Conv):
        conv = step.layer
        tables = {"scales": 8 * conv.bias.size, "gains": 4 * conv.gain.size}
        sizes = [(k, n, 1) for k, n in (tables | {"weights": conv.weight.size}).items() if n]
    rows = (count_input_rows(step), 1)
    sizes += [(f"{k}", b.padded_bytes, rows[k]) for k, b in enumerate(inputs) if b.in_l2]
    sizes += [("out", out.cols * out.channels, 1)] if out.in_l2 else []
    staged: dict[str, StagedBuffer] = {}
    at = 0
    for name, size, count in sizes:
        staged[name] = StagedBuffer(size, count, at)
        at = staged[name].end
    return staged


def count_input_rows(step: Step) -> int:
    """Return the number of row pointers of a step to its first input."""
    if isinstance(step.layer, Conv):
        return count_pointers(step.layer) * (2 if step.pooled else 1)
    return 2 if isinstance(step.layer, MaxPool) else 1


def count_copied_bytes(plan: BufferPlan) -> int:
    """Return the bytes copied between the two memories per image; 0 with one memory."""
    return sum(
        load.size_bytes * load.count * out.rows
        for index, out in enumerate(plan.buffers[1:])
        for load in list_staged_buffers(plan, index).values()
    )


def assign_memories(plan: BufferPlan, most_bytes: int) -> BufferPlan:
    """Place rings in the far memory if the plan does not fit; fewest copied bytes win.

    Parameters
    ----------
    plan
        Plan with one memory.
    most_bytes
        Maximum size of the near state, raw Bayer images included.

    Raises
    ------
    SettingError
        If no placement fits.
    """
    if plan.state_bytes(bayer=True) <= most_bytes:
        return plan
    ways = [_place_in_l2(plan, far) for far in _list_choices(plan)]
    sizes = [way.state_bytes(bayer=True) for way in ways]
    fitting = [
        (count_copied_bytes(way), size, k)
        for k, (way, size) in enumerate(zip(ways, sizes, strict=True))
        if size <= most_bytes
    ]
    if fitting:
        return ways[min(fitting)[-1]]
    least = min([*sizes, plan.state_bytes(bayer=True)])
    raise SettingError(
        f"{plan.network.name} needs at least {least:,} bytes of near memory, of which "
        f"{most_bytes:,} are there beside the stacks. Raise --l1-kb"
    )


def _list_choices(plan: BufferPlan) -> list[tuple[str, ...]]:
    """Return all sets of members of the state that may be far."""
    near, sizes = {plan.buffers[k].home for k in plan.whole | {0}}, plan.member_bytes(in_l2=False)
    rings = [name for name in sizes if name not in near and not name.startswith(SHARED_PREFIX)]
    rings = sorted(rings, key=lambda name: -sizes[name])[:MAX_FAR_CANDIDATES]
    return [
        far for count in range(1, len(rings) + 1) for far in itertools.combinations(rings, count)
    ]


def _place_in_l2(plan: BufferPlan, far: tuple[str, ...]) -> BufferPlan:
    buffers = tuple(replace(b, in_l2=b.home in far) for b in plan.buffers)
    draft = replace(plan, buffers=buffers, l1_scratch_bytes=1)
    ends = [
        load.end for k in range(len(plan.steps)) for load in list_staged_buffers(draft, k).values()
    ]
    return replace(draft, l1_scratch_bytes=max(ends))
