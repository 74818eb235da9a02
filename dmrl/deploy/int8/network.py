"""An int8 network: what the C is generated from and what ``reference`` computes.

Tensor 0 is the image, uint8; layer i writes tensor i + 1. A tensor is (channels, rows, columns)
of uint8, or of int8 where its layer says ``signed``. Its real values are
``scale * (q - zero_point)``; the zero point is 0 everywhere but in the image (128, the pixel
that stands for 0.0) and in the heads.

Every layer ends in one requantisation, of integers alone: half a step is added, then an arithmetic
shift rounds down (so half goes up), then comes a clamp to the range of the output's type. The clamp
of an unsigned tensor at 0 is the ReLU.
"""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from dmrl.deploy.int8.layers import (
    PIXEL_ZERO,
    Add,
    AnyLayer,
    Conv,
    Int32,
    MaxPool,
    Shape,
    unsound,
)
from dmrl.errors import ModelError
from dmrl.guards.safe_names import shortened

__all__ = [
    "CONFIDENCE_ONE",
    "PIXEL_ZERO",
    "SUBPIXEL",
    "Add",
    "AnyLayer",
    "Conv",
    "Head",
    "Int32",
    "IntegerNetwork",
    "MaxPool",
    "Shape",
    "require_sound",
]

SUBPIXEL = 16
"""Steps per pixel of integer positions."""
CONFIDENCE_ONE = 65535
"""Integer confidence that stands for 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Head:
    """One channel of a signed tensor that is a result, with its own scale.

    Parameters
    ----------
    tensor, channel
        Where it is. No layer reads a tensor that has a head.
    scale, zero_point
        Its real value is ``scale * (q - zero_point)``.
    table
        (256,) int32, indexed by q + 128, never falling in the confidence: what the value means
        as an integer. Confidence: 0 to 65535 for 0 to 1. Depth: mm, 0 to 65535. Offsets: where
        the robot is from the left (top) edge of the cell, in 1/16 px, -32768 to 32767.
    """

    tensor: int
    channel: int
    scale: float
    zero_point: int
    table: Int32


@dataclass(frozen=True, slots=True, eq=False)
class IntegerNetwork:
    """A whole int8 network.

    Parameters
    ----------
    name
        Of the model, for people.
    architecture
        Of the network it came from.
    channels, height_px, width_px
        Of the image: 3 for RGB, 1 for grey.
    stride_px
        Side of a grid cell.
    layers
        In the order of computing; every layer reads tensors that are there by then.
    confidence, depth
        The heads, all of one grid.
    offset_u, offset_v
        Heads of the sub-cell position; without them a robot is at its cell's centre.
    threshold
        Confidence from which a detection is to be believed, 0 to 1.
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
        """The heads that there are, by name."""
        named = {
            "confidence": self.confidence,
            "depth": self.depth,
            "offset_u": self.offset_u,
            "offset_v": self.offset_v,
        }
        return {name: head for name, head in named.items() if head is not None}

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """Channels, rows and columns of every tensor."""
        shapes: list[Shape] = [(self.channels, self.height_px, self.width_px)]
        for layer in self.layers:
            shapes.append(layer.shape(tuple(shapes[k] for k in layer.sources)))
        return tuple(shapes)

    @property
    def grid_shape(self) -> tuple[int, int]:
        """Rows and columns of the grid of cells."""
        return self.shapes[self.confidence.tensor][1:]

    @property
    def macs(self) -> int:
        """Multiply-accumulates of an image."""
        shapes = self.shapes
        return sum(
            layer.macs((shapes[layer.source],)) for layer in self.layers if isinstance(layer, Conv)
        )

    @property
    def threshold_q(self) -> int:
        """Smallest confidence, as int8, from which a detection is to be believed; 128: none."""
        believed = np.flatnonzero(self.confidence.table >= round(self.threshold * CONFIDENCE_ONE))
        return int(believed[0]) - 128 if believed.size else 128


def require_sound(network: IntegerNetwork) -> None:
    """Nothing, if the network keeps every promise of its layers.

    Raises
    ------
    ModelError
        If not; the layer is named.
    """
    for index, layer in enumerate(network.layers):
        if not all(0 <= k <= index for k in layer.sources):
            raise unsound(layer, f"reads tensors {layer.sources}, of which not all are before it")
    shapes = network.shapes
    signed = [False, *(layer.signed for layer in network.layers)]
    for layer, shape in zip(network.layers, shapes[1:], strict=True):
        inputs = tuple(shapes[k] for k in layer.sources)
        if min(shape) < 1:
            raise unsound(layer, f"leaves nothing of {inputs[0][2]} x {inputs[0][1]}")
        layer.require_sound(inputs, tuple(signed[k] for k in layer.sources))
    read = {k for layer in network.layers for k in layer.sources}
    for name, head in network.heads.items():
        on_grid = shapes[head.tensor][1:] == network.grid_shape
        if not signed[head.tensor] or head.tensor in read or not on_grid:
            raise ModelError(f"head {name} is no signed tensor of the grid. Quantise again")
    named = Counter(layer.name for layer in network.layers)
    if twice := [name for name, count in named.items() if count > 1]:
        raise ModelError(f"two layers are called {shortened(twice[0])!r}. Quantise the model again")
