"""A trained model as float ONNX: the way from torch to a file in one call."""

from dmrl.deploy.int8.graph import Graph, graph_of
from dmrl.deploy.onnx.graph_writer import float_onnx
from dmrl.learn.inference.loaded_model import Model
from dmrl.learn.networks.trace import operations


def float_graph(model: Model, *, grey: bool) -> Graph:
    """The layers of a model, for RGB images or grey ones."""
    graph = graph_of(operations(model.network))
    return graph.grey() if grey else graph


def float_onnx_of(model: Model, *, grey: bool) -> bytes:
    """The ONNX file of a model, for images of the size it was trained on."""
    cell_px = model.network.stride_px
    return float_onnx(
        float_graph(model, grey=grey),
        model.network.channels,
        size_px=(model.height_px, model.width_px),
        grid_shape=(model.height_px // cell_px, model.width_px // cell_px),
    )
