"""Export of a trained model to float ONNX."""

from dmrl.deploy.int8.graph import FloatGraph, build_graph
from dmrl.deploy.onnx.graph_writer import build_float_onnx
from dmrl.learn.inference.loaded_model import Model
from dmrl.learn.networks.trace import trace_operations


def build_float_graph(model: Model, *, grey: bool) -> FloatGraph:
    """Build the layer graph of a model, for RGB or grey images."""
    graph = build_graph(trace_operations(model.network))
    return graph.to_grey() if grey else graph


def float_onnx_of(model: Model, *, grey: bool) -> bytes:
    """Build the ONNX file of a model, for images of its training size."""
    cell_px = model.network.stride_px
    return build_float_onnx(
        build_float_graph(model, grey=grey),
        model.network.channels,
        size_px=(model.height_px, model.width_px),
        grid_shape=(model.height_px // cell_px, model.width_px // cell_px),
    )
