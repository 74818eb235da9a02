"""Build the sections of a report, one function for each.

Documents may come from other programs. One that does not have dmrl's form is named, and the others
are shown.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from dmrl import __version__
from dmrl.errors import DmrlError
from dmrl.evaluation import positions, tracks
from dmrl.html_report import html
from dmrl.html_report.catalogue_tables import build_catalogue_section
from dmrl.html_report.collect import ReportInputs
from dmrl.html_report.html import (
    ImageEmbedder,
    build_chart,
    build_row,
    build_table,
    to_html_text,
)
from dmrl.html_report.lineage import build_lineage
from dmrl.html_report.recipe_figures import build_recipe_figures
from dmrl.html_report.section_helpers import (
    draw_or_explain,
    extract_valid,
    figure_if_present,
    shorten,
    show_documents,
)
from dmrl.plots import charts
from dmrl.topics import list_robots

CARD_FIGURES = ("position", "depth", "peers")
"""Stems of the images that `dmrl card` draws."""
MAX_SHOWN = 12
"""Evaluations, models or pairs that are drawn, at most; tables list all."""
METRICS = {
    "median_px": ("median, px", ".1f"),
    "within_8_px": ("within 8 px", ".1%"),
    "within_20_px": ("within 20 px", ".1%"),
    "depth_mae_m": ("depth MAE, m", ".3f"),
    "precision": ("precision", ".1%"),
    "recall": ("recall", ".1%"),
    "f1": ("F1", ".3f"),
    "ap_16_px": ("AP at 16 px", ".3f"),
}
OMITTED_VALUES: tuple[Any, ...] = (None, False, "", [], {})
"""Values of settings that are omitted from a command line."""


def build_report(found: ReportInputs) -> str:
    """Build the report of a folder, HTML."""
    pictures = ImageEmbedder()
    bodies: list[tuple[str, str]] = [
        (found.title, build_recipe_figures(found, pictures)),
        ("Detections", _detections_section(found, pictures)),
        ("Positions", _positions_section(found, pictures)),
        ("Tracks", _tracks_section(found, pictures)),
        ("Training", _training_section(found)),
        ("int8", _int8_section(found, pictures)),
        ("Datasets", _datasets_section(found, pictures)),
        (
            "Images",
            build_row(
                pictures.build_figure(path, path.name) for path in found.pictures[:MAX_SHOWN]
            ),
        ),
        ("Catalogue", "".join(build_catalogue_section(*one) for one in found.catalogues.items())),
        ("Recordings", _recordings_section(found)),
        ("Provenance", _provenance_section(found)),
        (
            "Unreadable files",
            build_table(("file", "why"), found.unread.items()) if found.unread else "",
        ),
    ]
    return html.build_page(found.folder.resolve().name, _summarize(found), bodies)


def _summarize(found: ReportInputs) -> str:
    counts = {
        "catalogue": len(found.catalogues),
        "recording": len(found.recordings),
        "dataset": len(found.datasets),
        "model": len(found.documents_of_kind("models")),
        "evaluation": sum(
            len(found.documents_of_kind(kind)) for kind in ("evaluations", "positions", "tracks")
        ),
    }
    words = [f"{n} {name}{'s' * (n != 1)}" for name, n in counts.items() if n]
    return f"{', '.join(words)}. Written by dmrl {__version__}."


def _detections_section(found: ReportInputs, pictures: ImageEmbedder) -> str:
    judged = found.documents_of_kind("evaluations")
    if not judged:
        return ""
    heads = ["evaluation", "against", "images", *(words for words, _ in METRICS.values())]
    rows = extract_valid(
        judged, lambda said: [said["against"], said["images"], *_metric_cells(said["overall"])]
    )
    parts = [
        build_table(heads, [[name, *cells] for name, cells in rows.items()]),
        "<p>In brackets: 95 % intervals from a bootstrap over images.</p>",
    ]
    few = dict(list(judged.items())[:MAX_SHOWN])
    drawn = []
    for key, words in (("median_px", "median error, px"), ("depth_mae_m", "depth MAE, m")):
        bands = {
            name: rows for name, rows in extract_valid(few, _distance_bands(key)).items() if rows
        }
        if bands:
            drawn.append(
                draw_or_explain(
                    charts.plot_by_distance, bands, words, caption=f"{words} by distance"
                )
            )
    if curves := extract_valid(few, _precision_recall):
        words = "precision over recall, matches within 16 px"
        drawn.append(draw_or_explain(charts.plot_precision_recall, curves, caption=words))
    if bins := extract_valid(few, _reliability_bins):
        words = "share of correct detections over their confidence; calibrated is the diagonal"
        drawn.append(draw_or_explain(charts.plot_reliability, bins, caption=words))
    parts.append(build_row(drawn))
    parts.append(
        show_documents(few, lambda name, said: _evaluation_details(found, name, said, pictures))
    )
    return "".join(parts)


def _metric_cells(overall: Mapping[str, Any]) -> list[str]:
    return [_format_interval(overall[name], form) for name, (_, form) in METRICS.items()]


def _format_interval(figure: Mapping[str, Any], form: str) -> str:
    if figure["value"] is None:
        return "-"
    ends = [figure["low"], figure["high"]]
    within = "" if None in ends else f" ({', '.join(format(end, form) for end in ends)})"
    return format(figure["value"], form) + within


def _distance_bands(key: str) -> Callable[[Any], list[tuple[float, ...]]]:
    def take(said: Any) -> list[tuple[float, ...]]:
        out = []
        for band in said["bands"]:
            value, low, high = (band[key][end] for end in ("value", "low", "high"))
            if None not in (value, low, high):
                ends = band["from_m"], math.inf if band["to_m"] is None else band["to_m"]
                out.append(tuple(map(float, (*ends, value, low, high))))
        return out

    return take


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
) -> str:
    sources = said["recordings"] if "recordings" in said else [said["recording"]]
    inputs = " ".join(str(source["name"]) for source in sources)
    split = f" --split {said['split']}" if said["split"] not in (None, "all") else ""
    ran = f"dmrl evaluate {inputs} --against {said['against']}{split} --plots {name}"
    partial = " Images without Detections were left out (--partial)." if said.get("partial") else ""
    words = f"{said['labels']} labels, threshold {float(said['threshold']):.2f}.{partial}"
    figures = [
        figure_if_present(
            found.folder / name / "examples.png", "images, confidence and depth", pictures
        ),
        figure_if_present(found.folder / name / "error-violins.png", "errors", pictures),
        figure_if_present(
            found.folder / name / "error-by-distance.png", "errors by distance", pictures
        ),
    ]
    return (
        f"<h3>{to_html_text(name)}</h3><p>{to_html_text(words)} "
        f"<code>{to_html_text(ran)}</code></p>{build_row(figures)}"
    )


def _positions_section(found: ReportInputs, pictures: ImageEmbedder) -> str:
    def show(name: str, said: Mapping[str, Any]) -> str:
        heads = ["pair", *(words for _, words, _ in positions.COLUMNS)]
        ran = f"dmrl evaluate {said['recording']['name']} --what positions --plots {name}"
        drawn = sorted((found.folder / name).glob("position-error-*.png"))[:2]
        figures = build_row(
            figure_if_present(path, f"{path.stem}, 3-sigma bands", pictures) for path in drawn
        )
        judged = (
            build_table(heads, positions.rows(dict(said)))
            + f"<p>{to_html_text(positions.note(said))}.</p>"
        )
        return (
            f"<h3>{to_html_text(name)}</h3><p><code>{to_html_text(ran)}</code></p>{judged}{figures}"
        )

    return build_row(_draw_position_maps(found)) + show_documents(
        found.documents_of_kind("positions"), show
    )


def _draw_position_maps(found: ReportInputs) -> list[str]:
    """Draw maps of the first pairs with true positions."""
    out: list[str] = []
    for name in found.recordings:
        if len(out) >= 4:
            break
        try:
            known = positions.read_paths(found.folder / name)
        except DmrlError as e:
            found.unread[name] = str(e)
            continue
        for (robot, peer), path in list(known.items())[:2]:
            if path.kept.any():
                words = f"{name}: {peer} relative to {robot}, from above; 95 % ellipses"
                places = path.true_m, path.estimate_m, path.covariance, path.kept
                out.append(draw_or_explain(charts.plot_positions, *places, caption=words))
    return out


def _tracks_section(found: ReportInputs, pictures: ImageEmbedder) -> str:
    def show(name: str, said: Mapping[str, Any]) -> str:
        heads = ["robot", *(words for _, words, _ in tracks.COLUMNS)]
        drawn = sorted((found.folder / name).glob("*.png"))[:2]
        figures = build_row(figure_if_present(path, path.stem, pictures) for path in drawn)
        judged = (
            build_table(heads, tracks.rows(dict(said)))
            + f"<p>{to_html_text(tracks.note(said))}.</p>"
        )
        return f"<h3>{to_html_text(name)}</h3>{judged}{figures}"

    return show_documents(found.documents_of_kind("tracks"), show)


def _training_section(found: ReportInputs) -> str:
    models = found.documents_of_kind("models")
    if not models:
        return ""
    heads = ("model", "architecture", "parameters", "training images", "labels", "threshold")
    rows = extract_valid(models, _model_cells)
    histories = {
        name: losses
        for name, losses in extract_valid(
            dict(list(models.items())[:MAX_SHOWN]), _loss_history
        ).items()
        if len(losses) > 1
    }
    words = "loss over the epochs"
    drawn = [draw_or_explain(charts.plot_losses, histories, caption=words)] if histories else []
    return build_table(heads, [[name, *cells] for name, cells in rows.items()]) + build_row(drawn)


def _model_cells(said: Any) -> list[Any]:
    own = said["training"]
    images = own.get("images") if isinstance(own, dict) else None
    threshold = f"{float(said['threshold']):.2f}"
    known = [said["architecture"], int(said["parameters"]), images, said["label_source"]]
    return [*known, threshold]


def _loss_history(said: Any) -> list[float]:
    return [float(epoch["loss"]) for epoch in said["training"]["history"]]


def _int8_section(found: ReportInputs, pictures: ImageEmbedder) -> str:
    def show(name: str, said: Mapping[str, Any]) -> str:
        heads = ("", *(words for words, _ in METRICS.values()))
        rows = [
            [kind, *(format(float(figures[key]), form) for key, (_, form) in METRICS.items())]
            for kind, figures in said["accuracy"].items()
        ]
        maps = figure_if_present(
            found.folder / name / "maps.png", "images and maps, float, int8", pictures
        )
        words = f"{said['images']} images of split {said['split']}"
        head = f"<h3>{to_html_text(name)}</h3><p>{to_html_text(words)}</p>"
        return f"{head}{build_table(heads, rows)}{build_row([maps])}"

    return show_documents(found.documents_of_kind("int8"), show)


def _datasets_section(found: ReportInputs, pictures: ImageEmbedder) -> str:
    rows, drawn = [], []
    for name, folder in found.datasets.items():
        made = found.made.get(name)
        sources = ", ".join(source.name for source in made.inputs) if made else ""
        rows.append((name, len(made.inputs) if made else None, sources))
        for stem in CARD_FIGURES:
            path = folder / "figures" / f"{stem}.png"
            drawn.append(figure_if_present(path, f"{name}: {stem}", pictures))
    shown = build_row([figure for figure in drawn if figure][:MAX_SHOWN])
    return build_table(("dataset", "inputs", "recordings"), rows) + shown if rows else ""


def _recordings_section(found: ReportInputs) -> str:
    rows = []
    for name, held in found.recordings.items():
        size = (found.folder / name).stat().st_size / 1e6
        who = ", ".join(list_robots(list(held.topics))) or None
        made = held.provenance.stage if held.provenance else None
        duration_s = (held.end_ns - held.start_ns) / 1e9
        rows.append(
            (name, f"{size:.1f}", f"{duration_s:.1f}", len(held.topics), held.count, who, made)
        )
    heads = ("recording", "MB", "s", "topics", "messages", "cameras", "made by")
    return build_table(heads, rows) if rows else ""


def _provenance_section(found: ReportInputs) -> str:
    columns, arrows = build_lineage(found.made)
    drawn = charts.plot_lineage(columns, arrows) if columns else ""
    libraries: dict[str, set[str]] = {}
    for made in found.made.values():
        libraries.setdefault("dmrl", set()).add(made.dmrl_version)
        for package, version in made.libraries.items():
            libraries.setdefault(package, set()).add(str(version))
    versions = [(package, ", ".join(sorted(known))) for package, known in sorted(libraries.items())]
    rows = [(name, _format_command(made.stage, made.settings)) for name, made in found.made.items()]
    wide = 8 * len(columns)
    parts = [build_chart(drawn, "stages, from sources to results", least_rem=wide)] if drawn else []
    if rows:
        parts.append(build_table(("output", "made by"), rows))
    if versions:
        parts.append(build_table(("package", "version"), versions))
    return "".join(parts)


def _format_command(stage: str, settings: Mapping[str, Any]) -> str:
    words: Iterable[str] = (
        f"{key}={shorten(value)}" for key, value in settings.items() if value not in OMITTED_VALUES
    )
    return f"dmrl {stage} {' '.join(words)}"
