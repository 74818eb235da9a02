"""Layers of an int8 network: parameters, output shapes, and invariants.

Each has a ``name`` and a ``kind``, the tensors that it reads (``sources``), whether its output is
int8 (``signed``, else uint8), and the real value of one step of the output (``scale``).

``reference`` computes them, the templates of ``c`` are their C. A network checks its layers when it
is created, so neither has to handle overflow.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

Int8 = NDArray[np.int8]
Int32 = NDArray[np.int32]
Array = NDArray[np.float64]
Shape = tuple[int, int, int]

PIXEL_ZERO = 128
"""Zero point of the image: the pixel value of input 0.0, since input is ``x / 128 - 1``. Also the
padding of images."""
GAIN_SHIFT = 8
"""Fractional bits of a shortcut's gain, needed where a step of the sum is larger than its own."""
SIGNED_OFFSET = 128
"""Offset of a signed convolution's sums over its output, in levels. It makes all representable sums
positive: a multiplier that is rounded up would give one level too few for negative ones."""


@dataclass(frozen=True, slots=True, eq=False)
class Conv:
    """Convolution; with ReLU where the output is unsigned.

    ``acc = bias + sum(weight * x)``, plus ``(gain * s) >> GAIN_SHIFT`` for a shortcut, fits in
    int32 for every input. Requantization per output channel: ``q = clamp((acc * multiplier) >>
    shift)`` with the product in int64. A signed output subtracts `SIGNED_OFFSET` before the clamp.
    The bias includes half a step, for rounding, and that offset. The shift is nearly always 32: q
    is then the high word of the product.

    Output row r reads the input rows ``r * stride - padding + dilation * k``, columns likewise;
    positions outside read as ``pad_value``. Number of rows:
    ``(h + 2 padding - dilation (k - 1) - 1) // stride + 1``.

    Parameters
    ----------
    name
        Name of the layer in the network.
    source
        Tensor it reads.
    weight
        (out, in / groups, k, k) int8, -127 to 127, k is 1 or 3.
    bias
        (out,) int32, with the zero point of the image, half a step of the output and the offset of
        a signed output folded in.
    multiplier
        (out,) int32, 1 to 2^31 - 1. The real factor is ``multiplier / 2^shift``.
    shift
        1 to 32, the same for all channels.
    stride, dilation, padding
        The same both ways.
    groups
        1, or the number of channels (depthwise, as many out as in).
    signed
        Whether the output is int8 (no ReLU).
    pad_value
        128 for the image, else 0.
    scale
        Real value of one step of the output; 1 if only heads read the output.
    shortcut
        Tensor of the output's shape that is added before the requantization; -1: none. The
        convolution is then dense and keeps the size.
    gain
        (out,) int32, 0 to 2^23 - 1, factors of the shortcut's values; empty without a shortcut.
    """

    kind: ClassVar[str] = "conv"
    name: str
    source: int
    weight: Int8
    bias: Int32
    multiplier: Int32
    shift: int
    stride: int = 1
    dilation: int = 1
    padding: int = 0
    groups: int = 1
    signed: bool = False
    pad_value: int = 0
    scale: float = 1.0
    shortcut: int = -1
    gain: Int32 = field(default_factory=lambda: np.zeros(0, np.int32))

    @property
    def sources(self) -> tuple[int, ...]:
        """Tensors it reads: the input, then the shortcut if there is one."""
        return (self.source,) if self.shortcut < 0 else (self.source, self.shortcut)

    @property
    def kernel(self) -> int:
        """Side of the kernel."""
        return int(self.weight.shape[2])

    @property
    def depthwise(self) -> bool:
        """Whether it is a depthwise convolution."""
        return self.groups > 1

    @property
    def divisor(self) -> Array:
        """(out,) divisors of the sums: whole numbers, or one over a whole number."""
        factor = self.multiplier / 2.0**self.shift
        near: Array = np.rint(np.maximum(1 / factor, 1)) / np.rint(np.maximum(factor, 1))
        return near

    def output_shape(self, inputs: tuple[Shape, ...]) -> Shape:
        """Return channels, rows and columns of its output."""
        reach = self.dilation * (self.kernel - 1) + 1 - 2 * self.padding
        rows, cols = ((side - reach) // self.stride + 1 for side in inputs[0][1:])
        return self.weight.shape[0], rows, cols

    def count_macs(self, inputs: tuple[Shape, ...]) -> int:
        """Return the multiply-accumulates per image."""
        channels, rows, cols = self.output_shape(inputs)
        return channels * rows * cols * int(np.prod(self.weight.shape[1:]))

    def iter_faults(self, inputs: tuple[Shape, ...], signed: tuple[bool, ...]) -> Iterator[str]:
        """Yield shapes that do not fit and numbers that could overflow; the first one counts."""
        channels = inputs[0][0]
        outs, ins, *kernel = self.weight.shape
        if kernel not in ([1, 1], [3, 3]) or ins * self.groups != channels:
            yield f"has weights {self.weight.shape} for {channels} channels"
        if self.groups not in (1, channels) or (self.depthwise and outs != channels):
            yield f"has {self.groups} groups of {channels} channels"
        own = (self.bias, self.multiplier, *([self.gain] if len(inputs) > 1 else []))
        if any(one.shape != (outs,) for one in own):
            yield f"lacks a bias, multiplier or gain for some of {outs} channels"
        # Bound on the sum: the largest input value of the type times the sum of absolute weights.
        largest_input = 128 if signed[0] else 255
        largest = largest_input * np.abs(self.weight.astype(np.int64)).sum(axis=(1, 2, 3))
        if len(inputs) > 1:
            out = self.output_shape(inputs)
            if self.depthwise or inputs[1] != out or out[1:] != inputs[0][1:]:
                yield f"adds {inputs[1]} to {out}"
            if (self.gain < 0).any() or (self.gain >= 2**23).any():
                yield "has a gain out of range"
            largest += (128 if signed[1] else 255) * self.gain.astype(np.int64) >> GAIN_SHIFT
        if (largest + np.abs(self.bias.astype(np.int64))).max() >= 2**31:
            yield "can overflow int32"
        if (self.multiplier < 1).any() or not 1 <= self.shift <= 32:
            yield "has a multiplier or shift out of range"


@dataclass(frozen=True, slots=True)
class MaxPool:
    """2x2 max-pool; an odd last row or column is left out. No rounding."""

    kind: ClassVar[str] = "max_pool"
    name: str
    source: int
    signed: bool = False
    scale: float = 1.0

    @property
    def sources(self) -> tuple[int, ...]:
        """Tensors it reads."""
        return (self.source,)

    def output_shape(self, inputs: tuple[Shape, ...]) -> Shape:
        """Return channels, rows and columns of its output."""
        channels, rows, cols = inputs[0]
        return channels, rows // 2, cols // 2

    def iter_faults(self, inputs: tuple[Shape, ...], signed: tuple[bool, ...]) -> Iterator[str]:
        """Yield a difference between the types of input and output."""
        if self.signed != signed[0]:
            yield "changes the type of its input"


@dataclass(frozen=True, slots=True)
class Add:
    """Sum of two tensors of one shape; with ReLU where the output is unsigned.

    ``q = clamp((a * multipliers[0] + b * multipliers[1] + 2^(shift - 1)) >> shift)``; every term
    and the sum fit in int32.

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

    def output_shape(self, inputs: tuple[Shape, ...]) -> Shape:
        """Return channels, rows and columns of its output."""
        return inputs[0]

    def iter_faults(self, inputs: tuple[Shape, ...], signed: tuple[bool, ...]) -> Iterator[str]:
        """Yield shapes of the inputs that differ and numbers out of range."""
        if inputs[0] != inputs[1]:
            yield f"adds {inputs[0]} to {inputs[1]}"
        low, high = sorted(self.multipliers)
        if not (low >= 0 and 2**20 <= high < 2**21 and 1 <= self.shift <= 30):
            yield "has a multiplier or shift out of range"


AnyLayer = Conv | MaxPool | Add
