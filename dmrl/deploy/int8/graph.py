"""Float network as plain layers: NumPy arrays, batch normalisation folded, ReLU fused.

This module alone decides which layers int8 supports; all later steps use these layers. Tensor
numbers are those of `network`: 0 is the image, layer i writes tensor i + 1.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.int8.layers import PIXEL_ZERO
from dmrl.deploy.int8.windows import extract_taps, max_pool_2x2
from dmrl.errors import ModelError
from dmrl.learn.networks.graph_ops import Op

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class FloatConv:
    """Convolution with an optional ReLU. Fields as in `Conv`, in real numbers.

    A second source is a shortcut: a tensor that is added before the ReLU.
    """

    name: str
    sources: tuple[int] | tuple[int, int]
    weight: Array
    bias: Array
    stride: int = 1
    dilation: int = 1
    padding: int = 0
    groups: int = 1
    relu: bool = False


@dataclass(frozen=True, slots=True)
class FloatPool:
    """2x2 max-pool."""

    name: str
    sources: tuple[int]
    relu: bool = False


@dataclass(frozen=True, slots=True)
class FloatAdd:
    """Sum of two tensors with an optional ReLU."""

    name: str
    sources: tuple[int, int]
    relu: bool = False


FloatLayer = FloatConv | FloatPool | FloatAdd


@dataclass(frozen=True, slots=True, eq=False)
class FloatGraph:
    """A float network.

    Parameters
    ----------
    layers
        Layers in order of computation.
    outputs
        Tensor and channel of every channel of the network's output.
    channels
        Channels of the image: 3 for RGB, 1 for grey.
    """

    layers: tuple[FloatLayer, ...]
    outputs: tuple[tuple[int, int], ...]
    channels: int = 3

    def to_grey(self) -> "FloatGraph":
        """Return the network for grey images; its output equals that for R = G = B."""
        layers = [
            replace(layer, weight=layer.weight.sum(axis=1, keepdims=True))
            if 0 in layer.sources and isinstance(layer, FloatConv)
            else layer
            for layer in self.layers
        ]
        return replace(self, layers=tuple(layers), channels=1)


REPLACEMENTS = {
    **dict.fromkeys(("LeakyReLU", "ReLU6", "SiLU", "GELU", "Hardswish", "PReLU"), "ReLU"),
    **dict.fromkeys(("GroupNorm", "LayerNorm", "InstanceNorm2d"), "BatchNorm2d"),
    **dict.fromkeys(
        ("ConvTranspose2d", "Upsample", "interpolate"), "a convolution at the finer stride"
    ),
    **dict.fromkeys(("Sigmoid", "sigmoid"), "the logit, as the other networks return"),
    "AvgPool2d": "a strided convolution or a 2x2 max-pool",
    "AdaptiveAvgPool2d": "a strided convolution",
    "mul": "a convolution, a residual sum or a 2x2 max-pool",
    "concatenate": "a residual sum (only outputs can be concatenated)",
}
SUPPORTED_LAYERS = "convolutions (1x1 or 3x3), BatchNorm2d, ReLU, sums and 2x2 max-pools"


class UnsupportedLayer(ModelError):
    """Error for a layer that int8 does not support; the message contains a replacement."""

    def __init__(self, name: str, what: str, instead: str = SUPPORTED_LAYERS) -> None:
        super().__init__(f"layer {name} is {what}, which int8 does not support. Use {instead}")


def _refuse_unsupported(op: Op, *faults: tuple[bool, str, str]) -> None:
    """Raise UnsupportedLayer for the first fault: whether it is there, its name, a replacement."""
    for wrong, what, instead in faults:
        if wrong:
            raise UnsupportedLayer(op.name, what, instead)


def build_graph(operations: Sequence[Op]) -> FloatGraph:
    """Build the layer graph of a network's operations.

    Parameters
    ----------
    operations
        Operations from `trace_operations`.

    Raises
    ------
    ModelError
        If int8 does not support an operation; the message contains its name and a replacement.
    """
    builder = _GraphBuilder(Counter(source for op in operations for source in op.sources))
    for op in operations:
        builder.add_op(op)
    return FloatGraph(tuple(builder.layers), builder.outputs, builder.channels)


class _GraphBuilder:
    """Converts operations, in order, to layers."""

    def __init__(self, users: Counter[str]) -> None:
        self.users = users
        self.layers: list[FloatLayer] = []
        self.tensor_of: dict[str, int] = {}
        self.parts: dict[str, tuple[tuple[int, int], ...]] = {}
        self.outputs: tuple[tuple[int, int], ...] = ()
        self.channels = 3

    def add_op(self, op: Op) -> None:
        """Convert the next operation."""
        for source in op.sources:
            if source in self.parts and op.kind != "output":
                raise UnsupportedLayer(
                    source, "a concatenation inside the network", "a residual sum"
                )
        takes = {
            "image": self._add_image,
            "conv": self._add_conv,
            "norm": self._fold_norm,
            "relu": self._fuse_relu,
            "max_pool": self._add_pool,
            "add": self._add_sum,
            "concatenate": self._add_concatenation,
            "output": self._mark_outputs,
        }
        if op.kind not in takes:
            article = "an" if op.kind[0].lower() in "aeiou" else "a"
            raise UnsupportedLayer(
                op.name, f"{article} {op.kind}", REPLACEMENTS.get(op.kind, SUPPORTED_LAYERS)
            )
        takes[op.kind](op)

    def _append_layer(self, op: Op, layer: FloatLayer) -> None:
        self.layers.append(layer)
        self.tensor_of[op.name] = len(self.layers)

    def _source_tensors(self, op: Op) -> list[int]:
        return [self.tensor_of[source] for source in op.sources]

    def _add_image(self, op: Op) -> None:
        self.tensor_of[op.name] = 0

    def _add_conv(self, op: Op) -> None:
        (source,) = self._source_tensors(op)
        weight, bias, asked = op.values["weight"], op.values["bias"], op.settings
        outs, ins, *kernel = weight.shape
        stride, dilation, padding, groups = (
            asked[name] for name in ("stride", "dilation", "padding", "groups")
        )
        size, same = " x ".join(map(str, kernel)), (0, dilation * (kernel[0] // 2))
        both_ways = all(isinstance(value, int) for value in (stride, dilation, padding))
        padded = padding not in same or "padding_mode" in asked
        grouped = groups > 1 and (ins > 1 or outs != groups)
        depthwise = "groups=1, or depthwise: as many groups as channels in and out"
        _refuse_unsupported(
            op,
            (kernel not in ([1, 1], [3, 3]), f"a {size} convolution", "1x1 or 3x3 convolutions"),
            (not both_ways, "a convolution that differs by direction", "one stride both ways"),
            (padded, f"a convolution with padding {padding}", "'same' zero padding"),
            (grouped, f"a convolution in {groups} groups", depthwise),
        )
        if source == 0:
            self.channels = ins * groups
        self._append_layer(
            op, FloatConv(op.name, (source,), weight, bias, stride, dilation, padding, groups)
        )

    def _fold_norm(self, op: Op) -> None:
        (tensor,) = self._source_tensors(op)
        layer = self._exclusive_layer(op, tensor)
        if not isinstance(layer, FloatConv) or layer.relu or len(layer.sources) > 1:
            raise UnsupportedLayer(
                op.name, "a BatchNorm2d apart from a convolution", "a BatchNorm2d right after one"
            )
        factor, summand = op.values["factor"], op.values["summand"]
        weight = layer.weight * factor[:, None, None, None]
        self.layers[tensor - 1] = replace(layer, weight=weight, bias=layer.bias * factor + summand)
        self.tensor_of[op.name] = tensor

    def _fuse_relu(self, op: Op) -> None:
        (tensor,) = self._source_tensors(op)
        layer = self._exclusive_layer(op, tensor)
        if not isinstance(layer, FloatConv | FloatAdd):
            raise UnsupportedLayer(
                op.name, "a ReLU apart from a convolution or sum", "a ReLU right after one"
            )
        self.layers[tensor - 1] = replace(layer, relu=True)
        self.tensor_of[op.name] = tensor

    def _exclusive_layer(self, op: Op, tensor: int) -> FloatLayer | None:
        """Return the layer whose output only this operation reads, or None."""
        alone = self.users[op.sources[0]] == 1
        return self.layers[tensor - 1] if alone and tensor else None

    def _add_pool(self, op: Op) -> None:
        (source,) = self._source_tensors(op)
        plain = set(op.settings) == {"kernel", "stride"}
        odd = not plain or any(side != 2 for side in op.settings.values())
        _refuse_unsupported(
            op,
            (source == 0, "a max-pool of the image", "a convolution first"),
            (odd, f"a max-pool with {op.settings}", "2x2 max-pools with stride 2"),
        )
        self._append_layer(op, FloatPool(op.name, (source,)))

    def _add_sum(self, op: Op) -> None:
        a, b = self._source_tensors(op)
        if 0 in (a, b):
            raise UnsupportedLayer(op.name, "a sum with the image", "a convolution first")
        parts = ((a, b, op.sources[0]), (b, a, op.sources[1]))
        for conv, shortcut, name in parts:
            layer = self.layers[conv - 1]
            if conv == len(self.layers) and self.users[name] == 1 and can_fuse_shortcut(layer):
                self.layers[-1] = replace(layer, sources=(layer.sources[0], shortcut))
                self.tensor_of[op.name] = conv
                return
        self._append_layer(op, FloatAdd(op.name, (a, b)))

    def _add_concatenation(self, op: Op) -> None:
        parts = [self._output_channels(source) for source in op.sources]
        self.parts[op.name] = tuple(part for each in parts for part in each)

    def _output_channels(self, name: str) -> tuple[tuple[int, int], ...]:
        tensor = self.tensor_of[name]
        layer = self.layers[tensor - 1] if tensor else None
        if not isinstance(layer, FloatConv) or layer.relu or len(layer.sources) > 1:
            raise UnsupportedLayer(
                name, "an output that is not a convolution's", "a convolution without ReLU"
            )
        return tuple((tensor, channel) for channel in range(len(layer.bias)))

    def _mark_outputs(self, op: Op) -> None:
        (source,) = op.sources
        self.outputs = self.parts.get(source) or self._output_channels(source)


def can_fuse_shortcut(layer: FloatLayer) -> TypeGuard[FloatConv]:
    """Return whether a layer can absorb a sum: a dense convolution that keeps the size."""
    return (
        isinstance(layer, FloatConv)
        and not layer.relu
        and len(layer.sources) == layer.groups == layer.stride == 1
        and layer.padding == layer.dilation * (layer.weight.shape[2] // 2)
    )


def normalize_images(images: NDArray[np.uint8]) -> Float32:
    """Normalize (N, H, W, C) images to (N, C, H, W) input, ``x / 128 - 1``."""
    planes = images.transpose(0, 3, 1, 2).astype(np.float32)
    scaled: Float32 = planes / np.float32(PIXEL_ZERO) - np.float32(1)
    return scaled


def rgb_to_grey(images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert (N, H, W, 3) RGB to (N, H, W, 1) grey: ``(77 R + 150 G + 29 B + 128) >> 8``."""
    weighted = images.astype(np.uint32) @ np.array([77, 150, 29], np.uint32)
    return ((weighted + 128) >> 8).astype(np.uint8)[..., None]


def compute_rgb_tensors(graph: FloatGraph, images: NDArray[np.uint8]) -> list[Float32]:
    """Compute the tensors of (N, H, W, 3) RGB images, converted to grey if the network needs it."""
    seen = rgb_to_grey(images) if graph.channels == 1 else images
    return compute_tensors(graph, normalize_images(seen))


def compute_tensors(graph: FloatGraph, images: Float32) -> list[Float32]:
    """Compute the input and the output of every layer, each (N, channels, rows, cols)."""
    tensors = [images]
    for layer in graph.layers:
        inputs = [tensors[k] for k in layer.sources]
        if isinstance(layer, FloatConv):
            out = sum(inputs[1:], _convolve(layer, inputs[0]))
        elif isinstance(layer, FloatAdd):
            out = inputs[0] + inputs[1]
        else:
            out = max_pool_2x2(inputs[0])
        tensors.append(np.maximum(out, 0) if layer.relu else out)
    return tensors


def select_outputs(graph: FloatGraph, tensors: list[Float32]) -> Float32:
    """Return the (N, channels, rows, cols) output of the network from its tensors."""
    return np.stack([tensors[tensor][:, channel] for tensor, channel in graph.outputs], axis=1)


def _convolve(layer: FloatConv, x: Float32) -> Float32:
    padding = layer.padding
    padded = np.pad(x, ((0, 0), (0, 0), (padding, padding), (padding, padding)))
    taps = extract_taps(padded, layer.weight.shape[2], layer.stride, layer.dilation)
    count, _, _, rows, cols = taps.shape
    outs = len(layer.bias)
    weight = layer.weight.reshape(outs, -1).astype(np.float32)
    if layer.groups > 1:
        sums = np.einsum("ct,nctrs->ncrs", weight, taps)
    else:
        flat = taps.reshape(count, weight.shape[1], rows * cols)
        sums = (weight @ flat).reshape(count, outs, rows, cols)
    biased: Float32 = sums + layer.bias.astype(np.float32)[:, None, None]
    return biased
