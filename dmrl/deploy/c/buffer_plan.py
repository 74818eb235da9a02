"""Buffer plan of the generated C: the steps per row, and the size and place of every buffer.

A convolution whose only reader is a max-pool becomes one step with it. Every tensor between two
steps is a ring buffer of its newest rows, see `row_schedule`.
"""

import re
from dataclasses import dataclass, replace

from dmrl.deploy.c.row_schedule import (
    RowEvent,
    Step,
    count_ring_rows,
    find_overlaps,
    schedule_rows,
    share_ring,
    slides_along_row,
)
from dmrl.deploy.int8.layers import Conv, MaxPool, Shape
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.errors import ModelError

MAX_SIDE_PX = 4096
"""Largest side of an image, pixels: rows are counted in int16, and chips are small."""


@dataclass(frozen=True, slots=True)
class Buffer:
    """Ring buffer of rows of one tensor; rows consist of pixels, pixels of channels.

    Parameters
    ----------
    name
        C identifier: that of the layer that writes it, or "image".
    home
        Member of the state that contains it. Buffers of one row whose lifetimes do not overlap
        share one.
    channels, rows, cols
        Size of the whole tensor.
    gap
        Columns of padding before, between and behind the rows.
    pad_value
        Value of the padding.
    above
        Whether a layer reads rows outside the tensor.
    ring
        Number of rows held at a time.
    signed
        Whether values are int8.
    shift
        Position of row 0 in the ring; several buffers may share one ring.
    """

    name: str
    home: str
    channels: int
    rows: int
    cols: int
    gap: int
    pad_value: int
    above: bool
    ring: int
    signed: bool
    shift: int = 0

    @property
    def row_bytes(self) -> int:
        """Bytes from the start of a row to the start of the next."""
        return (self.gap + self.cols) * self.channels

    @property
    def padded_bytes(self) -> int:
        """Bytes of a row with the padding on both sides."""
        return self.row_bytes + self.gap * self.channels

    @property
    def size(self) -> int:
        """Bytes of the whole ring."""
        return self.ring * self.row_bytes + self.gap * self.channels


@dataclass(frozen=True, slots=True)
class BufferPlan:
    """Steps in order; step i reads buffers up to i and writes buffer i + 1."""

    network: IntegerNetwork
    steps: tuple[Step, ...]
    buffers: tuple[Buffer, ...]
    tensors: tuple[int, ...]
    """Buffer of every tensor of the network; -1 for a tensor inside a fused step."""
    whole: frozenset[int]
    """Buffers kept whole, since they are read after the last row."""

    @property
    def zero_bytes(self) -> int:
        """Bytes of the longest padding row of zeros; 0: none."""
        rows = (b.padded_bytes for b in self.buffers if b.above and b.pad_value == 0)
        return max(rows, default=0)

    @property
    def pad_bytes(self) -> int:
        """Bytes of the padding row of the image; 0: none."""
        image = self.buffers[0]
        return image.padded_bytes if image.above and image.pad_value else 0

    @property
    def read(self) -> set[int]:
        """Buffers that a step reads."""
        return {k for step in self.steps for k in step.sources}

    @property
    def pools(self) -> bool:
        """Whether a step has a max-pool."""
        return any(step.pooled or isinstance(step.layer, MaxPool) for step in self.steps)

    def output_of(self, step: Step) -> Buffer:
        """Return the buffer that a step writes."""
        return self.buffers[self.steps.index(step) + 1]

    def deepest_reader(self, index: int) -> int:
        """Return the last step that reads the output of a step, or the step itself."""
        readers = [k for k, step in enumerate(self.steps) if index + 1 in step.sources]
        return max(readers, default=index)


def plan_buffers(network: IntegerNetwork) -> BufferPlan:
    """Plan the buffers of a network's C.

    Parameters
    ----------
    network
        The network.

    Raises
    ------
    ModelError
        If the image is too large for the C.
    """
    if max(network.height_px, network.width_px) > MAX_SIDE_PX:
        raise ModelError(
            f"{network.name} takes images of {network.width_px} x {network.height_px} px, the C "
            f"at most {MAX_SIDE_PX}. Train it on smaller images"
        )
    steps, tensors = _build_steps(network)
    shapes = [network.shapes[tensors.index(k)] for k in range(len(steps) + 1)]
    whole = frozenset(tensors[h.tensor] for h in network.heads.values())
    writes = schedule_rows(steps, [rows for _, rows, _ in shapes])
    rings = count_ring_rows(writes, len(shapes))
    drafts = [_build_buffer(k, shapes[k], rings[k], steps) for k in range(len(shapes))]
    drafts = [replace(d, ring=d.rows) if k in whole else d for k, d in enumerate(drafts)]
    passing = [
        k for k, d in enumerate(drafts) if k and k not in whole and d.ring == 1 and not d.gap
    ]
    homes = _share_members(passing, find_overlaps(writes))
    buffers = [replace(d, home=homes.get(k, d.name)) for k, d in enumerate(drafts)]
    for chain in _find_chains(steps, buffers, whole):
        buffers = _join_chain(buffers, chain, writes)
    return BufferPlan(network, tuple(steps), tuple(buffers), tuple(tensors), whole)


def _find_chains(
    steps: list[Step], buffers: list[Buffer], whole: frozenset[int]
) -> list[list[int]]:
    """Return chains of buffers that may share a ring: each is computed from the one before.

    Their rows have equal size. A step with a shortcut is chained to the shortcut's buffer.
    """
    chains: list[list[int]] = []
    for out, step in enumerate(steps, start=1):
        source = step.sources[-1]
        pair = [buffers[source], buffers[out]]
        sizes = {(b.channels, b.rows, b.cols, b.pad_value) for b in pair}
        if len(sizes) > 1 or source == 0 or out in whole or min(b.ring for b in pair) < 2:
            continue
        chain = next((c for c in chains if c[-1] == source), None)
        if chain is None and not any(source in c for c in chains):
            chains.append(chain := [source])
        if chain is not None:
            chain.append(out)
    return chains


def _join_chain(buffers: list[Buffer], chain: list[int], writes: list[RowEvent]) -> list[Buffer]:
    """Return the buffers, with those of a chain in one ring if that is smaller."""
    ring, shifts = share_ring(chain, writes)
    gap, first = max(buffers[k].gap for k in chain), buffers[chain[0]]
    joined = {
        k: replace(buffers[k], home=first.home, gap=gap, ring=ring, shift=shift)
        for k, shift in zip(chain, shifts, strict=True)
    }
    if joined[chain[0]].size >= sum(buffers[k].size for k in chain):
        return buffers
    return [joined.get(k, b) for k, b in enumerate(buffers)]


def _share_members(passing: list[int], together: set[tuple[int, int]]) -> dict[int, str]:
    """Assign members to buffers of one row; buffers with overlapping lifetimes never share one."""
    shared: list[list[int]] = []
    for k in passing:
        for home in shared:
            if not any((k, other) in together or (other, k) in together for other in home):
                home.append(k)
                break
        else:
            shared.append([k])
    return {k: f"{SHARED_PREFIX}{index}" for index, home in enumerate(shared) for k in home}


def _build_steps(network: IntegerNetwork) -> tuple[list[Step], list[int]]:
    """Return the steps, and the buffer of every tensor."""
    steps: list[Step] = []
    tensors = [0]
    fused = _find_fusable_pools(network)
    for index, layer in enumerate(network.layers):
        if index in fused:
            before = steps.pop()
            steps.append(Step(before.name, before.layer, True, before.sources))
            tensors[-1] = -1
        else:
            name = _make_identifier(layer.name, [s.name for s in steps])
            steps.append(Step(name, layer, False, tuple(tensors[k] for k in layer.sources)))
        tensors.append(len(steps))
    return steps, tensors


def _find_fusable_pools(network: IntegerNetwork) -> set[int]:
    """Return the max-pools that follow a dense convolution with no other reader."""
    out = set()
    for index, layer in enumerate(network.layers[1:], 1):
        before = network.layers[index - 1]
        readers = sum(other.sources.count(index) for other in network.layers)
        alone = isinstance(layer, MaxPool) and layer.source == index and readers == 1
        if alone and isinstance(before, Conv) and not before.depthwise and before.shortcut < 0:
            out.add(index)
    return out


def _make_identifier(name: str, taken: list[str]) -> str:
    """Return a C identifier like ``name`` that is not in ``taken``."""
    plain = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_").lower()[:60] or "layer"
    plain = f"layer_{plain}" if plain.startswith(SHARED_PREFIX) or not plain[0].isalpha() else plain
    reserved = {*taken, *RESERVED_IDENTIFIERS.split()}
    if plain not in reserved:
        return plain
    return next(f"{plain}_{k}" for k in range(2, 1000) if f"{plain}_{k}" not in reserved)


RESERVED_IDENTIFIERS = """
image image_pad stage zeros done raw raw_rows auto break case char const continue default do double
else enum extern float for goto if inline int long register restrict return short signed sizeof
static struct switch typedef union unsigned void volatile while
"""
"""Keywords of C, and other members of the state."""
SHARED_PREFIX = "passing_"
"""Prefix of members that several buffers share."""


def _build_buffer(index: int, shape: Shape, ring: int, steps: list[Step]) -> Buffer:
    channels, rows, cols = shape
    convs = [s.layer for s in steps if index == s.sources[0] and isinstance(s.layer, Conv)]
    name = steps[index - 1].name if index else "image"
    return Buffer(
        name=name,
        home=name,
        channels=channels,
        rows=rows,
        cols=cols,
        gap=max((conv.padding for conv in convs if not slides_along_row(conv)), default=0),
        pad_value=convs[0].pad_value if convs else 0,
        above=any(c.padding for c in convs),
        ring=ring,
        signed=bool(index) and steps[index - 1].layer.signed,
    )
