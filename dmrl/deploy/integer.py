"""An int8 network: what the C is generated from and what ``reference`` computes.

Tensor 0 is the image, uint8; layer i writes tensor i + 1. A tensor is (channels, rows, columns)
of uint8, or of int8 where its layer says ``signed``. Its real values are
``scale * (q - zero_point)``; the zero point is 0 everywhere but in the image (128, the pixel
that stands for 0.0) and in the heads.

Every layer ends in one rounding, of integers alone: ``(x + 2^(shift - 1)) >> shift`` with an
arithmetic shift (half goes up), then a clamp to the range of the output's type. The clamp of
an unsigned tensor at 0 is the ReLU.
"""

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from dmrl.errors import ModelError

Int8 = NDArray[np.int8]
Int32 = NDArray[np.int32]
Array = NDArray[np.float64]
Shape = tuple[int, int, int]

PIXEL_ZERO = 128
"""Pixel that is 0.0 to the network, whose input is ``x / 128 - 1``; images are padded with it."""
Q_LEVELS = 256
SUBPIXEL = 16
"""Steps per pixel of integer positions."""
CONFIDENCE_ONE = 65535
"""Integer confidence that stands for 1."""


class Layer(Protocol):
    """What every layer says of itself."""

    kind: ClassVar[str]

    @property
    def name(self) -> str:
        """Of the layer, as the network calls it."""

    @property
    def sources(self) -> tuple[int, ...]:
        """Tensors it reads."""

    @property
    def signed(self) -> bool:
        """Whether its output is int8; otherwise uint8."""

    @property
    def scale(self) -> float:
        """Real value of one step of its output. Of a head: see `Head`."""

    def shape(self, inputs: tuple[Shape, ...]) -> Shape:
        """Channels, rows and columns of its output."""


@dataclass(frozen=True, slots=True, eq=False)
class Conv:
    """Convolution, and ReLU where the output is unsigned.

    ``acc = bias + sum(weight * x)`` fits in int32 for every input; then, per output channel,
    ``q = clamp((acc * multiplier + 2^(shift - 1)) >> shift)``, the product in int64.

    Output row r reads the input rows ``r * stride - padding + dilation * k``, columns likewise;
    what lies outside reads as ``pad_value``. Rows: ``(h + 2 padding - dilation (k - 1) - 1) //
    stride + 1``.

    Parameters
    ----------
    name
        As the network calls it.
    source
        Tensor it reads.
    weight
        (out, in / groups, k, k) int8, -127 to 127, k is 1 or 3.
    bias
        (out,) int32. The zero point of the image is folded in.
    multiplier
        (out,) int32, 2^30 to 2^31 - 1.
    shift
        (out,) int32, 1 to 62. The real factor is ``multiplier / 2^shift``.
    stride, dilation, padding
        The same both ways.
    groups
        1, or the number of channels (depthwise, as many out as in).
    signed
        Whether the output is int8 (no ReLU).
    pad_value
        128 for the image, else 0.
    scale
        Real value of one step of the output; 1 where the output is read by heads alone.
    """

    kind: ClassVar[str] = "conv"
    name: str
    source: int
    weight: Int8
    bias: Int32
    multiplier: Int32
    shift: Int32
    stride: int = 1
    dilation: int = 1
    padding: int = 0
    groups: int = 1
    signed: bool = False
    pad_value: int = 0
    scale: float = 1.0

    @property
    def sources(self) -> tuple[int, ...]:
        """Tensors it reads."""
        return (self.source,)

    @property
    def kernel(self) -> int:
        """Side of the kernel."""
        return int(self.weight.shape[2])

    @property
    def depthwise(self) -> bool:
        """Whether every channel is convolved alone."""
        return self.groups > 1

    def shape(self, inputs: tuple[Shape, ...]) -> Shape:
        """Channels, rows and columns of its output."""
        reach = self.dilation * (self.kernel - 1) + 1
        rows, cols = (
            (side + 2 * self.padding - reach) // self.stride + 1 for side in inputs[0][1:]
        )
        return self.weight.shape[0], rows, cols

    def macs(self, inputs: tuple[Shape, ...]) -> int:
        """Multiplications that an image takes."""
        channels, rows, cols = self.shape(inputs)
        return channels * rows * cols * int(np.prod(self.weight.shape[1:]))


@dataclass(frozen=True, slots=True)
class MaxPool:
    """Largest of each 2x2 block; an odd last row or column is left out. No rounding."""

    kind: ClassVar[str] = "max_pool"
    name: str
    source: int
    signed: bool = False
    scale: float = 1.0

    @property
    def sources(self) -> tuple[int, ...]:
        """Tensors it reads."""
        return (self.source,)

    def shape(self, inputs: tuple[Shape, ...]) -> Shape:
        """Channels, rows and columns of its output."""
        channels, rows, cols = inputs[0]
        return channels, rows // 2, cols // 2


@dataclass(frozen=True, slots=True)
class Add:
    """Sum of two tensors of one shape, and ReLU where the output is unsigned.

    ``q = clamp((a * multipliers[0] + b * multipliers[1] + 2^(shift - 1)) >> shift)``; every
    term and the sum fit in int32.

    Parameters
    ----------
    sources
        The two tensors, either of them signed or not.
    multipliers
        0 to 2^21 - 1; the larger is at least 2^20.
    shift
        1 to 30, the same for both.
    """

    kind: ClassVar[str] = "add"
    name: str
    sources: tuple[int, int]
    multipliers: tuple[int, int]
    shift: int
    signed: bool = False
    scale: float = 1.0

    def shape(self, inputs: tuple[Shape, ...]) -> Shape:
        """Channels, rows and columns of its output."""
        return inputs[0]


AnyLayer = Conv | MaxPool | Add


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
    signed = [False]
    for index, layer in enumerate(network.layers):
        if not all(0 <= k <= index for k in layer.sources):
            raise _unsound(layer, f"reads tensors {layer.sources}, of which not all are before it")
        signed.append(layer.signed)
    shapes = network.shapes
    for index, layer in enumerate(network.layers):
        inputs = tuple(shapes[k] for k in layer.sources)
        if min(shapes[index + 1]) < 1:
            raise _unsound(layer, f"leaves nothing of {inputs[0][2]} x {inputs[0][1]}")
        if isinstance(layer, Conv):
            _require_sound_conv(layer, inputs[0][0], signed[layer.source])
        elif isinstance(layer, Add):
            _require_sound_add(layer, inputs)
        elif layer.signed != signed[layer.source]:
            raise _unsound(layer, "changes the type of its input")
    grid = shapes[network.confidence.tensor][1:]
    read = {k for layer in network.layers for k in layer.sources}
    for name, head in network.heads.items():
        if not signed[head.tensor] or head.tensor in read or shapes[head.tensor][1:] != grid:
            raise ModelError(f"head {name} is no signed tensor of the grid. Quantise again")


def _require_sound_conv(layer: Conv, channels: int, signed_input: bool) -> None:
    outs, ins, rows, cols = layer.weight.shape
    if (rows, cols) not in ((1, 1), (3, 3)) or ins * layer.groups != channels:
        raise _unsound(layer, f"has weights {layer.weight.shape} for {channels} channels")
    if layer.groups not in (1, channels) or (layer.groups > 1 and outs != channels):
        raise _unsound(layer, f"has {layer.groups} groups of {channels} channels")
    largest = np.abs(layer.weight.astype(np.int64)).sum(axis=(1, 2, 3)) * (
        128 if signed_input else 255
    )
    if (largest + np.abs(layer.bias.astype(np.int64))).max() >= 2**31:
        raise _unsound(layer, "can overflow int32")
    if (layer.multiplier < 2**30).any() or (layer.shift < 1).any() or (layer.shift > 62).any():
        raise _unsound(layer, "has a multiplier or shift out of range")


def _require_sound_add(layer: Add, inputs: tuple[Shape, ...]) -> None:
    if inputs[0] != inputs[1]:
        raise _unsound(layer, f"adds {inputs[0]} to {inputs[1]}")
    low, high = sorted(layer.multipliers)
    if not (low >= 0 and 2**20 <= high < 2**21 and 1 <= layer.shift <= 30):
        raise _unsound(layer, "has a multiplier or shift out of range")


def _unsound(layer: AnyLayer, what: str) -> ModelError:
    return ModelError(f"layer {layer.name} {what}. Quantise the model again")
