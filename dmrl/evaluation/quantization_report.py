"""Compare a float network with its int8 one on a dataset, and write both with a report."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from dmrl.atomic_output import atomic_folder
from dmrl.datasets import Dataset, Split, open_dataset
from dmrl.deploy.accuracy import compare_peaks, compute_accuracy, decode_points
from dmrl.deploy.backends import Backend, FloatBackend, Outputs, build_reference_backend, to_grids
from dmrl.deploy.int8.layer_errors import LayerErrorStats, compute_layer_errors
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.quantise_model import Quantised, pick_evenly
from dmrl.deploy.int8.store import INTEGER_NAME, save_network
from dmrl.deploy.samples import SAMPLE_COUNT, save_samples
from dmrl.errors import MissingExtra, SettingError
from dmrl.evaluation.detections import read_split_labels
from dmrl.evaluation.figure_tables import format_values, metric_columns
from dmrl.learn.inference.loaded_model import Model, load_model, save_model
from dmrl.learn.inference.metric_definitions import METRIC_DEFINITIONS
from dmrl.recording import Provenance
from dmrl.terminal.progress import say, track
from dmrl.terminal.tables import print_table

plots: ModuleType | None
try:
    from dmrl import plots
except MissingExtra:
    plots = None

REPORT_NAME = "quantisation.json"
MAX_LAYER_IMAGES = 20
"""Most images that the errors of layers are measured on."""
MAX_DRAWN_IMAGES = 3
"""Most images whose maps are drawn."""


class QuantizationInputs(NamedTuple):
    """A float model, and splits of a dataset to calibrate and to compare on."""

    model: Model
    calibration: Split
    compared: Split


@dataclass(frozen=True, slots=True)
class QuantizationReport:
    """Accuracy of a float network and of its int8 one.

    Parameters
    ----------
    network
        The int8 network.
    layers
        Errors of int8 in each layer and head, over a few images of the split.
    calibration_images
        Their number.
    split, images
        The images that both were compared on.
    accuracy
        "float" and "int8" to the figures of ``detection_metrics``; None where there was nothing
        to measure.
    argmax_kept
        Share of images whose most confident cell is the same.
    """

    network: IntegerNetwork
    layers: list[LayerErrorStats]
    calibration_images: int
    split: str
    images: int
    accuracy: dict[str, dict[str, float | None]]
    argmax_kept: float


def open_inputs(model: Path, dataset: Path, split: str | None) -> QuantizationInputs:
    """Open a model, and the splits of a dataset of its image size.

    Parameters
    ----------
    model
        Run folder, .safetensors or Keras .h5.
    dataset
        Folder that ``dmrl dataset`` wrote.
    split
        Split to compare on. None: test, else val, else the first.

    Raises
    ------
    ModelError
        If the model cannot be used.
    DatasetError
        If the dataset cannot be used.
    SettingError
        If its images are of another size.
    """
    trained, data = load_model(model), open_dataset(dataset)
    calibration = data.split(_first_split(data, "train"))
    compared = data.split(split or _first_split(data, "test", "val"))
    for one in (calibration, compared):
        height_px, width_px = one.image_shape
        if (height_px, width_px) != (trained.height_px, trained.width_px):
            raise SettingError(
                f"{dataset} holds images of {width_px} x {height_px} px, {trained.name} takes "
                f"{trained.width_px} x {trained.height_px}. Make a dataset of that size"
            )
    return QuantizationInputs(trained, calibration, compared)


def _first_split(data: Dataset, *names: str) -> str:
    """Return the first of these splits that the dataset has; else its own first."""
    return next(name for name in (*names, *data.splits) if name in data.splits)


def write_quantized(
    out: Path, origin: Provenance, inputs: QuantizationInputs, quantised: Quantised, most: int
) -> QuantizationReport:
    """Compare both networks, and write them with the report to a folder.

    Parameters
    ----------
    out
        Folder to write.
    origin
        Its provenance.
    inputs, quantised
        The float model and its data, and the int8 network.
    most
        Most images to compare on, evenly spread.
    """
    with atomic_folder(out) as folder:
        report = _compare(inputs, quantised, most, folder)
        save_model(inputs.model, folder)
        save_network(quantised.network, folder / INTEGER_NAME)
        seen = inputs.calibration
        rows = pick_evenly(len(seen), SAMPLE_COUNT)
        save_samples(np.stack(list(seen.images(rows))), folder)
        text = json.dumps(describe_quantization(report), indent=1, allow_nan=False)
        (folder / REPORT_NAME).write_text(text + "\n", encoding="utf-8")
        origin.write(folder)
    return report


def _compare(
    inputs: QuantizationInputs, quantised: Quantised, most: int, folder: Path
) -> QuantizationReport:
    """Compare float and int8 on the same images; draw a few of them into the folder."""
    model, split, network = inputs.model, inputs.compared, quantised.network
    rows = pick_evenly(len(split), most)
    backends: dict[str, Backend] = {
        "float": FloatBackend(quantised.graph, model.network.channels),
        "int8": build_reference_backend(network),
    }
    outputs = _compute_outputs(backends, split, rows)
    labels = read_split_labels(split, rows)
    few = [rows[k] for k in pick_evenly(len(rows), MAX_LAYER_IMAGES)]
    if plots is None:
        say("no picture of the maps: that needs matplotlib. pip install 'dmrl[plot]'")
    else:
        _draw_maps(split, rows, outputs, folder)
    accuracy = {}
    for name, each in outputs.items():
        points = decode_points(each, network.stride_px)
        accuracy[name] = compute_accuracy(len(rows), labels, points, model.threshold)
    return QuantizationReport(
        network,
        layers=compute_layer_errors(quantised.graph, network, split.images(few)),
        calibration_images=quantised.images,
        split=split.name,
        images=len(rows),
        accuracy=accuracy,
        argmax_kept=compare_peaks(outputs["float"], outputs["int8"]),
    )


def _compute_outputs(
    backends: Mapping[str, Backend], split: Split, rows: list[int]
) -> dict[str, Outputs]:
    """Return the output of every backend for the images of these rows."""
    each: dict[str, list[Outputs]] = {name: [] for name in backends}
    for image in track(split.images(rows), "Comparing", len(rows)):
        for name, backend in backends.items():
            each[name].append(backend.outputs(image[None]))
    return {
        name: {key: np.concatenate([one[key] for one in outputs]) for key in outputs[0]}
        for name, outputs in each.items()
    }


def _draw_maps(split: Split, rows: list[int], outputs: dict[str, Outputs], folder: Path) -> None:
    assert plots is not None
    shown = pick_evenly(len(rows), MAX_DRAWN_IMAGES + 2)[1:-1] or [0]
    grids = {name: to_grids(each) for name, each in outputs.items()}
    pictures = [
        plots.MapPair(
            f"image {rows[k]} of {split.name}",
            image,
            {name: (each.confidence[k], each.depth_m[k]) for name, each in grids.items()},
        )
        for k, image in zip(shown, split.images([rows[k] for k in shown]), strict=True)
    ]
    plots.plot_map_pairs(pictures, folder / "maps")


def describe_quantization(result: QuantizationReport) -> dict[str, Any]:
    """Return all figures as JSON values; null where there was nothing to measure."""
    network = result.network
    return {
        "architecture": network.architecture,
        "input": {k: getattr(network, k) for k in ("width_px", "height_px", "channels")},
        "macs": network.macs,
        "calibration_images": result.calibration_images,
        "split": result.split,
        "images": result.images,
        "argmax_kept": result.argmax_kept,
        "accuracy": result.accuracy,
        "layers": [asdict(layer) for layer in result.layers],
        "definitions": METRIC_DEFINITIONS,
    }


COMPARED_METRICS = (
    *("median_px", "within_8_px", "within_20_px", "depth_mae_m", "depth_rmse_m", "f1"),
    "ap_16_px",
)


def print_quantization(out: Path, result: QuantizationReport) -> None:
    """Print the layers, then float beside int8."""
    headers = ("layer", "kind", "output", "MMAC", "range", "SQNR, dB", "saturated")
    rows = [
        (
            layer.name,
            layer.kind,
            " x ".join(map(str, layer.shape)),
            f"{layer.products / 1e6:.2f}" if layer.products else "",
            f"{layer.low:.3g} to {layer.high:.3g}",
            "exact" if layer.sqnr_db is None else f"{layer.sqnr_db:.1f}",
            f"{layer.saturated:.2%}",
        )
        for layer in result.layers
    ]
    print_table(f"{out}: {result.network.macs / 1e6:.1f} MMAC an image", headers, rows)
    # A tenth of a millimetre shows what is lost.
    columns = [
        (name, title, ".4f" if name.endswith("_m") else form)
        for name, title, form in metric_columns(*COMPARED_METRICS)
    ]
    both = [format_values(result.accuracy[name], columns) for name in ("float", "int8")]
    titles = [title for _, title, _ in columns]
    compared = [list(row) for row in zip(titles, *both, strict=True)]
    compared.append(["most confident cell kept", "", f"{result.argmax_kept:.1%}"])
    title = f"{result.images} images of split {result.split}"
    print_table(title, ("detection minus label", "float", "int8"), compared)
