"""Check an ONNX file of a stranger before onnxruntime sees it.

onnxruntime does whatever a file asks: it runs loops, reads other files, and folds constants of any
size when it loads. This check accepts standard operators without control flow, whose tensors
have known sizes within the limits.
"""

import math
from collections.abc import Iterable
from typing import Any

from dmrl.errors import MissingExtra, ModelError
from dmrl.guards import limits

try:
    import onnx
    from onnx import AttributeProto, TensorProto, helper, shape_inference
except ImportError as e:
    raise MissingExtra("onnx", "deploy", "ONNX") from e

STANDARD_DOMAINS = ("", "ai.onnx")


def require_modest(data: bytes, where: object) -> None:
    """Raise ModelError unless a network can be run within the limits.

    Parameters
    ----------
    data
        The ONNX file.
    where
        Its name in errors.
    """
    try:
        model = onnx.load_model_from_string(data)
        if problem := _find_foreign_part(model):
            raise ValueError(problem)
        for value in model.graph.input:
            for dimension in value.type.tensor_type.shape.dim[:1]:
                dimension.dim_value = 1  # images are run one by one
        inferred = shape_inference.infer_shapes(model, strict_mode=True, data_prop=True)
        _require_sizes(inferred.graph, limits.max_tensor_bytes(len(data)))
    except ModelError:
        raise
    except Exception as e:  # protobuf's and onnx's exceptions have no common base
        why = " ".join(str(e).split())[:300]
        raise ModelError(f"{where} cannot be run: {why}. Export the model again") from None


def _find_foreign_part(model: Any) -> str | None:
    """Return what onnxruntime would do beyond standard operators on constants of the file."""
    if model.functions or any(o.domain not in STANDARD_DOMAINS for o in model.opset_import):
        return "it defines operators, or uses those of others"
    if model.graph.sparse_initializer:
        return "it has sparse constants"
    tensors = list(model.graph.initializer)
    for node in model.graph.node:
        if node.domain not in STANDARD_DOMAINS:
            return f"{node.op_type} is no standard operator"
        for attribute in node.attribute:
            if attribute.type not in _PLAIN_ATTRIBUTES:
                return f"{node.op_type} runs another graph, or has sparse constants"
            tensors += [attribute.t, *attribute.tensors]
    if any(one.data_location == TensorProto.EXTERNAL or one.external_data for one in tensors):
        return "its constants are in other files"
    return None


_PLAIN_ATTRIBUTES = (
    *(AttributeProto.FLOAT, AttributeProto.INT, AttributeProto.STRING, AttributeProto.TENSOR),
    *(AttributeProto.FLOATS, AttributeProto.INTS, AttributeProto.STRINGS, AttributeProto.TENSORS),
)


def _require_sizes(graph: Any, most_bytes: int) -> None:
    """Raise ValueError unless the tensors that live at a time, and the work, are within limits."""
    shapes = {one.name: list(one.dims) for one in graph.initializer}
    constants = set(shapes)
    sizes = {one.name: _count_bytes(one.data_type, one.dims) for one in graph.initializer}
    for value in (*graph.input, *graph.value_info, *graph.output):
        shape = _parse_shape(value)
        shapes.setdefault(value.name, shape)
        sizes.setdefault(value.name, _count_bytes(value.type.tensor_type.elem_type, shape))
    last_use = {name: k for k, node in enumerate(graph.node) for name in node.input}
    last_use |= {one.name: len(graph.node) for one in graph.output}
    living, work = sum(sizes[one.name] for one in graph.input), 0
    for k, node in enumerate(graph.node):
        made = [name for name in node.output if name]
        if missing := [name for name in made if name not in sizes]:
            raise ValueError(f"the size of {missing[0]} is not known")
        living += sum(sizes[name] for name in made)
        work += _count_products(node, shapes)
        if living > most_bytes or work > limits.NETWORK_PRODUCTS:
            raise ValueError(
                f"{node.op_type} makes {living / 1e6:.0f} MB of tensors and {work / 1e9:.0f} "
                f"billion products, more than {most_bytes / 1e6:.0f} MB or "
                f"{limits.NETWORK_PRODUCTS / 1e9:.0f} billion"
            )
        if all(name in constants for name in node.input if name):
            constants.update(made)  # folded when the file is loaded, and kept
            continue
        ended = [name for name in {*node.input, *made} - {""} if last_use.get(name, k) == k]
        living -= sum(sizes[name] for name in ended if name not in constants)


def _parse_shape(value: Any) -> list[int]:
    """Return the sides of a tensor.

    Raises
    ------
    ValueError
        If one is not known, or it is no tensor.
    """
    dimensions = value.type.tensor_type.shape.dim
    known = value.type.HasField("tensor_type") and value.type.tensor_type.HasField("shape")
    if not known or not all(d.HasField("dim_value") and d.dim_value >= 0 for d in dimensions):
        raise ValueError(f"the size of {value.name} is not known")
    return [d.dim_value for d in dimensions]


def _count_bytes(kind: int, shape: Iterable[int]) -> int:
    size = helper.tensor_dtype_to_np_dtype(kind).itemsize
    return math.prod(shape) * int(size)


def _count_products(node: Any, shapes: dict[str, list[int]]) -> int:
    """Return the multiplications of a node, or a bound; 0 where they are as many as its values."""
    sizes = [math.prod(shapes[name]) for name in node.input if name]
    output = max(math.prod(shapes[name]) for name in node.output if name)
    largest = sorted(sizes, reverse=True)[:2]
    match node.op_type:
        case "Conv" | "ConvInteger" | "QLinearConv" | "ConvTranspose":
            weights = 3 if node.op_type.startswith("QLinear") else 1
            values = sizes[0] if node.op_type == "ConvTranspose" else output
            return values * sizes[weights] // max(1, shapes[node.input[weights]][0])
        case "MatMul" | "MatMulInteger" | "QLinearMatMul" | "Gemm":
            # (m, k) and (k, n) give (m, n): the product of the three sizes is (m k n) squared.
            return math.isqrt(math.prod(largest) * output)
        case "Einsum" | "RNN" | "GRU" | "LSTM" | "Attention" | "DFT" | "STFT" | "Det":
            return math.prod(largest) * (len(largest) > 1) or largest[0] ** 2
    kernels = [math.prod(a.ints) for a in node.attribute if a.name == "kernel_shape"]
    return output * kernels[0] if kernels else 0
