"""Networks as ONNX: float, and int8 as QDQ (quantise and dequantise pairs). A home of onnx.

Both take ``image``, (N, height, width, channels) uint8 as it comes from the camera, and give
one (N, rows, cols) float32 output per channel, see ``OUTPUT_OF``.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.graph import FloatAdd, FloatConv, Graph
from dmrl.deploy.integer import PIXEL_ZERO, Add, Conv, Head, IntegerNetwork
from dmrl.deploy.quantise import HALF_STEP, HEAD_OF, SHORTCUT_LOSES
from dmrl.errors import MissingExtra

try:
    import onnx
    from onnx import TensorProto, helper, numpy_helper
except ImportError as e:
    raise MissingExtra("onnx", "deploy", "ONNX") from e

IMAGE = "image"
OUTPUT_OF = {
    "log_depth": "log_depth",
    "confidence": "confidence_logit",
    "offset_u": "offset_u",
    "offset_v": "offset_v",
}
"""Name of the ONNX output of each channel."""
OPSET, IR_VERSION = 17, 8  # old enough for every onnxruntime of the last years


class _Writer:
    """Collects nodes and constants; a value is known by its name."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: dict[str, Any] = {}

    def constant(self, name: str, values: NDArray[Any]) -> str:
        """The name of a constant; one that is there already is not written again."""
        if name not in self.constants:
            self.constants[name] = numpy_helper.from_array(values.copy(order="C"), name)
        return name

    def node(self, kind: str, inputs: Sequence[str], output: str, **settings: Any) -> str:
        """Append a node; the name of its output comes back."""
        self.nodes.append(helper.make_node(kind, list(inputs), [output], output, **settings))
        return output

    def model(self, name: str, image: Sequence[int], outputs: dict[str, tuple[int, int]]) -> bytes:
        """The whole file."""
        graph = helper.make_graph(
            self.nodes,
            name,
            [helper.make_tensor_value_info(IMAGE, TensorProto.UINT8, ["N", *image])],
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


def float_onnx(
    graph: Graph, channels: Sequence[str], *, size_px: tuple[int, int], grid_shape: tuple[int, int]
) -> bytes:
    """An ONNX file of a float network.

    Parameters
    ----------
    graph
        The network.
    channels
        What the channels of its output are.
    size_px
        Height and width of the images.
    grid_shape
        Rows and columns of the output.
    """
    out = _Writer()
    planes = out.node("Transpose", [IMAGE], "planes", perm=[0, 3, 1, 2])
    pixels = out.node("Cast", [planes], "pixels", to=TensorProto.FLOAT)
    zero = out.constant("pixel_zero", np.array(PIXEL_ZERO, np.float32))
    centred = out.node("Sub", [pixels, zero], "pixels_centred")
    tensors = [centred]
    if not _weights_scale(graph):
        scale = out.constant("pixel_scale", np.array(1 / PIXEL_ZERO, np.float32))
        tensors = [out.node("Mul", [centred, scale], "input")]
    for layer in graph.layers:
        inputs = [tensors[k] for k in layer.sources]
        name = f"{layer.name}.sum" if layer.relu else layer.name
        if isinstance(layer, FloatConv):
            weights = layer.weight.astype(np.float32)
            if inputs[0] == centred:
                weights /= np.float32(PIXEL_ZERO)  # a power of two: the same bits as of the pixels
            weight = out.constant(f"{layer.name}.weight", weights)
            bias = out.constant(f"{layer.name}.bias", layer.bias.astype(np.float32))
            value = f"{name}.conv" if inputs[1:] else name
            out.node("Conv", [inputs[0], weight, bias], value, **_conv_settings(layer))
            if inputs[1:]:
                value = out.node("Add", [value, inputs[1]], name)
        elif isinstance(layer, FloatAdd):
            value = out.node("Add", inputs, name)
        else:
            value = _max_pool(out, inputs[0], name)
        tensors.append(out.node("Relu", [value], layer.name) if layer.relu else value)
    names = {}
    for channel, (tensor, place) in zip(channels, graph.outputs, strict=True):
        if channel in OUTPUT_OF:
            at = out.constant(f"channel{place}", np.array(place, np.int64))
            names[channel] = out.node("Gather", [tensors[tensor], at], OUTPUT_OF[channel], axis=1)
    image = (*size_px, graph.channels)
    return out.model("float", image, dict.fromkeys(names.values(), grid_shape))


def _weights_scale(graph: Graph) -> bool:
    """Whether only convolutions take the image, so that their weights can scale it."""
    takes = [layer for layer in graph.layers if 0 in layer.sources]
    convolved = all(isinstance(one, FloatConv) and 0 not in one.sources[1:] for one in takes)
    return convolved and all(tensor for tensor, _ in graph.outputs)


def _conv_settings(layer: FloatConv | Conv) -> dict[str, Any]:
    return {
        "kernel_shape": list(layer.weight.shape[2:]),
        "strides": [layer.stride] * 2,
        "dilations": [layer.dilation] * 2,
        "pads": [layer.padding] * 4,
        "group": layer.groups,
    }


def _max_pool(out: _Writer, source: str, name: str) -> str:
    return out.node("MaxPool", [source], name, kernel_shape=[2, 2], strides=[2, 2])


def int8_onnx(network: IntegerNetwork) -> bytes:
    """An ONNX file of an int8 network, in pairs of QuantizeLinear and DequantizeLinear.

    What runs it may fuse the pairs into integer operations, and may round otherwise than
    ``reference`` by one level. A signed tensor is written as uint8 around 128, since
    onnxruntime fuses a convolution only where its input and output are of one type. A convolution
    with a shortcut is not rounded before the sum, as in ``reference``: it runs in float.
    """
    out = _Writer()
    levels = out.node("Transpose", [IMAGE], "planes", perm=[0, 3, 1, 2])
    tensors = [_dequantised(out, levels, "image", 1 / PIXEL_ZERO, PIXEL_ZERO)]
    scales = [1 / PIXEL_ZERO]
    of_heads = {head.tensor for head in network.heads.values()}
    for index, layer in enumerate(network.layers):
        inputs = [tensors[k] for k in layer.sources]
        if index + 1 in of_heads:
            assert isinstance(layer, Conv)
            tensors.append("")  # read by heads alone, which are written one by one
        else:
            if isinstance(layer, Conv):
                every = np.arange(len(layer.bias))
                value = _int8_conv(out, layer, inputs[0], scales[layer.source], every, layer.scale)
                if inputs[1:]:
                    value = out.node("Add", [value, inputs[1]], f"{layer.name}.both")
            elif isinstance(layer, Add):
                value = out.node("Add", inputs, f"{layer.name}.sum")
            else:
                value = _max_pool(out, inputs[0], f"{layer.name}.largest")
            zero = 128 if layer.signed else 0
            tensors.append(_requantised(out, value, layer.name, layer.scale, zero))
        scales.append(layer.scale)
    names = [
        _int8_head(out, network, head, OUTPUT_OF[channel], tensors, scales)
        for channel in HEAD_OF
        if (head := network.heads.get(HEAD_OF[channel])) is not None
    ]
    image = (network.height_px, network.width_px, network.channels)
    return out.model("int8", image, dict.fromkeys(names, network.grid_shape))


def _int8_conv(
    out: _Writer,
    layer: Conv,
    source: str,
    source_scale: float,
    chosen: NDArray[np.integer],
    out_scale: float,
    zero_point: int = 0,
    suffix: str = "",
) -> str:
    """The convolution of the chosen output channels, on dequantised values."""
    weight = layer.weight[chosen]
    factor = layer.multiplier[chosen] / 2.0**layer.shift
    bias = layer.bias[chosen].astype(np.int64)
    if layer.source == 0:
        bias += PIXEL_ZERO * weight.astype(np.int64).sum(axis=(1, 2, 3))
    lost = SHORTCUT_LOSES * (len(layer.sources) - 1)
    bias -= np.rint((zero_point + HALF_STEP) / factor + lost).astype(np.int64)
    sum_scale = (factor * out_scale).astype(np.float32)
    name = layer.name + suffix
    levels = out.constant(f"{name}.weight.levels", weight)
    scale = out.constant(f"{name}.weight.scale", (sum_scale / source_scale).astype(np.float32))
    zeros = out.constant(f"{name}.weight.zero", np.zeros(len(chosen), np.int8))
    real = out.node("DequantizeLinear", [levels, scale, zeros], f"{name}.weight", axis=0)
    sums = out.constant(f"{name}.bias.levels", bias.astype(np.int32))
    sum_name = out.constant(f"{name}.bias.scale", sum_scale)
    zero = out.constant(f"{name}.bias.zero", np.zeros(len(chosen), np.int32))
    summand = out.node("DequantizeLinear", [sums, sum_name, zero], f"{name}.bias", axis=0)
    return out.node("Conv", [source, real, summand], f"{name}.sum", **_conv_settings(layer))


def _int8_head(
    out: _Writer,
    network: IntegerNetwork,
    head: Head,
    name: str,
    tensors: list[str],
    scales: list[float],
) -> str:
    layer = network.layers[head.tensor - 1]
    assert isinstance(layer, Conv)
    value = _int8_conv(
        out,
        layer,
        tensors[layer.source],
        scales[layer.source],
        np.array([head.channel]),
        head.scale,
        head.zero_point,
        f".{name}",
    )
    real = _requantised(out, value, f"{layer.name}.{name}", head.scale, head.zero_point + 128)
    axis = out.constant("channel_axis", np.array([1], np.int64))
    return out.node("Squeeze", [real, axis], name)


def _requantised(out: _Writer, value: str, name: str, scale: float, zero_point: int) -> str:
    scale_name = out.constant(f"{name}.scale", np.array(scale, np.float32))
    zero_name = out.constant(f"{name}.zero", np.array(zero_point, np.uint8))
    levels = out.node("QuantizeLinear", [value, scale_name, zero_name], f"{name}.levels")
    return out.node("DequantizeLinear", [levels, scale_name, zero_name], f"{name}.real")


def _dequantised(out: _Writer, levels: str, name: str, scale: float, zero_point: int) -> str:
    scale_name = out.constant(f"{name}.scale", np.array(scale, np.float32))
    zero_name = out.constant(f"{name}.zero", np.array(zero_point, np.uint8))
    return out.node("DequantizeLinear", [levels, scale_name, zero_name], f"{name}.real")
