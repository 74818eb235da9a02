"""``dmrl quantize``: a trained network to int8, and what that costs."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter, validators

from dmrl.atomic_output import partial_folder, refuse_existing
from dmrl.datasets import Dataset, Split, open_dataset
from dmrl.deploy.accuracy import argmax_kept, figures_of, points_of
from dmrl.deploy.backends import Backend, Float, Outputs, grids_of, integer
from dmrl.deploy.int8.activation_ranges import calibrate
from dmrl.deploy.int8.equalisation import equalise
from dmrl.deploy.int8.graph import Graph, graph_of
from dmrl.deploy.int8.layer_errors import LayerFigures, layer_figures
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.quantise import About, quantise
from dmrl.deploy.int8.rounding import moments_of
from dmrl.deploy.int8.store import INTEGER_NAME, save
from dmrl.deploy.samples import SAMPLES, save_samples
from dmrl.errors import MissingExtra, SettingError
from dmrl.evaluation.detections import labels_of_split
from dmrl.learn.inference.detection_metrics import DEFINITIONS
from dmrl.learn.pretrained import resolved
from dmrl.recording import provenance
from dmrl.terminal.arguments import AsJson, Flat
from dmrl.terminal.progress import say, track
from dmrl.terminal.tables import print_json, print_table

try:
    from dmrl.learn.inference.loaded_model import Model, load_model, save_model
    from dmrl.learn.networks.trace import operations
except ModuleNotFoundError as e:
    raise MissingExtra(str(e.name), "train", "dmrl quantize") from e

plots: ModuleType | None
try:
    from dmrl import plots
except MissingExtra:
    plots = None

REPORT_NAME = "quantisation.json"
LAYER_IMAGES = 20
ROUNDING_IMAGES = 50
"""Images that say how to round the weights: each has hundreds of places or more."""
DRAWN_IMAGES = 3
Count = Annotated[int, Parameter(validator=validators.Number(gte=1))]


@dataclass(frozen=True, slots=True)
class Settings:
    """How a network becomes int8, and on what it is judged.

    Parameters
    ----------
    images
        Calibration images: so many of the train split, evenly spread.
    grey
        Take grey images, as a monochrome camera gives them: the first layer sums its weights
        over the colours, which is exact where a network was trained on grey images.
    split
        Split to judge float against int8 on. Without it: test, else val, else train.
    most
        Judge on at most this many images, evenly spread.
    """

    images: Count = 200
    grey: bool = False
    split: str | None = None
    most: Count = 1000


@dataclass(frozen=True, slots=True)
class Result:
    """What came of it.

    Parameters
    ----------
    network
        The int8 network.
    layers
        What int8 does to each layer and head, over a few images of the split.
    calibration_images
        How many there were.
    split, images
        What the two were judged on.
    accuracy
        "float" and "int8" to the figures of ``learn.metrics``; None where there was nothing to
        measure.
    argmax_kept
        Share of images whose most confident cell is the same.
    """

    network: IntegerNetwork
    layers: list[LayerFigures]
    calibration_images: int
    split: str
    images: int
    accuracy: dict[str, dict[str, float | None]]
    argmax_kept: float


def run(model: Path, dataset: Path, out: Path, settings: Settings) -> Result:
    """Quantise ``model`` by images of ``dataset`` and write the folder ``out``.

    ``out`` is a run folder as well: it holds the float model beside the int8 one, a report, and
    a picture of both networks' maps.

    Parameters
    ----------
    model
        Run folder, .safetensors or Keras .h5.
    dataset
        Folder that ``dmrl dataset`` wrote, with images of the model's size.
    out
        Folder to write. Must not exist.
    settings
        See `Settings`.

    Raises
    ------
    ModelError
        If the model cannot be used, or has a layer that int8 cannot carry.
    DatasetError
        If the dataset cannot be used.
    SettingError
        If its images are of another size, or nothing can be learned from them.
    OutputError
        If ``out`` exists.
    """
    refuse_existing(out)
    model = resolved(model)
    trained, data = load_model(model), open_dataset(dataset)
    seen, judged = data.split(_first(data, "train")), data.split(settings.split or _judged(data))
    for split in (seen, judged):
        _require_same_size(trained, split, dataset)
    graph = graph_of(operations(trained.network))
    graph = graph.grey() if settings.grey else graph
    rows = _spread(len(seen), settings.images)
    calibration = track(seen.images(rows), "Calibrating", len(rows))
    ranges = calibrate(graph, (image[None] for image in calibration))
    graph, ranges = equalise(graph, ranges)
    rows = _spread(len(seen), min(settings.images, ROUNDING_IMAGES))
    moments = moments_of(graph, track(seen.images(rows), "Rounding", len(rows)))
    network = quantise(graph, ranges, _about(trained), moments)
    made = provenance("quantize", settings, (model, dataset), libraries=("torch", "numpy"))
    with partial_folder(out) as folder:
        result = _judge(trained, graph, network, judged, settings, ranges.images, folder)
        save_model(trained, folder)
        save(network, folder / INTEGER_NAME)
        save_samples(np.stack(list(seen.images(_spread(len(seen), SAMPLES)))), folder)
        text = json.dumps(document(result), indent=1, allow_nan=False)
        (folder / REPORT_NAME).write_text(text + "\n", encoding="utf-8")
        made.write(folder)
    return result


def _first(data: Dataset, *names: str) -> str:
    """The first of these splits that the dataset has; if it has none of them, its own first."""
    return next(name for name in (*names, *data.splits) if name in data.splits)


def _judged(data: Dataset) -> str:
    return _first(data, "test", "val")


def _require_same_size(model: Model, split: Split, dataset: Path) -> None:
    height_px, width_px = split.image_shape
    if (height_px, width_px) != (model.height_px, model.width_px):
        raise SettingError(
            f"{dataset} holds images of {width_px} x {height_px} px, {model.name} takes "
            f"{model.width_px} x {model.height_px}. Make a dataset of that size"
        )


def _spread(count: int, most: int) -> list[int]:
    """At most ``most`` numbers below ``count``, ascending, evenly spread."""
    numbers: list[int] = np.unique(np.linspace(0, count - 1, min(count, most)).astype(int)).tolist()
    return numbers


def _about(model: Model) -> About:
    network = model.network
    name = model.name or model.architecture
    return About(name, model.architecture, network.stride_px, network.channels, model.threshold)


def _judge(
    model: Model,
    graph: Graph,
    network: IntegerNetwork,
    split: Split,
    settings: Settings,
    calibration_images: int,
    folder: Path,
) -> Result:
    """Float and int8 on the same images; a few of them are drawn into the folder."""
    rows = _spread(len(split), settings.most)
    backends: dict[str, Backend] = {
        "float": Float(graph, model.network.channels),
        "int8": integer(network),
    }
    outputs = _outputs(backends, split, rows)
    labels = labels_of_split(split, rows)
    few = [rows[k] for k in _spread(len(rows), LAYER_IMAGES)]
    if plots is None:
        say("no picture of the maps: that needs matplotlib. pip install 'dmrl[plot]'")
    else:
        _draw(split, rows, outputs, folder)
    return Result(
        network,
        layer_figures(graph, network, split.images(few)),
        calibration_images,
        split.name,
        len(rows),
        {
            name: figures_of(len(rows), labels, points_of(each, network.stride_px), model.threshold)
            for name, each in outputs.items()
        },
        argmax_kept(outputs["float"], outputs["int8"]),
    )


def _outputs(backends: Mapping[str, Backend], split: Split, rows: list[int]) -> dict[str, Outputs]:
    """Output of every backend for the images of these rows."""
    each: dict[str, list[Outputs]] = {name: [] for name in backends}
    for image in track(split.images(rows), "Comparing", len(rows)):
        for name, backend in backends.items():
            each[name].append(backend.outputs(image[None]))
    return {
        name: {key: np.concatenate([one[key] for one in outputs]) for key in outputs[0]}
        for name, outputs in each.items()
    }


def _draw(split: Split, rows: list[int], outputs: dict[str, Outputs], folder: Path) -> None:
    assert plots is not None
    shown = _spread(len(rows), DRAWN_IMAGES + 2)[1:-1] or [0]
    grids = {name: grids_of(each) for name, each in outputs.items()}
    pictures = [
        plots.MapPair(
            f"image {rows[k]} of {split.name}",
            image,
            {name: (each.confidence[k], each.depth_m[k]) for name, each in grids.items()},
        )
        for k, image in zip(shown, split.images([rows[k] for k in shown]), strict=True)
    ]
    plots.map_pairs(pictures, folder / "maps")


def document(result: Result) -> dict[str, Any]:
    """Everything that was measured, as JSON values; null where there was nothing to measure."""
    network = result.network
    return {
        "architecture": network.architecture,
        "input": {
            "width_px": network.width_px,
            "height_px": network.height_px,
            "channels": network.channels,
        },
        "macs": network.macs,
        "calibration_images": result.calibration_images,
        "split": result.split,
        "images": result.images,
        "argmax_kept": result.argmax_kept,
        "accuracy": result.accuracy,
        "layers": [asdict(layer) for layer in result.layers],
        "definitions": DEFINITIONS,
    }


# Name of a figure, its words in the table, and its format.
ROWS = (
    ("median_px", "median error, px", ".2f"),
    ("within_8_px", "within 8 px", ".1%"),
    ("within_20_px", "within 20 px", ".1%"),
    ("depth_mae_m", "depth MAE, m", ".4f"),
    ("depth_rmse_m", "depth RMSE, m", ".4f"),
    ("f1", "F1", ".3f"),
    ("ap_16_px", "AP at 16 px", ".3f"),
)


def print_result(out: Path, result: Result) -> None:
    """Print the layers, then float beside int8."""
    columns = ("layer", "kind", "output", "MMAC", "range", "SQNR, dB", "saturated")
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
    print_table(f"{out}: {result.network.macs / 1e6:.1f} MMAC an image", columns, rows)
    accuracy = result.accuracy
    compared = [
        [words, *(_cell(accuracy[name][key], form) for name in ("float", "int8"))]
        for key, words, form in ROWS
    ]
    compared.append(["most confident cell kept", "", f"{result.argmax_kept:.1%}"])
    title = f"{result.images} images of split {result.split}"
    print_table(title, ("label minus detection", "float", "int8"), compared)


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


DEFAULTS = Settings()


def command(
    model: Path,
    dataset: Path,
    out: Path,
    /,
    *,
    settings: Flat[Settings] = DEFAULTS,
    as_json: AsJson = False,
) -> None:
    """Quantise a network to int8, and say what that costs.

    Parameters
    ----------
    model
        A run folder of dmrl train, a .safetensors or a Keras .h5.
    dataset
        Dataset with images of the model's size: its train split calibrates, another judges.
    out
        Folder to write: the int8 network, the float one, quantisation.json, a picture of the
        maps. Must not exist.
    as_json
        Print one JSON document in place of the tables.
    """
    result = run(model, dataset, out, settings)
    if as_json:
        print_json(document(result))
    else:
        print_result(out, result)
