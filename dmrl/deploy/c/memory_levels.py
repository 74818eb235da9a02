"""Placement in two memories: long rings in a large far one (L2), scratch in a near one (L1).

A GAP8 has 64 kB of L1, which its cores access without waiting, and 512 kB of L2. While a step
computes a row, its tables and the rows that it reads from far rings are in the scratch buffer, a
part of the near memory. A row of a far ring is computed there and then copied out.
"""

import itertools
from dataclasses import dataclass, replace

from dmrl.deploy.c.buffer_plan import SHARED, Plan, taps_of, up
from dmrl.deploy.c.row_schedule import Step
from dmrl.deploy.int8.network import Conv, MaxPool
from dmrl.errors import SettingError

MOST_CHOICES = 12
"""Number of rings, the largest ones, that may be far; all their subsets are tried."""


@dataclass(frozen=True, slots=True)
class Load:
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
        return up(self.at + self.size_bytes * self.count, 4)


def loads(plan: Plan, index: int) -> dict[str, Load]:
    """Return the content of the scratch buffer of a step: its tables, and rows of far rings.

    Returns
    -------
    dict
        By kind: "scales", "gains", "weights", "0" and "1" of the inputs, "out"; empty with one
        memory.
    """
    if not plan.stage:
        return {}
    step, out = plan.steps[index], plan.buffers[index + 1]
    inputs = [plan.buffers[k] for k in step.sources]
    sizes: list[tuple[str, int, int]] = []
    if isinstance(step.layer, Conv):
        conv = step.layer
        tables = {"scales": 8 * conv.bias.size, "gains": 4 * conv.gain.size}
        sizes = [(k, n, 1) for k, n in (tables | {"weights": conv.weight.size}).items() if n]
    rows = (rows_read(step), 1)
    sizes += [(f"{k}", b.padded_bytes, rows[k]) for k, b in enumerate(inputs) if b.far]
    sizes += [("out", out.cols * out.channels, 1)] if out.far else []
    staged: dict[str, Load] = {}
    at = 0
    for name, size, count in sizes:
        staged[name] = Load(size, count, at)
        at = staged[name].end
    return staged


def rows_read(step: Step) -> int:
    """Return the number of row pointers of a step to its first input."""
    if isinstance(step.layer, Conv):
        return taps_of(step.layer) * (2 if step.pooled else 1)
    return 2 if isinstance(step.layer, MaxPool) else 1


def traffic_bytes(plan: Plan) -> int:
    """Return the bytes copied between the two memories per image; 0 with one memory."""
    return sum(
        load.size_bytes * load.count * out.rows
        for index, out in enumerate(plan.buffers[1:])
        for load in loads(plan, index).values()
    )


def split(plan: Plan, most_bytes: int) -> Plan:
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
    ways = [_with_far(plan, far) for far in _choices(plan)]
    sizes = [way.state_bytes(bayer=True) for way in ways]
    fitting = [
        (traffic_bytes(way), size, k)
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


def _choices(plan: Plan) -> list[tuple[str, ...]]:
    """Return all sets of members of the state that may be far."""
    near, sizes = {plan.buffers[k].home for k in plan.whole | {0}}, plan.homes(far=False)
    rings = [name for name in sizes if name not in near and not name.startswith(SHARED)]
    rings = sorted(rings, key=lambda name: -sizes[name])[:MOST_CHOICES]
    return [
        far for count in range(1, len(rings) + 1) for far in itertools.combinations(rings, count)
    ]


def _with_far(plan: Plan, far: tuple[str, ...]) -> Plan:
    buffers = tuple(replace(b, far=b.home in far) for b in plan.buffers)
    draft = replace(plan, buffers=buffers, stage=1)
    ends = [load.end for k in range(len(plan.steps)) for load in loads(draft, k).values()]
    return replace(draft, stage=max(ends))
