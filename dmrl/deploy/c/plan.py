"""What the C of a network does row by row: its steps, its buffers, and how many rows each holds.

A convolution that only a max-pool reads becomes one step with it. Every tensor between two
steps is a ring of its newest rows. After each row of the image the deepest step that has the
rows it needs makes one output row, until none has: `play` plays this through and counts.
"""

import re
from dataclasses import dataclass, replace

from dmrl.deploy.integer import AnyLayer, Conv, IntegerNetwork, MaxPool, Shape
from dmrl.errors import ModelError

LONGEST_SIDE = 4096
"""Rows are counted in int16 and rings stand on small chips; no camera of this field is larger."""


@dataclass(frozen=True, slots=True)
class Buffer:
    """Rows of one tensor, kept as rows of pixels, the channels of a pixel side by side.

    Parameters
    ----------
    name
        C identifier: that of the layer that writes it, or "image".
    home
        Member of the state that holds it. Buffers of one row that are never needed at the same
        time share one.
    channels, rows, cols
        Of the whole tensor.
    gap
        Columns of padding before, between and behind the rows.
    pad_value
        What they hold.
    above
        Whether some layer reads rows outside the tensor.
    ring
        Rows held at a time.
    signed
        Whether it holds int8.
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

    @property
    def row_bytes(self) -> int:
        """Bytes from the start of a row to that of the next."""
        return (self.gap + self.cols) * self.channels

    @property
    def size(self) -> int:
        """Bytes of the whole ring."""
        return self.ring * self.row_bytes + self.gap * self.channels


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
class Plan:
    """Steps in order; step i reads buffers up to i and writes buffer i + 1."""

    network: IntegerNetwork
    steps: tuple[Step, ...]
    buffers: tuple[Buffer, ...]
    tensors: tuple[int, ...]
    """Buffer of every tensor of the network; -1 where a fused max-pool left none."""

    @property
    def homes(self) -> dict[str, int]:
        """Members of the state that hold rings, and their bytes."""
        return {
            name: max(b.size for b in self.buffers if b.home == name)
            for name in dict.fromkeys(b.home for b in self.buffers)
        }


def plan(network: IntegerNetwork) -> Plan:
    """How the C of a network works.

    Raises
    ------
    ModelError
        If the image is too large for the C.
    """
    if max(network.height_px, network.width_px) > LONGEST_SIDE:
        raise ModelError(
            f"{network.name} takes images of {network.width_px} x {network.height_px} px, the C "
            f"at most {LONGEST_SIDE}. Train it on smaller images"
        )
    steps, tensors = _steps(network)
    shapes = [network.shapes[tensors.index(k)] for k in range(len(steps) + 1)]
    whole = {tensors[h.tensor] for h in network.heads.values()}
    played = play(steps, [rows for _, rows, _ in shapes])
    drafts = [_buffer(k, shapes[k], played.rings[k], steps) for k in range(len(shapes))]
    drafts = [replace(d, ring=d.rows) if k in whole else d for k, d in enumerate(drafts)]
    passing = [
        k for k, d in enumerate(drafts) if k and k not in whole and d.ring == 1 and not d.gap
    ]
    homes = _homes(passing, played.together)
    buffers = [replace(d, home=homes.get(k, d.name)) for k, d in enumerate(drafts)]
    return Plan(network, tuple(steps), tuple(buffers), tuple(tensors))


def _homes(passing: list[int], together: set[tuple[int, int]]) -> dict[int, str]:
    """Members for buffers of one row; two that are needed together are never in the same."""
    shared: list[list[int]] = []
    for k in passing:
        for home in shared:
            if not any((k, other) in together or (other, k) in together for other in home):
                home.append(k)
                break
        else:
            shared.append([k])
    return {k: f"{SHARED}{index}" for index, home in enumerate(shared) for k in home}


def _steps(network: IntegerNetwork) -> tuple[list[Step], list[int]]:
    """The steps, and the buffer of every tensor."""
    steps: list[Step] = []
    tensors = [0]
    fused = _pools_to_fuse(network)
    for index, layer in enumerate(network.layers):
        if index in fused:
            before = steps.pop()
            steps.append(Step(before.name, before.layer, True, before.sources))
            tensors[-1] = -1
        else:
            name = _identifier(layer.name, [s.name for s in steps])
            steps.append(Step(name, layer, False, tuple(tensors[k] for k in layer.sources)))
        tensors.append(len(steps))
    return steps, tensors


def _pools_to_fuse(network: IntegerNetwork) -> set[int]:
    """Layers that are max-pools right after a dense convolution that nothing else reads."""
    out = set()
    for index, layer in enumerate(network.layers[1:], 1):
        before = network.layers[index - 1]
        readers = sum(other.sources.count(index) for other in network.layers)
        alone = isinstance(layer, MaxPool) and layer.source == index and readers == 1
        if alone and isinstance(before, Conv) and not before.depthwise and before.shortcut < 0:
            out.add(index)
    return out


def _identifier(name: str, taken: list[str]) -> str:
    """A C identifier like ``name`` that is not taken."""
    plain = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_").lower()[:60] or "layer"
    plain = f"layer_{plain}" if plain.startswith(SHARED) or not plain[0].isalpha() else plain
    reserved = {*taken, *RESERVED.split()}
    if plain not in reserved:
        return plain
    return next(f"{plain}_{k}" for k in range(2, 1000) if f"{plain}_{k}" not in reserved)


RESERVED = """
image image_pad done raw raw_rows auto break case char const continue default do double else enum
extern float for goto if inline int long register restrict return short signed sizeof static
struct switch typedef union unsigned void volatile while
"""
"""Words of C, and other members of the state."""
SHARED = "passing_"
"""How members begin that several buffers share."""


@dataclass(frozen=True, slots=True)
class Played:
    """What became of the buffers while the rows of an image came.

    Parameters
    ----------
    rings
        Rows that each must hold at a time: from the oldest still needed to the newest.
    together
        (a, b): the newest row of b was still needed when a row of a was written.
    """

    rings: list[int]
    together: set[tuple[int, int]]


def play(steps: list[Step], rows: list[int]) -> Played:
    """Play an image through, row by row.

    Parameters
    ----------
    steps
        The steps; step i writes buffer i + 1.
    rows
        Rows of every buffer's tensor.
    """
    done = [0] * len(rows)
    readers = [[k for k, s in enumerate(steps) if b in s.sources] for b in range(len(rows))]
    played = Played([1] * len(rows), set())

    def oldest_needed(buffer: int) -> int:
        """First row that a reader has yet to read; as many as there are: none."""
        pending = [k for k in readers[buffer] if done[k + 1] < rows[k + 1]]
        starts = [done[k + 1] * steps[k].stride + steps[k].first for k in pending]
        return max(min(starts, default=rows[buffer]), 0)

    def write(buffer: int) -> None:
        needed = {b for b in range(1, len(rows)) if oldest_needed(b) < done[b]}
        played.together.update((buffer, b) for b in needed - {buffer})
        done[buffer] += 1
        held = done[buffer] - oldest_needed(buffer)
        played.rings[buffer] = max(played.rings[buffer], held)

    for _ in range(rows[0]):
        write(0)
        while (step := _deepest_ready(steps, rows, done)) is not None:
            write(step + 1)
    return played


def _deepest_ready(steps: list[Step], rows: list[int], done: list[int]) -> int | None:
    for index in range(len(steps) - 1, -1, -1):
        step, row = steps[index], done[index + 1]
        if row < rows[index + 1] and all(
            done[k] > min(row * step.stride + step.last, rows[k] - 1) for k in step.sources
        ):
            return index
    return None


def along(conv: Conv) -> bool:
    """Whether a convolution's C slides along the row, and needs no columns of padding there."""
    same = conv.stride == 1 and conv.padding == conv.dilation
    return conv.depthwise and conv.kernel == 3 and same


def _buffer(index: int, shape: Shape, ring: int, steps: list[Step]) -> Buffer:
    channels, rows, cols = shape
    convs = [s.layer for s in steps if index == s.sources[0] and isinstance(s.layer, Conv)]
    name = steps[index - 1].name if index else "image"
    return Buffer(
        name=name,
        home=name,
        channels=channels,
        rows=rows,
        cols=cols,
        gap=max((conv.padding for conv in convs if not along(conv)), default=0),
        pad_value=convs[0].pad_value if convs else 0,
        above=any(c.padding for c in convs),
        ring=ring,
        signed=bool(index) and steps[index - 1].layer.signed,
    )
