"""Export of a trained model to float ONNX."""

from dmrl.deploy.int8.graph import Graph, graph_of
from dmrl.deploy.onnx.graph_writer import float_onnx
from dmrl.learn.inference.loaded_model import Model
from dmrl.learn.networks.trace import operations


def float_graph(model: Model, *, grey: bool) -> Graph:
    """Build the layer graph of a model, for RGB or grey images."""
    graph = graph_of(operations(model.network))
    return graph.grey() if grey else graph


def float_onnx_of(model: Model, *, grey: bool) -> bytes:
    """Build the ONNX file of a model, for images of its training size."""
    cell_px = model.network.stride_px
    return float_onnx(
        float_graph(model, grey=grey),
        model.network.channels,
        size_px=(model.height_px, model.width_px),
        grid_shape=(model.height_px // cell_px, model.width_px // cell_px),
    )
