"""Compare the maps that the published chip computed with our int8 network of the same weights.

Run as ``python benchmarks/bench_chip.py DATA [--plot STEM]``, where DATA holds
``aideck-frames`` and ``locanet-weights``. The chip processed two frames with the vendor's int8
network. Its output has a single scale: one step is 0.211 in the logit and in the log depth. Our
network is calibrated on the activation ranges of all four frames, not on the maps of the chip.
"""

import argparse
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl import plots
from dmrl.deploy.backends import Backend, FloatBackend, Outputs, build_reference_backend, to_grids
from dmrl.deploy.int8.activation_ranges import calibrate_ranges
from dmrl.deploy.int8.equalisation import equalise_channels
from dmrl.deploy.int8.graph import build_graph
from dmrl.deploy.int8.quantise import NetworkInfo, quantise_network
from dmrl.deploy.int8.rounding import measure_moments
from dmrl.images.codec import decode
from dmrl.learn.inference.loaded_model import load_model
from dmrl.learn.networks.trace import trace_operations

STEP = 0.211
JUDGED, CALIBRATION = ("00216", "00495"), ("00185", "00216", "00375", "00495")
CHANNELS = {"confidence": "pos", "log_depth": "dep"}


@dataclass(frozen=True)
class Agreement:
    """Agreement of one map with that of the chip; differences in steps of the chip's output."""

    correlation: float
    mean_steps: float
    most_levels: int


def read_chip_map(file: Path) -> NDArray[np.float64]:
    """Return the (28, 40) values of a map of the chip: a P5 file, one byte per cell, 128 is 0."""
    head, size, most, body = file.read_bytes().split(b"\n", 3)
    cols, rows = (int(side) for side in size.split())
    assert (head, int(most)) == (b"P5", 255)
    levels = np.array(struct.unpack(f"{rows * cols}B", body[: rows * cols])) - 128.0
    return STEP * levels.reshape(rows, cols)


def measure_agreement(chip: NDArray[np.float64], ours: NDArray[np.floating]) -> Agreement:
    """Return correlation, mean absolute difference, and the largest difference of a cell."""
    levels = np.rint(ours / STEP) - np.rint(chip / STEP)
    return Agreement(
        float(np.corrcoef(chip.ravel(), ours.ravel())[0, 1]),
        float(np.abs(chip - ours).mean() / STEP),
        int(np.abs(levels).max()),
    )


def build_backends(data: Path) -> dict[str, Backend]:
    """Return a float and an int8 backend with the published weights."""
    model = load_model(data / "locanet-weights" / "real.h5")
    graph = build_graph(trace_operations(model.network))
    seen = [read_image(data, name)[None] for name in CALIBRATION]
    graph, ranges = equalise_channels(graph, calibrate_ranges(graph, seen))
    moments = measure_moments(graph, (image[0] for image in seen))
    network = model.network
    about = NetworkInfo(model.name, "locanet", network.stride_px, network.channels, model.threshold)
    return {
        "float": FloatBackend(graph, network.channels),
        "int8": build_reference_backend(quantise_network(graph, ranges, about, moments)),
    }


def read_image(data: Path, name: str) -> NDArray[np.uint8]:
    """Return an image of the AI-deck."""
    file = data / "aideck-frames" / f"img{name}.ppm"
    return decode(file.read_bytes(), file)


def compare(data: Path) -> tuple[dict[tuple[str, str, str], Agreement], list[plots.MapPair]]:
    """Return the agreement by image, channel and backend, and the maps to draw."""
    found, pictures = {}, []
    for name in JUDGED:
        image = read_image(data, name)
        folder = data / "aideck-frames" / "gap8-maps"
        chip = {c: read_chip_map(folder / f"{stem}{name}.ppm") for c, stem in CHANNELS.items()}
        maps = {"chip": _maps({c: values[None] for c, values in chip.items()})}
        for who, backend in build_backends(data).items():
            outputs = backend.outputs(image[None])
            for channel, values in chip.items():
                found[name, channel, who] = measure_agreement(values, outputs[channel][0])
            maps[who] = _maps(outputs)
        shown = {who: maps[who] for who in ("chip", "int8")}
        pictures.append(plots.MapPair(f"frame {name}", image, shown))
    return found, pictures


def _maps(outputs: Outputs) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return confidence and depth (rows, columns) of the first image."""
    grids = to_grids(outputs)
    return grids.confidence[0], grids.depth_m[0]


def main() -> None:
    """Print the table, and draw the maps with --plot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--plot", type=Path)
    asked = parser.parse_args()
    found, pictures = compare(asked.data)
    print(f"{'frame':<8}{'map':<12}{'ours':<7}{'correlation':>12}{'steps':>8}{'most levels':>13}")
    for (name, channel, who), each in found.items():
        numbers = f"{each.correlation:>12.3f}{each.mean_steps:>8.2f}{each.most_levels:>13}"
        print(f"{name:<8}{channel:<12}{who:<7}{numbers}")
    if asked.plot:
        plots.plot_map_pairs(pictures, asked.plot)


if __name__ == "__main__":
    main()
