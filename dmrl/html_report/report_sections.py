"""Build the sections of a report, one function for each.

Documents may come from other programs. One that does not have dmrl's form is named, and the others
are shown.
"""

import math
from collections.abc import Iterable, Mapping
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np
import pyarrow.compute as pc

from dmrl import __version__
from dmrl.datasets import open_dataset
from dmrl.errors import DmrlError
from dmrl.evaluation import comparison, figure_tables, flights, positions, tracks
from dmrl.html_report import blocks
from dmrl.html_report.blocks import Block, Figure, ImageEmbedder, Table, Text
from dmrl.html_report.catalogue_tables import build_catalogue_section
from dmrl.html_report.collect import ReportInputs
from dmrl.html_report.provenance_section import build_provenance_section
from dmrl.html_report.recipe_figures import build_recipe_figures
from dmrl.plots import charts
from dmrl.topics import list_robots

CARD_FIGURES = ("samples.jpg", "position.png", "depth.png", "peers.png")
"""Images that `dmrl card` draws."""
MAX_SHOWN = 12
"""Evaluations, models or pairs that are drawn, at most; tables list all."""
METRICS = figure_tables.metric_columns(
    *("median_px", "within_8_px", "within_20_px", "depth_mae_m", "precision", "recall", "f1"),
    "ap_16_px",
)
EVALUATION_IMAGES = {
    "examples.png": "images, confidence and depth at the threshold: hits, misses and false "
    "detections, two of each if there are any",
    "error-violins.png": "errors",
    "error-by-distance.png": "errors by distance",
}


def build_report(found: ReportInputs) -> str:
    """Build the report of a folder, HTML."""
    pictures = ImageEmbedder()
    bodies: list[tuple[str, list[Block]]] = [
        (found.title, build_recipe_figures(found, pictures)),
        ("Detections", _detections_section(found, pictures)),
        ("Differences", _differences_section(found)),
        (
            "Positions",
            blocks.build_row(_draw_position_maps(found)) + _show_judged(found, positions, pictures),
        ),
        ("Tracks", _show_judged(found, tracks, pictures)),
        ("Flights", _show_judged(found, flights, pictures)),
        ("Training", _training_section(found)),
        ("int8", _int8_section(found, pictures)),
        ("Datasets", _datasets_section(found, pictures)),
        ("Images", blocks.build_row(pictures.embed(p, p.name) for p in found.pictures[:MAX_SHOWN])),
        ("Catalogue", build_catalogue_section(found.catalogues)),
        ("Recordings", _recordings_section(found)),
        ("Provenance", build_provenance_section(found)),
        ("Unreadable files", _table(("file", "why"), list(found.unread.items()))),
    ]
    return blocks.build_page(found.folder.resolve().name, _summarize(found), bodies)


def _table(columns: Iterable[str], rows: list[Any]) -> list[Block]:
    """Return a table; empty without rows."""
    return [Table(tuple(columns), rows)] if rows else []


def _summarize(found: ReportInputs) -> str:
    judged = ("evaluations", "positions", "tracks", "flights")
    counts = {
        "catalogue": len(found.catalogues),
        "recording": len(found.recordings),
        "dataset": len(found.datasets),
        "model": len(found.documents_of_kind("models")),
        "evaluation": sum(len(found.documents_of_kind(kind)) for kind in judged),
    }
    words = [f"{n} {name}{'s' * (n != 1)}" for name, n in counts.items() if n]
    return f"{', '.join(words)}. Written by dmrl {__version__}."


def _detections_section(found: ReportInputs, pictures: ImageEmbedder) -> list[Block]:
    every = found.documents_of_kind("evaluations")
    if not every:
        return []
    # The pooled figures of a comparison are of no model; its section has those of both.
    judged = {name: said for name, said in every.items() if not comparison.is_pooled(said)}
    heads = ("evaluation", "against", "images", *(words for _, words, _ in METRICS))
    rows = blocks.extract_valid(
        judged, lambda said: [said["against"], said["images"], *_metric_cells(said["overall"])]
    )
    few = dict(list(judged.items())[:MAX_SHOWN])
    shown = dict(list(every.items())[:MAX_SHOWN])
    return [
        *_table(heads, [[name, *cells] for name, cells in rows.items()]),
        *([Text("In brackets: 95 % intervals from a bootstrap over images.")] if rows else []),
        *blocks.build_row(_iter_detection_charts(few)),
        *blocks.show_documents(
            shown, lambda name, said: _evaluation_details(found, name, said, pictures)
        ),
    ]


def _metric_cells(overall: Mapping[str, Any]) -> list[str]:
    return [figure_tables.format_interval(overall[name], form) for name, _, form in METRICS]


def _iter_detection_charts(few: Mapping[str, Any]) -> Iterable[Figure]:
    for key, words in (("median_px", "median error, px"), ("depth_mae_m", "depth MAE, m")):
        found = blocks.extract_valid(few, partial(_distance_bands, key)).items()
        if bands := {name: rows for name, rows in found if rows}:
            caption = f"{words} by distance"
            yield blocks.draw_or_explain(charts.plot_by_distance, bands, words, caption=caption)
    if curves := blocks.extract_valid(few, _precision_recall):
        words = "precision over recall, matches within 16 px"
        yield blocks.draw_or_explain(charts.plot_precision_recall, curves, caption=words)
    if bins := blocks.extract_valid(few, _reliability_bins):
        words = (
            "share of correct detections over their confidence; calibrated is the diagonal, around "
            "which the dots of few detections scatter"
        )
        yield blocks.draw_or_explain(charts.plot_reliability, bins, caption=words)


def _distance_bands(key: str, said: Any) -> list[tuple[float, ...]]:
    out = []
    for band in said["bands"]:
        value, low, high = (band[key][end] for end in ("value", "low", "high"))
        if None not in (value, low, high):
            ends = band["from_m"], math.inf if band["to_m"] is None else band["to_m"]
            out.append(tuple(map(float, (*ends, value, low, high))))
    return out


def _precision_recall(said: Any) -> tuple[Any, Any]:
    found = said["curves"]
    return np.array(found["recall"], float), np.array(found["precision"], float)


def _reliability_bins(said: Any) -> tuple[Any, Any, Any]:
    found = said["curves"]
    confidence, right = (np.array(found[f"bin_{name}"], float) for name in ("confidence", "right"))
    count = np.array(found["bin_count"], float)
    there = count > 0
    return confidence[there], right[there], count[there]


def _evaluation_details(
    found: ReportInputs, name: str, said: Mapping[str, Any], pictures: ImageEmbedder
) -> list[Block]:
    sources = said["recordings"] if "recordings" in said else [said["recording"]]
    inputs = " ".join(str(source["name"]) for source in sources)
    split = f" --split {said['split']}" if said["split"] not in (None, "all") else ""
    ran = f"dmrl evaluate {inputs} --against {said['against']}{split} --plots {name}"
    partial = " Images without Detections were left out (--partial)." if said.get("partial") else ""
    pooled = comparison.is_pooled(said)
    threshold = "" if pooled else f", threshold {float(said['threshold']):.2f}"
    words = f"{said['labels']} labels{threshold}.{partial}"
    headers, rows = figure_tables.build_band_table([said["overall"], *said["bands"]])
    rows = [] if pooled else rows
    table = _table(["detection minus label", *headers], rows)
    figures = (
        pictures.embed_if_present(found.folder / name / file, caption, full=k == 0)
        for k, (file, caption) in enumerate(EVALUATION_IMAGES.items())
    )
    return [Text(words, ran), *table, *blocks.build_row(figures)]


def _differences_section(found: ReportInputs) -> list[Block]:
    def show(_: str, said: Mapping[str, Any]) -> list[Block]:
        return [Text(comparison.note(said)), Table(comparison.HEADERS, comparison.build_rows(said))]

    judged = found.documents_of_kind("evaluations").items()
    return blocks.show_documents(
        {name: said["paired"] for name, said in judged if "paired" in said}, show
    )


def _show_judged(found: ReportInputs, kind: ModuleType, pictures: ImageEmbedder) -> list[Block]:
    """Show the tables of ``dmrl evaluate`` against the truth."""
    what = kind.__name__.rpartition(".")[2]

    def show(name: str, said: Mapping[str, Any]) -> list[Block]:
        heads = [kind.EACH, *(words for _, words, _ in kind.COLUMNS)]
        source = said["recording"]["name"]
        ran = f"dmrl evaluate {source} --what {'flight' if kind is flights else what}"
        drawn = sorted((found.folder / name).glob("*.png"))[:2]
        figures = (pictures.embed_if_present(p, f"{p.stem}, 3-sigma bands") for p in drawn)
        note = Text(f"{kind.note(said)}.", f"{ran} --plots {name}")
        return [Table(heads, kind.rows(dict(said))), note, *blocks.build_row(figures)]

    return blocks.show_documents(found.documents_of_kind(what), show)


def _draw_position_maps(found: ReportInputs) -> Iterable[Figure]:
    """Draw maps of the first pairs with true positions."""
    drawn = 0
    for name in found.recordings:
        if drawn >= 4:
            break
        try:
            known = positions.read_paths(found.folder / name)
        except DmrlError as e:
            found.unread[name] = str(e)
            continue
        for (robot, peer), path in list(known.items())[:2]:
            if path.kept.any():
                drawn += 1
                words = f"{name}: {peer} relative to {robot}, from above; 95 % ellipses"
                places = path.true_m, path.estimate_m, path.covariance, path.kept
                yield blocks.draw_or_explain(charts.plot_positions, *places, caption=words)


def _training_section(found: ReportInputs) -> list[Block]:
    models = found.documents_of_kind("models")
    heads = ("model", "architecture", "parameters", "training images", "labels", "threshold")
    rows = blocks.extract_valid(models, _model_cells)
    losses = blocks.extract_valid(dict(list(models.items())[:MAX_SHOWN]), _loss_history)
    histories = {name: values for name, values in losses.items() if len(values) > 1}
    words = "loss over the epochs"
    drawn = (
        [blocks.draw_or_explain(charts.plot_losses, histories, caption=words)] if histories else []
    )
    table = Table(heads, [[name, *cells] for name, cells in rows.items()])
    return [table, *blocks.build_row(drawn)] if models else []


def _model_cells(said: Any) -> list[Any]:
    own = said["training"]
    images = own.get("images") if isinstance(own, dict) else None
    threshold = f"{float(said['threshold']):.2f}"
    known = [said["architecture"], int(said["parameters"]), images, said["label_source"]]
    return [*known, threshold]


def _loss_history(said: Any) -> list[float]:
    return [float(epoch["loss"]) for epoch in said["training"]["history"]]


def _int8_section(found: ReportInputs, pictures: ImageEmbedder) -> list[Block]:
    def show(name: str, said: Mapping[str, Any]) -> list[Block]:
        accuracy = said["accuracy"].items()
        rows = [
            [kind, *figure_tables.format_values(figures, METRICS)] for kind, figures in accuracy
        ]
        path = found.folder / name / "maps.png"
        maps = pictures.embed_if_present(path, "images and maps, float, int8", full=True)
        table = Table(("", *(words for _, words, _ in METRICS)), rows)
        head = Text(f"{said['images']} images of split {said['split']}")
        return [head, table, *blocks.build_row([maps])]

    return blocks.show_documents(found.documents_of_kind("int8"), show)


def _datasets_section(found: ReportInputs, pictures: ImageEmbedder) -> list[Block]:
    rows: list[Any] = []
    drawn = []
    for name, folder in found.datasets.items():
        made = found.made.get(name)
        sources = ", ".join(source.name for source in made.inputs) if made else ""
        try:
            rows += [(name, *cells, sources) for cells in _count_splits(folder)]
        except DmrlError as e:
            found.unread[name] = str(e)
        for file in CARD_FIGURES:
            caption = f"{name}: {file.partition('.')[0]}"
            drawn.append(pictures.embed_if_present(folder / "figures" / file, caption))
    heads = ("dataset", "split", "images", "with a peer", "labels", "recordings")
    return _table(heads, rows) + blocks.build_row([f for f in drawn if f is not None][:MAX_SHOWN])


def _count_splits(folder: Any) -> Iterable[tuple[Any, ...]]:
    """Yield name, images, images with a label and labels of each split."""
    dataset = open_dataset(folder)
    for name in dataset.splits:
        peers = pc.list_value_length(dataset.split(name).table["peers"]).to_numpy()
        yield name, len(peers), int((peers > 0).sum()), int(peers.sum())


def _recordings_section(found: ReportInputs) -> list[Block]:
    rows = []
    for name, held in found.recordings.items():
        size = (found.folder / name).stat().st_size / 1e6
        who = ", ".join(list_robots(list(held.topics))) or None
        made = held.provenance.stage if held.provenance else None
        lasts = f"{(held.end_ns - held.start_ns) / 1e9:.1f}"
        rows.append((name, f"{size:.1f}", lasts, len(held.topics), held.count, who, made))
    return _table(("recording", "MB", "s", "topics", "messages", "cameras", "made by"), rows)
