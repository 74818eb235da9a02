"""An int8 network: the input of the C generator and of ``reference``.

Tensor 0 is the image, uint8; layer i writes tensor i + 1. A tensor is (channels, rows, columns) of
uint8, or of int8 if its layer is ``signed``. Its real values are ``scale * (q - zero_point)``. The
zero point is 0 except for the image (128, the pixel value of 0.0) and the heads.

Every layer ends in one requantization with integers only: add half a step, shift right (an
arithmetic shift rounds down, so halves are rounded up), and clamp to the range of the output's
type. The clamp of an unsigned tensor at 0 is the ReLU.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dmrl.deploy.int8.layers import AnyLayer, Conv, Int32, Shape
from dmrl.errors import ModelError
from dmrl.guards.safe_names import truncate

SUBPIXEL = 16
"""Steps per pixel of integer positions."""
CONFIDENCE_ONE = 65535
"""Integer confidence of 1.0."""
HEAD_NAMES = ("confidence", "depth", "offset_u", "offset_v")


@dataclass(frozen=True, slots=True, eq=False)
class Head:
    """One channel of a signed tensor that is an output, with its own scale.

    Parameters
    ----------
    tensor, channel
        Its tensor, which no layer reads, and its channel.
    scale, zero_point
        Its real value is ``scale * (q - zero_point)``.
    table
        (256,) int32, indexed by q + 128: the value in integer units. It never decreases for the
        confidence. Confidence: 0 to 65535 for 0 to 1. Depth: mm, 0 to 65535. Offsets: position from
        the left (top) edge of the cell, in 1/16 px, -32768 to 32767.
    """

    tensor: int
    channel: int
    scale: float
    zero_point: int
    table: Int32


@dataclass(frozen=True, slots=True, eq=False)
class IntegerNetwork:
    """A complete int8 network.

    Parameters
    ----------
    name
        Name of the model, for display.
    architecture
        Architecture of the float network.
    channels, height_px, width_px
        Format of the image: 3 channels for RGB, 1 for grey.
    stride_px
        Side of a grid cell.
    layers
        Layers in order of computation; every layer reads earlier tensors.
    confidence, depth
        Heads, all of one grid shape.
    offset_u, offset_v
        Heads of the sub-cell position; without them, a robot is at the centre of its cell.
    threshold
        Confidence from which a detection is reported, 0 to 1.
    """

    name: str
    architecture: str
    channels: int
    height_px: int
    width_px: int
    stride_px: int
    layers: tuple[AnyLayer, ...]
    confidence: Head
    depth: Head
    offset_u: Head | None = None
    offset_v: Head | None = None
    threshold: float = 0.33

    def __post_init__(self) -> None:
        require_sound(self)

    @property
    def heads(self) -> dict[str, Head]:
        """Existing heads, by name."""
        named = {name: getattr(self, name) for name in HEAD_NAMES}
        return {name: head for name, head in named.items() if head is not None}

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """Channels, rows and columns of every tensor."""
        shapes: list[Shape] = [(self.channels, self.height_px, self.width_px)]
        for layer in self.layers:
            shapes.append(layer.output_shape(tuple(shapes[k] for k in layer.sources)))
        return tuple(shapes)

    @property
    def grid_shape(self) -> tuple[int, int]:
        """Rows and columns of the grid of cells."""
        return self.shapes[self.confidence.tensor][1:]

    @property
    def layer_macs(self) -> list[int]:
        """Multiply-accumulates of every layer per image."""
        shapes = self.shapes
        return [
            layer.count_macs((shapes[layer.source],)) if isinstance(layer, Conv) else 0
            for layer in self.layers
        ]

    @property
    def macs(self) -> int:
        """Multiply-accumulates per image."""
        return sum(self.layer_macs)

    @property
    def threshold_q(self) -> int:
        """Smallest int8 confidence that reaches the threshold; 128: none."""
        believed = np.flatnonzero(self.confidence.table >= round(self.threshold * CONFIDENCE_ONE))
        return int(believed[0]) - 128 if believed.size else 128


def require_sound(network: IntegerNetwork) -> None:
    """Raise ModelError unless the invariants of all layers hold.

    Raises
    ------
    ModelError
        If one is violated; the message contains the layer's name.
    """
    for fault in _iter_faults(network):
        raise ModelError(f"{fault}. Quantise the model again")


def _iter_faults(network: IntegerNetwork) -> Iterator[str]:
    for index, layer in enumerate(network.layers):
        if not all(0 <= k <= index for k in layer.sources):
            yield f"layer {layer.name} reads tensors {layer.sources}, which are not all before it"
    shapes = network.shapes
    signed = [False, *(layer.signed for layer in network.layers)]
    for layer, shape in zip(network.layers, shapes[1:], strict=True):
        inputs = tuple(shapes[k] for k in layer.sources)
        if min(shape) < 1:
            yield f"layer {layer.name} has no output for {inputs[0][2]} x {inputs[0][1]} inputs"
        faults = layer.iter_faults(inputs, tuple(signed[k] for k in layer.sources))
        yield from (f"layer {layer.name} {fault}" for fault in faults)
    read = {k for layer in network.layers for k in layer.sources}
    for name, head in network.heads.items():
        on_grid = shapes[head.tensor][1:] == network.grid_shape
        if not signed[head.tensor] or head.tensor in read or not on_grid:
            yield f"head {name} is not a signed tensor of the grid"
    named = Counter(layer.name for layer in network.layers)
    yield from (f"two layers are named {truncate(name)!r}" for name in named if named[name] > 1)
