"""Add the decoding of the maps to an ONNX file: detections out, in place of a map a channel.

The nodes follow `dmrl.learn.inference.decode_grids`, in its order of ties.
"""

from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from dmrl.deploy.onnx.graph_writer import OUTPUT_OF
from dmrl.learn.inference.decode_grids import DUPLICATE_RADIUS_PX

MOST = 20
"""Detections of an image; fewer have confidence 0 in the last rows."""
OUTPUT = "detections"


class _Nodes:
    """Nodes and constants that are appended to a graph."""

    def __init__(self, graph: Any) -> None:
        self.graph, self.count = graph, 0

    def constant(self, value: Any, kind: Any = np.float32) -> str:
        """Add a constant and return its name."""
        self.count += 1
        name = f"decode.{self.count}"
        self.graph.initializer.append(numpy_helper.from_array(np.asarray(value, kind), name))
        return name

    def __call__(self, kind: str, *inputs: str, outputs: int = 1, **settings: Any) -> Any:
        """Add a node and return the name of its output, or of several."""
        self.count += 1
        names = [f"decode.{self.count}.{k}" for k in range(outputs)]
        self.graph.node.append(helper.make_node(kind, list(inputs), names, names[0], **settings))
        return names[0] if outputs == 1 else names


def add_decoding(model: bytes, stride_px: int) -> bytes:
    """Return an ONNX file with one output ``detections``, (N, 20, 4) float32.

    Its columns are u_px, v_px, depth_m and confidence, most confident first. Rows without a
    detection have confidence 0.

    Parameters
    ----------
    model
        File with the outputs of `OUTPUT_OF`.
    stride_px
        Pixels per cell, both ways.
    """
    loaded = onnx.load_from_string(model)
    graph = loaded.graph
    rows, cols = (d.dim_value for d in graph.output[0].type.tensor_type.shape.dim[1:])
    given = {output.name for output in graph.output}
    node = _Nodes(graph)
    confidence = node("Sigmoid", OUTPUT_OF["confidence"])
    score = node("Where", _add_peaks(node, confidence, rows, cols), confidence, node.constant(0.0))
    flat = node.constant([0, -1], np.int64)
    most = node.constant([min(MOST, rows * cols)], np.int64)
    best, place = node("TopK", node("Reshape", score, flat), most, axis=1, outputs=2)

    def gather(grid: str) -> str:
        return str(node("GatherElements", node("Reshape", grid, flat), place, axis=1))

    width = node.constant(cols, np.int64)
    row = node("Div", place, width)
    cells = {"offset_u": node("Sub", place, node("Mul", row, width)), "offset_v": row}
    pixels = []
    for (name, cell), size in zip(cells.items(), (cols, rows), strict=True):
        at = node("Add", node("Cast", cell, to=TensorProto.FLOAT), node.constant(0.5))
        if name in given:
            at = node("Add", at, gather(name))
            at = node("Clip", at, node.constant(0.0), node.constant(float(size)))
        pixels.append(node("Mul", at, node.constant(float(stride_px))))
    if "offset_u" in given:
        best = _drop_duplicates(node, pixels, best, min(MOST, rows * cols))
    columns = [*pixels, node("Exp", gather(OUTPUT_OF["log_depth"])), best]
    last = node.constant([-1], np.int64)
    parts = [node("Unsqueeze", column, last) for column in columns]
    graph.node.append(helper.make_node("Concat", parts, [OUTPUT], OUTPUT, axis=2))
    del graph.output[:]
    shape: list[str | int | None] = ["N", min(MOST, rows * cols), len(parts)]
    graph.output.append(helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, shape))
    onnx.checker.check_model(loaded, full_check=True)
    written: bytes = loaded.SerializeToString(deterministic=True)
    return written


def _add_peaks(node: _Nodes, confidence: str, rows: int, cols: int) -> str:
    """Add nodes that find local maxima; of equal neighbours, the first in raster order."""
    edge = node.constant([0, 1, 1, 0, 1, 1], np.int64)
    padded = node("Pad", confidence, edge, node.constant(-1.0))
    axes = node.constant([1, 2], np.int64)
    peak = ""
    for row, col in ((r, c) for r in range(3) for c in range(3) if (r, c) != (1, 1)):
        start = node.constant([row, col], np.int64)
        end = node.constant([row + rows, col + cols], np.int64)
        neighbour = node("Slice", padded, start, end, axes)
        kind = "Greater" if (row, col) < (1, 1) else "GreaterOrEqual"
        higher = node(kind, confidence, neighbour)
        peak = node("And", peak, higher) if peak else higher
    return peak


def _drop_duplicates(node: _Nodes, pixels: list[str], best: str, count: int) -> str:
    """Add nodes that set the confidence of detections close to a more confident one to 0."""
    across, down = (node.constant([axis], np.int64) for axis in (1, 2))
    squares = []
    for at in pixels:
        apart = node("Sub", node("Unsqueeze", at, down), node("Unsqueeze", at, across))
        squares.append(node("Mul", apart, apart))
    near = node("Less", node("Add", *squares), node.constant(DUPLICATE_RADIUS_PX**2))
    stays = [node("Cast", _column(node, node("Greater", best, node.constant(0.0)), 0), to=1)]
    for k in range(1, count):
        row = node("Gather", near, node.constant(k, np.int64), axis=1)
        earlier = node("Cast", _column(node, row, 0, k), to=TensorProto.FLOAT)
        kept = node("Concat", *stays, axis=1) if k > 1 else stays[0]
        hit = node("ReduceMax", node("Mul", earlier, kept), axes=[1], keepdims=1)
        stays.append(node("Sub", node.constant(1.0), hit))
    return str(node("Mul", best, node("Concat", *stays, axis=1)))


def _column(node: _Nodes, grid: str, start: int, end: int | None = None) -> str:
    """Add a slice of columns [start, end); one column by default."""
    stop = start + 1 if end is None else end
    bounds = (node.constant([value], np.int64) for value in (start, stop, 1))
    return str(node("Slice", grid, *bounds))
