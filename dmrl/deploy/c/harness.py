"""Test harness in C, which runs the network on images from standard input; parser of its output."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.c.templating import fill_template, template_values
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.reference import IntegerDetection

MAX_DETECTIONS = 20
"""Maximum number of detections per image."""
DETECTION_DTYPE = np.dtype(
    [
        ("u_q4", "<i4"),
        ("v_q4", "<i4"),
        ("depth_mm", "<u2"),
        ("confidence", "<u2"),
        ("confidence_step", "i1"),
        ("padding", "V3"),
    ]
)


@dataclass(frozen=True, slots=True)
class HarnessResult:
    """Output of the harness for one image.

    Parameters
    ----------
    grids
        By head, as from `run_network` of ``reference``.
    detections
        As from `decode_detections` of ``reference``.
    stack_bytes
        Measured stack; 0 where not measured.
    """

    grids: dict[str, NDArray[np.int8]]
    detections: list[IntegerDetection]
    stack_bytes: int


def generate_harness(network: IntegerNetwork) -> str:
    """Generate the C of the harness."""
    return fill_template("harness.c", **template_values(network), most=MAX_DETECTIONS)


def parse_results(network: IntegerNetwork, data: bytes) -> list[HarnessResult]:
    """Parse the output of the harness, image by image; a truncated one at the end is dropped."""
    out, at = [], 0
    shape = network.grid_shape
    size = shape[0] * shape[1]
    head = size * len(network.heads) + 8
    while at + head <= len(data):
        grids = np.frombuffer(data, np.int8, size * len(network.heads), at)
        stack, count = np.frombuffer(data, "<i4", 2, at + head - 8).tolist()
        at += head
        if not 0 <= count <= MAX_DETECTIONS or at + count * DETECTION_DTYPE.itemsize > len(data):
            break
        rows = np.frombuffer(data, DETECTION_DTYPE, count, at)
        at += count * DETECTION_DTYPE.itemsize
        parts = grids.reshape(len(network.heads), *shape)
        named = dict(zip(network.heads, parts, strict=True))
        out.append(HarnessResult(named, to_detections(rows), stack))
    return out


def to_detections(rows: NDArray[np.void]) -> list[IntegerDetection]:
    """Convert detections from the memory layout of the C."""
    names = ("u_q4", "v_q4", "depth_mm", "confidence")
    return [IntegerDetection(*(int(row[name]) for name in names)) for row in rows]
