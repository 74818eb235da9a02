"""Placement in two memories: long rings in a large far one (L2), scratch in a near one (L1).

A GAP8 has 64 kB of L1, which its cores access without waiting, and 512 kB of L2. While a step
computes a row, its tables and the rows that it reads from far rings are in the scratch buffer, a
part of the near memory. A row of a far ring is computed there and then copied out.
"""

import itertools
from dataclasses import dataclass

from dmrl.deploy.c.buffer_plan import SHARED_PREFIX, Buffer, BufferPlan
from dmrl.deploy.c.row_schedule import Step
from dmrl.deploy.int8.layers import Conv
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


@dataclass(frozen=True, slots=True)
class Placement:
    """Members of the state in the near memory, and in a far one if there are two.

    Parameters
    ----------
    plan
        Buffers of the network.
    far
        Members in the far memory; empty: there is one memory.
    """

    plan: BufferPlan
    far: frozenset[str] = frozenset()

    def members(self, *, far: bool) -> dict[str, int]:
        """Return the members of the near or the far state that contain rings, and their bytes."""
        sizes: dict[str, int] = {}
        for buffer in self.plan.buffers:
            if (buffer.home in self.far) == far:
                sizes[buffer.home] = max(sizes.get(buffer.home, 0), buffer.size)
        return sizes

    def member(self, buffer: Buffer) -> str:
        """Return the ring of a buffer in C."""
        return f"{'away' if buffer.home in self.far else 'net'}->{buffer.home}"

    def padding(self) -> dict[str, int]:
        """Return the padding that no layer writes: where it is in C, and its value."""
        places = {self.member(b): b.pad_value for b in self.plan.buffers if b.gap}
        if self.plan.pad_bytes:
            places["net->image_pad"] = self.plan.buffers[0].pad_value
        if self.plan.zero_bytes and self.far:
            places["net->zeros"] = 0
        return places

    def stage_buffers(self, step: Step) -> dict[str, StagedBuffer]:
        """Return the content of the scratch buffer of a step: its tables, and rows of far rings.

        Returns
        -------
        dict
            By kind: "scales", "gains", "weights", "0" and "1" of the inputs, "out"; empty with one
            memory.
        """
        if not self.far:
            return {}
        out = self.plan.output_of(step)
        sizes: list[tuple[str, int, int]] = []
        if isinstance(step.layer, Conv):
            conv = step.layer
            tables = {"scales": 8 * conv.bias.size, "gains": 4 * conv.gain.size}
            sizes = [(k, n, 1) for k, n in (tables | {"weights": conv.weight.size}).items() if n]
        for number, source in enumerate(step.sources):
            buffer = self.plan.buffers[source]
            if buffer.home in self.far:
                count = step.reads.count if number == 0 else 1
                sizes.append((str(number), buffer.padded_bytes, count))
        if out.home in self.far:
            sizes.append(("out", out.cols * out.channels, 1))
        staged: dict[str, StagedBuffer] = {}
        at = 0
        for name, size, count in sizes:
            staged[name] = StagedBuffer(size, count, at)
            at = staged[name].end
        return staged

    @property
    def stage_bytes(self) -> int:
        """Bytes of the scratch buffer; 0 with one memory."""
        ends = (item.end for step in self.plan.steps for item in self.stage_buffers(step).values())
        return max(ends, default=0)

    @property
    def far_bytes(self) -> int:
        """Bytes of the far state; 0 with one memory."""
        return sum(self.members(far=True).values())

    @property
    def traffic_bytes(self) -> int:
        """Bytes copied between the two memories per image; 0 with one memory."""
        return sum(
            item.size_bytes * item.count * self.plan.output_of(step).rows
            for step in self.plan.steps
            for item in self.stage_buffers(step).values()
        )

    def near_bytes(self, *, bayer: bool) -> int:
        """Return the bytes of the (near) state, with or without raw Bayer images."""
        plan = self.plan
        used = 2 * len(plan.buffers) + sum(self.members(far=False).values()) + plan.pad_bytes
        used += 2 + 3 * plan.network.width_px if bayer else 0
        if not self.far:
            return round_up(used, 2)
        return round_up(used + plan.zero_bytes + self.stage_bytes, 4)


def place_buffers(plan: BufferPlan, most_bytes: int | None) -> Placement:
    """Place rings in the far memory if the plan does not fit; fewest copied bytes win.

    Parameters
    ----------
    plan
        The buffers.
    most_bytes
        Maximum size of the near state, raw Bayer images included. None: there is one memory.

    Raises
    ------
    SettingError
        If no placement fits.
    """
    whole = Placement(plan)
    if most_bytes is None or whole.near_bytes(bayer=True) <= most_bytes:
        return whole
    placements = [Placement(plan, frozenset(far)) for far in _list_choices(whole)]
    sizes = [one.near_bytes(bayer=True) for one in placements]
    fitting = [
        (one.traffic_bytes, size, k)
        for k, (one, size) in enumerate(zip(placements, sizes, strict=True))
        if size <= most_bytes
    ]
    if fitting:
        return placements[min(fitting)[-1]]
    least = min([*sizes, whole.near_bytes(bayer=True)])
    raise SettingError(
        f"{plan.network.name} needs at least {least:,} bytes of near memory, of which "
        f"{most_bytes:,} are there beside the stacks. Raise --l1-kb"
    )


def _list_choices(whole: Placement) -> list[tuple[str, ...]]:
    """Return all sets of members of the state that may be far."""
    plan, sizes = whole.plan, whole.members(far=False)
    near = {plan.buffers[k].home for k in plan.whole | {0}}
    rings = [name for name in sizes if name not in near and not name.startswith(SHARED_PREFIX)]
    rings = sorted(rings, key=lambda name: -sizes[name])[:MAX_FAR_CANDIDATES]
    return [
        far for count in range(1, len(rings) + 1) for far in itertools.combinations(rings, count)
    ]


def round_up(size: int, step: int) -> int:
    """Round up to the next multiple of ``step``."""
    return -(-size // step) * step
