"""Add the decoding of the maps to an ONNX file: detections out, in place of a map a channel.

The nodes, in ``decoding.txt``, follow `dmrl.learn.inference.decode_grids`, in its order of ties.
"""

from importlib.resources import files

import jinja2
import onnx

from dmrl.learn.inference.decode_grids import DUPLICATE_RADIUS_PX

MOST = 20
"""Detections of an image; fewer have confidence 0 in the last rows."""
NEIGHBOURS = [(row, col) for row in range(3) for col in range(3) if (row, col) != (1, 1)]


def add_decoding(model: bytes, stride_px: int) -> bytes:
    """Return an ONNX file with one output ``detections``, (N, 20, 4) float32.

    Its columns are u_px, v_px, depth_m and confidence, most confident first. Rows without a
    detection have confidence 0.

    Parameters
    ----------
    model
        File with the outputs of `graph_writer.OUTPUT_OF`.
    stride_px
        Pixels per cell, both ways.
    """
    loaded = onnx.load_from_string(model)
    graph = loaded.graph
    rows, cols = (d.dim_value for d in graph.output[0].type.tensor_type.shape.dim[1:])
    text = files(__package__).joinpath("decoding.txt").read_text("utf-8")
    template = jinja2.Template(
        text, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    decoding = onnx.parser.parse_graph(
        template.render(
            rows=rows,
            cols=cols,
            stride_px=stride_px,
            most=min(MOST, rows * cols),
            neighbours=NEIGHBOURS,
            axes=[("offset_u", "col", cols), ("offset_v", "row", rows)],
            offsets="offset_u" in {output.name for output in graph.output},
            radius2=float(DUPLICATE_RADIUS_PX**2),
        )
    )
    graph.node.extend(decoding.node)
    del graph.output[:]
    graph.output.extend(decoding.output)
    onnx.checker.check_model(loaded, full_check=True)
    written: bytes = loaded.SerializeToString(deterministic=True)
    return written
