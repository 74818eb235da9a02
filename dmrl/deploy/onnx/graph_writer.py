"""ONNX files of networks: float, and int8 as QDQ (QuantizeLinear and DequantizeLinear pairs).

Both take ``image``, (N, height, width, channels) uint8 as from the camera. They return one
(N, rows, cols) float32 output per channel, see ``OUTPUT_OF``.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.int8.graph import FloatAdd, FloatConv, FloatGraph
from dmrl.deploy.int8.layers import GAIN_SHIFT, PIXEL_ZERO, SIGNED_OFFSET, Add, Conv
from dmrl.deploy.int8.network import Head, IntegerNetwork
from dmrl.deploy.int8.quantise import HEAD_OF_CHANNEL
from dmrl.errors import MissingExtra

try:
    import onnx
    from onnx import TensorProto, helper, numpy_helper
except ImportError as e:
    raise MissingExtra("onnx", "deploy", "ONNX") from e

INPUT_NAME = "image"
OUTPUT_OF = {
    "log_depth": "log_depth",
    "confidence": "confidence_logit",
    "offset_u": "offset_u",
    "offset_v": "offset_v",
}
"""Name of the ONNX output of each channel."""
OPSET, IR_VERSION = 17, 8  # supported by every onnxruntime of the last years


class _OnnxWriter:
    """Collects nodes and constants of a graph; values are identified by name."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: dict[str, Any] = {}
        self.node_outputs: set[str] = set()

    def add_constant(self, name: str, values: NDArray[Any]) -> str:
        """Add a constant unless its name exists; return the name."""
        if name not in self.constants:
            self.constants[name] = numpy_helper.from_array(values.copy(order="C"), name)
        return name

    def add_node(self, kind: str, inputs: Sequence[str], output: str, **settings: Any) -> str:
        """Append a node and return the name of its output."""
        self.nodes.append(helper.make_node(kind, list(inputs), [output], output, **settings))
        self.node_outputs.add(output)
        return output

    def serialize_model(
        self, name: str, image: Sequence[int], outputs: dict[str, tuple[int, int]]
    ) -> bytes:
        """Serialize the graph as an ONNX file."""
        graph = helper.make_graph(
            self.nodes,
            name,
            [helper.make_tensor_value_info(INPUT_NAME, TensorProto.UINT8, ["N", *image])],
            [
                helper.make_tensor_value_info(output, TensorProto.FLOAT, ["N", *grid])
                for output, grid in outputs.items()
            ],
            list(self.constants.values()),
        )
        imports = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(
            graph, producer_name="dmrl", opset_imports=imports, ir_version=IR_VERSION
        )
        onnx.checker.check_model(model, full_check=True)
        written: bytes = model.SerializeToString(deterministic=True)
        return written


class _QuantizedTensor(NamedTuple):
    """Name, scale and zero point of a uint8 tensor."""

    name: str
    scale: float
    zero_point: int


def build_float_onnx(
    graph: FloatGraph,
    channels: Sequence[str],
    *,
    size_px: tuple[int, int],
    grid_shape: tuple[int, int],
) -> bytes:
    """Build the ONNX file of a float network.

    Parameters
    ----------
    graph
        The network.
    channels
        Names of the channels of its output.
    size_px
        Height and width of the images.
    grid_shape
        Rows and columns of the output.
    """
    out = _OnnxWriter()
    folded = _can_fold_input_scale(graph)
    tensors = [_add_pixels(out, scaled=not folded)]
    for layer in graph.layers:
        inputs = [tensors[k] for k in layer.sources]
        name = f"{layer.name}.sum" if layer.relu else layer.name
        if isinstance(layer, FloatConv):
            unscaled = folded and layer.sources[0] == 0
            value = _add_float_convolution(out, layer, inputs, name, unscaled=unscaled)
        elif isinstance(layer, FloatAdd):
            value = out.add_node("Add", inputs, name)
        else:
            value = _add_max_pool(out, inputs[0], name)
        tensors.append(out.add_node("Relu", [value], layer.name) if layer.relu else value)
    names = {}
    for channel, (tensor, place) in zip(channels, graph.outputs, strict=True):
        if channel in OUTPUT_OF:
            at = out.add_constant(f"channel{place}", np.array(place, np.int64))
            names[channel] = out.add_node(
                "Gather", [tensors[tensor], at], OUTPUT_OF[channel], axis=1
            )
    image = (*size_px, graph.channels)
    return out.serialize_model("float", image, dict.fromkeys(names.values(), grid_shape))


def _add_pixels(out: _OnnxWriter, *, scaled: bool) -> str:
    """Add the pixels around 0, scaled to -1 to 1 if wanted."""
    planes = out.add_node("Transpose", [INPUT_NAME], "planes", perm=[0, 3, 1, 2])
    pixels = out.add_node("Cast", [planes], "pixels", to=TensorProto.FLOAT)
    zero = out.add_constant("pixel_zero", np.array(PIXEL_ZERO, np.float32))
    centred = out.add_node("Sub", [pixels, zero], "pixels_centred")
    if not scaled:
        return centred
    scale = out.add_constant("pixel_scale", np.array(1 / PIXEL_ZERO, np.float32))
    return out.add_node("Mul", [centred, scale], "input")


def _add_float_convolution(
    out: _OnnxWriter, layer: FloatConv, inputs: Sequence[str], name: str, *, unscaled: bool
) -> str:
    """Add a convolution with its optional shortcut; its weights scale pixels that are not."""
    weights = layer.weight.astype(np.float32)
    if unscaled:
        weights /= np.float32(PIXEL_ZERO)  # a power of two: bit-identical to scaled pixels
    weight = out.add_constant(f"{layer.name}.weight", weights)
    bias = out.add_constant(f"{layer.name}.bias", layer.bias.astype(np.float32))
    source, *shortcut = inputs
    value = f"{name}.conv" if shortcut else name
    out.add_node("Conv", [source, weight, bias], value, **_conv_attributes(layer))
    return out.add_node("Add", [value, shortcut[0]], name) if shortcut else value


def _can_fold_input_scale(graph: FloatGraph) -> bool:
    """Return whether only convolutions read the image, so that weights can absorb its scale."""
    takes = [layer for layer in graph.layers if 0 in layer.sources]
    convolved = all(isinstance(one, FloatConv) and 0 not in one.sources[1:] for one in takes)
    return convolved and all(tensor for tensor, _ in graph.outputs)


def _conv_attributes(layer: FloatConv | Conv) -> dict[str, Any]:
    return {
        "kernel_shape": list(layer.weight.shape[2:]),
        "strides": [layer.stride] * 2,
        "dilations": [layer.dilation] * 2,
        "pads": [layer.padding] * 4,
        "group": layer.groups,
    }


def _add_max_pool(out: _OnnxWriter, source: str, name: str) -> str:
    return out.add_node("MaxPool", [source], name, kernel_shape=[2, 2], strides=[2, 2])


def int8_onnx(network: IntegerNetwork) -> bytes:
    """Build the QDQ ONNX file of an int8 network.

    Runtimes can fuse each pair of QuantizeLinear and DequantizeLinear into integer operations. No
    sum of these networks lies halfway between two levels, so rounding to nearest gives the levels
    of ``reference``. A signed tensor is written as uint8 around 128: onnxruntime fuses a
    convolution only if input and output have the same type. With a shortcut, the sum of products
    (integers that float32 represents exactly) is not scaled before the shortcut is added. An `Add`
    is rounded from floats.
    """
    out = _OnnxWriter()
    planes = out.add_node("Transpose", [INPUT_NAME], "planes", perm=[0, 3, 1, 2])
    tensors = [_QuantizedTensor(planes, 1 / PIXEL_ZERO, PIXEL_ZERO)]
    of_heads = {head.tensor for head in network.heads.values()}
    for index, layer in enumerate(network.layers):
        inputs = [tensors[k] for k in layer.sources]
        zero = SIGNED_OFFSET if layer.signed else 0
        if index + 1 in of_heads:
            tensors.append(inputs[0])  # read only by heads, which are written separately
        elif isinstance(layer, Conv):
            every = np.arange(len(layer.bias))
            tensors.append(
                _add_convolution(out, layer, inputs, every, layer.scale, zero, layer.name)
            )
        else:
            reals = [_add_dequantize(out, each) for each in inputs]
            if isinstance(layer, Add):
                value = out.add_node("Add", reals, f"{layer.name}.sum")
            else:
                value = _add_max_pool(out, reals[0], f"{layer.name}.largest")
            tensors.append(_add_quantize(out, value, layer.name, layer.scale, zero))
    heads = network.heads
    names = {OUTPUT_OF[key]: name for key, name in HEAD_OF_CHANNEL.items() if name in heads}
    for output, name in names.items():
        _add_head(out, network, network.heads[name], output, tensors)
    image = (network.height_px, network.width_px, network.channels)
    return out.serialize_model("int8", image, dict.fromkeys(names, network.grid_shape))


def _add_head(
    out: _OnnxWriter,
    network: IntegerNetwork,
    head: Head,
    name: str,
    tensors: list[_QuantizedTensor],
) -> None:
    layer = network.layers[head.tensor - 1]
    assert isinstance(layer, Conv)
    inputs, chosen = [tensors[k] for k in layer.sources], np.array([head.channel])
    zero = head.zero_point + SIGNED_OFFSET
    levels = _add_convolution(out, layer, inputs, chosen, head.scale, zero, f"{layer.name}.{name}")
    axis = out.add_constant("channel_axis", np.array([1], np.int64))
    out.add_node("Squeeze", [_add_dequantize(out, levels), axis], name)


def _add_convolution(
    out: _OnnxWriter,
    layer: Conv,
    inputs: list[_QuantizedTensor],
    chosen: NDArray[np.integer],
    scale: float,
    zero_point: int,
    name: str,
) -> _QuantizedTensor:
    """Add a convolution, limited to the chosen output channels, with its optional shortcut."""
    weight, divisor = layer.weight[chosen], layer.divisor[chosen]
    bias = layer.bias[chosen].astype(np.float64) - divisor // 2 - np.rint(zero_point * divisor)
    if layer.source == 0:
        bias += PIXEL_ZERO * weight.astype(np.int64).sum(axis=(1, 2, 3))
    bias = np.clip(bias, -(2**31), 2**31 - 1)
    source, *shortcut = inputs
    if shortcut:
        operands = [
            _add_dequantize(out, source._replace(scale=1.0)),
            out.add_constant(f"{name}.weight", weight.astype(np.float32)),
            out.add_constant(f"{name}.bias", bias.astype(np.float32)),
        ]
        products = out.add_node("Conv", operands, f"{name}.products", **_conv_attributes(layer))
        both = [products, _add_shortcut(out, layer, shortcut[0], chosen, name)]
        value = out.add_node("Add", both, f"{name}.sum")
        levels = _add_quantize_per_channel(out, value, f"{name}.sum", divisor, zero_point)
        return _QuantizedTensor(levels, scale, zero_point)
    operands = [
        _add_dequantize(out, source),
        _add_dequantized_constant(out, f"{name}.weight", weight, scale / divisor / source.scale),
        _add_dequantized_constant(out, f"{name}.bias", bias.astype(np.int32), scale / divisor),
    ]
    value = out.add_node("Conv", operands, f"{name}.sum", **_conv_attributes(layer))
    return _add_quantize(out, value, name, scale, zero_point)


def _add_shortcut(
    out: _OnnxWriter,
    layer: Conv,
    shortcut: _QuantizedTensor,
    chosen: NDArray[np.integer],
    name: str,
) -> str:
    """Add the nodes that scale a shortcut for the sums of the chosen channels."""
    levels = _add_dequantize(out, shortcut._replace(scale=1.0))
    if len(chosen) < len(layer.bias):
        places = out.add_constant(f"{name}.places", chosen.astype(np.int64))
        levels = out.add_node("Gather", [levels, places], f"{name}.chosen", axis=1)
    gain = layer.gain[chosen].reshape(-1, 1, 1) / 2.0**GAIN_SHIFT
    gains = out.add_constant(f"{name}.gain", gain.astype(np.float32))
    return out.add_node(
        "Floor", [out.add_node("Mul", [levels, gains], f"{name}.gained")], f"{name}.shortcut"
    )


def _add_dequantized_constant(
    out: _OnnxWriter, name: str, levels: NDArray[Any], scale: NDArray[np.float64]
) -> str:
    """Add a dequantized constant with one scale per index of its first axis."""
    inputs = [
        out.add_constant(f"{name}.levels", levels),
        out.add_constant(f"{name}.scale", scale.astype(np.float32)),
        out.add_constant(f"{name}.zero", np.zeros(len(scale), levels.dtype)),
    ]
    return out.add_node("DequantizeLinear", inputs, name, axis=0)


def _add_dequantize(out: _OnnxWriter, tensor: _QuantizedTensor) -> str:
    """Add the dequantization of a tensor, once per scale."""
    name = f"{tensor.name}.by.{tensor.scale:.9g}"
    if name not in out.node_outputs:
        scale = out.add_constant(f"{name}.scale", np.array(tensor.scale, np.float32))
        zero = out.add_constant(f"{name}.zero", np.array(tensor.zero_point, np.uint8))
        out.add_node("DequantizeLinear", [tensor.name, scale, zero], name)
    return name


def _add_quantize(
    out: _OnnxWriter, value: str, name: str, scale: float, zero_point: int
) -> _QuantizedTensor:
    scale_name = out.add_constant(f"{name}.scale", np.array(scale, np.float32))
    zero_name = out.add_constant(f"{name}.zero", np.array(zero_point, np.uint8))
    levels = out.add_node("QuantizeLinear", [value, scale_name, zero_name], f"{name}.levels")
    return _QuantizedTensor(levels, scale, zero_point)


def _add_quantize_per_channel(
    out: _OnnxWriter, value: str, name: str, divisor: NDArray[np.float64], zero_point: int
) -> str:
    """Add the quantization of sums with one divisor per channel."""
    scale_name = out.add_constant(f"{name}.divisor", divisor.astype(np.float32))
    zeros = out.add_constant(f"{name}.zero", np.full(len(divisor), zero_point, np.uint8))
    return out.add_node("QuantizeLinear", [value, scale_name, zeros], f"{name}.levels", axis=1)
