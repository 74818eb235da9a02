"""Build the sections of a report, one function for each.

Documents may come from other programs. One that does not have dmrl's form is named, and the others
are shown.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dmrl import __version__
from dmrl.errors import DmrlError
from dmrl.evaluation import positions, tracks
from dmrl.html_report import html
from dmrl.html_report.catalogue_tables import listed
from dmrl.html_report.collect import Found
from dmrl.html_report.html import WRONG, Pictures, chart, row, table, text
from dmrl.html_report.lineage import ancestry
from dmrl.html_report.recipe_figures import story
from dmrl.plots import charts
from dmrl.topics import robots

FIGURES_OF_CARDS = ("position", "depth", "peers")
"""Stems of the images that `dmrl card` draws."""
MOST_SHOWN = 12
"""Evaluations, models or pairs that are drawn, at most; tables list all."""
FIGURES = {
    "median_px": ("median, px", ".1f"),
    "within_8_px": ("within 8 px", ".1%"),
    "within_20_px": ("within 20 px", ".1%"),
    "depth_mae_m": ("depth MAE, m", ".3f"),
    "precision": ("precision", ".1%"),
    "recall": ("recall", ".1%"),
    "f1": ("F1", ".3f"),
    "ap_16_px": ("AP at 16 px", ".3f"),
}
NOTHING: tuple[Any, ...] = (None, False, "", [], {})
"""Values of settings that are omitted from a command line."""
Documents = Mapping[str, Mapping[str, Any]]


def page(found: Found) -> str:
    """Build the report of a folder, HTML."""
    pictures = Pictures()
    bodies: list[tuple[str, str]] = [
        (found.title, story(found, pictures)),
        ("Detections", _detections(found, pictures)),
        ("Positions", _positions(found, pictures)),
        ("Tracks", _tracks(found, pictures)),
        ("Training", _training(found)),
        ("int8", _int8(found, pictures)),
        ("Datasets", _datasets(found, pictures)),
        ("Images", row(pictures.figure(path, path.name) for path in found.pictures[:MOST_SHOWN])),
        ("Catalogue", "".join(listed(*one) for one in found.catalogues.items())),
        ("Recordings", _recordings(found)),
        ("Provenance", _origin(found)),
        ("Unreadable files", table(("file", "why"), found.unread.items()) if found.unread else ""),
    ]
    return html.html(found.folder.resolve().name, _lead(found), bodies)


def _lead(found: Found) -> str:
    counts = {
        "catalogue": len(found.catalogues),
        "recording": len(found.recordings),
        "dataset": len(found.datasets),
        "model": len(found.of("models")),
        "evaluation": sum(len(found.of(kind)) for kind in ("evaluations", "positions", "tracks")),
    }
    words = [f"{n} {name}{'s' * (n != 1)}" for name, n in counts.items() if n]
    return f"{', '.join(words)}. Written by dmrl {__version__}."


def _each(documents: Documents, show: Callable[[str, Any], str]) -> str:
    """Show every document; name one that does not have dmrl's form."""
    parts = []
    for name, said in documents.items():
        try:
            parts.append(show(name, said))
        except WRONG as e:
            parts.append(f"<p>{text(name)} does not have dmrl's form ({text(repr(e))}).</p>")
    return "".join(parts)


def _kept(documents: Documents, take: Callable[[Any], Any]) -> dict[str, Any]:
    """Apply ``take`` to every document that has the values it needs."""
    out = {}
    for name, said in documents.items():
        try:
            out[name] = take(said)
        except WRONG:
            continue
    return out


def _detections(found: Found, pictures: Pictures) -> str:
    judged = found.of("evaluations")
    if not judged:
        return ""
    heads = ["evaluation", "against", "images", *(words for words, _ in FIGURES.values())]
    rows = _kept(judged, lambda said: [said["against"], said["images"], *_cells(said["overall"])])
    parts = [
        table(heads, [[name, *cells] for name, cells in rows.items()]),
        "<p>In brackets: 95 % intervals from a bootstrap over images.</p>",
    ]
    few = dict(list(judged.items())[:MOST_SHOWN])
    drawn = []
    for key, words in (("median_px", "median error, px"), ("depth_mae_m", "depth MAE, m")):
        bands = {name: rows for name, rows in _kept(few, _bands(key)).items() if rows}
        if bands:
            drawn.append(_drawn(charts.by_distance, bands, words, caption=f"{words} by distance"))
    if curves := _kept(few, _curve):
        words = "precision over recall, matches within 16 px"
        drawn.append(_drawn(charts.precision_recall, curves, caption=words))
    if bins := _kept(few, _bins):
        words = "share of correct detections over their confidence; calibrated is the diagonal"
        drawn.append(_drawn(charts.reliability, bins, caption=words))
    parts.append(row(drawn))
    parts.append(_each(few, lambda name, said: _evaluation(found, name, said, pictures)))
    return "".join(parts)


def _drawn(draw: Callable[..., str], *given: Any, caption: str) -> str:
    """Draw a chart; a line of text if its data are invalid."""
    try:
        return chart(draw(*given), caption)
    except WRONG as e:
        return f"<p>{text(caption)}: cannot be drawn ({text(repr(e))}).</p>"


def _cells(overall: Mapping[str, Any]) -> list[str]:
    return [_with_interval(overall[name], form) for name, (_, form) in FIGURES.items()]


def _with_interval(figure: Mapping[str, Any], form: str) -> str:
    if figure["value"] is None:
        return "-"
    ends = [figure["low"], figure["high"]]
    within = "" if None in ends else f" ({', '.join(format(end, form) for end in ends)})"
    return format(figure["value"], form) + within


def _bands(key: str) -> Callable[[Any], list[tuple[float, ...]]]:
    def take(said: Any) -> list[tuple[float, ...]]:
        out = []
        for band in said["bands"]:
            value, low, high = (band[key][end] for end in ("value", "low", "high"))
            if None not in (value, low, high):
                ends = band["from_m"], math.inf if band["to_m"] is None else band["to_m"]
                out.append(tuple(map(float, (*ends, value, low, high))))
        return out

    return take


def _curve(said: Any) -> tuple[Any, Any]:
    found = said["curves"]
    return np.array(found["recall"], float), np.array(found["precision"], float)


def _bins(said: Any) -> tuple[Any, Any, Any]:
    found = said["curves"]
    confidence, right = (np.array(found[f"bin_{name}"], float) for name in ("confidence", "right"))
    count = np.array(found["bin_count"], float)
    there = count > 0
    return confidence[there], right[there], count[there]


def _evaluation(found: Found, name: str, said: Mapping[str, Any], pictures: Pictures) -> str:
    sources = said["recordings"] if "recordings" in said else [said["recording"]]
    inputs = " ".join(str(source["name"]) for source in sources)
    split = f" --split {said['split']}" if said["split"] not in (None, "all") else ""
    ran = f"dmrl evaluate {inputs} --against {said['against']}{split} --plots {name}"
    partial = " Images without Detections were left out (--partial)." if said.get("partial") else ""
    words = f"{said['labels']} labels, threshold {float(said['threshold']):.2f}.{partial}"
    figures = [
        _if_there(found.folder / name / "examples.png", "images, confidence and depth", pictures),
        _if_there(found.folder / name / "error-violins.png", "errors", pictures),
        _if_there(found.folder / name / "error-by-distance.png", "errors by distance", pictures),
    ]
    return f"<h3>{text(name)}</h3><p>{text(words)} <code>{text(ran)}</code></p>{row(figures)}"


def _if_there(path: Path, caption: str, pictures: Pictures) -> str:
    there = path.is_file() and not path.is_symlink()
    return pictures.figure(path, caption, full="images" in caption) if there else ""


def _positions(found: Found, pictures: Pictures) -> str:
    def show(name: str, said: Mapping[str, Any]) -> str:
        heads = ["pair", *(words for _, words, _ in positions.COLUMNS)]
        ran = f"dmrl evaluate {said['recording']['name']} --what positions --plots {name}"
        drawn = sorted((found.folder / name).glob("position-error-*.png"))[:2]
        figures = row(_if_there(path, f"{path.stem}, 3-sigma bands", pictures) for path in drawn)
        judged = table(heads, positions.rows(dict(said))) + f"<p>{text(positions.note(said))}.</p>"
        return f"<h3>{text(name)}</h3><p><code>{text(ran)}</code></p>{judged}{figures}"

    return row(_from_above(found)) + _each(found.of("positions"), show)


def _from_above(found: Found) -> list[str]:
    """Draw maps of the first pairs with true positions."""
    out: list[str] = []
    for name in found.recordings:
        if len(out) >= 4:
            break
        try:
            known = positions.paths(found.folder / name)
        except DmrlError as e:
            found.unread[name] = str(e)
            continue
        for (robot, peer), path in list(known.items())[:2]:
            if path.kept.any():
                words = f"{name}: {peer} relative to {robot}, from above; 95 % ellipses"
                places = path.true_m, path.estimate_m, path.covariance, path.kept
                out.append(_drawn(charts.positions, *places, caption=words))
    return out


def _tracks(found: Found, pictures: Pictures) -> str:
    def show(name: str, said: Mapping[str, Any]) -> str:
        heads = ["robot", *(words for _, words, _ in tracks.COLUMNS)]
        drawn = sorted((found.folder / name).glob("*.png"))[:2]
        figures = row(_if_there(path, path.stem, pictures) for path in drawn)
        judged = table(heads, tracks.rows(dict(said))) + f"<p>{text(tracks.note(said))}.</p>"
        return f"<h3>{text(name)}</h3>{judged}{figures}"

    return _each(found.of("tracks"), show)


def _training(found: Found) -> str:
    models = found.of("models")
    if not models:
        return ""
    heads = ("model", "architecture", "parameters", "training images", "labels", "threshold")
    rows = _kept(models, _model)
    histories = {
        name: losses
        for name, losses in _kept(dict(list(models.items())[:MOST_SHOWN]), _losses).items()
        if len(losses) > 1
    }
    words = "loss over the epochs"
    drawn = [_drawn(charts.losses, histories, caption=words)] if histories else []
    return table(heads, [[name, *cells] for name, cells in rows.items()]) + row(drawn)


def _model(said: Any) -> list[Any]:
    own = said["training"]
    images = own.get("images") if isinstance(own, dict) else None
    threshold = f"{float(said['threshold']):.2f}"
    known = [said["architecture"], int(said["parameters"]), images, said["label_source"]]
    return [*known, threshold]


def _losses(said: Any) -> list[float]:
    return [float(epoch["loss"]) for epoch in said["training"]["history"]]


def _int8(found: Found, pictures: Pictures) -> str:
    def show(name: str, said: Mapping[str, Any]) -> str:
        heads = ("", *(words for words, _ in FIGURES.values()))
        rows = [
            [kind, *(format(float(figures[key]), form) for key, (_, form) in FIGURES.items())]
            for kind, figures in said["accuracy"].items()
        ]
        maps = _if_there(found.folder / name / "maps.png", "images and maps, float, int8", pictures)
        words = f"{said['images']} images of split {said['split']}"
        return f"<h3>{text(name)}</h3><p>{text(words)}</p>{table(heads, rows)}{row([maps])}"

    return _each(found.of("int8"), show)


def _datasets(found: Found, pictures: Pictures) -> str:
    rows, drawn = [], []
    for name, folder in found.datasets.items():
        made = found.made.get(name)
        sources = ", ".join(source.name for source in made.inputs) if made else ""
        rows.append((name, len(made.inputs) if made else None, sources))
        for stem in FIGURES_OF_CARDS:
            path = folder / "figures" / f"{stem}.png"
            drawn.append(_if_there(path, f"{name}: {stem}", pictures))
    shown = row([figure for figure in drawn if figure][:MOST_SHOWN])
    return table(("dataset", "inputs", "recordings"), rows) + shown if rows else ""


def _recordings(found: Found) -> str:
    rows = []
    for name, held in found.recordings.items():
        size = (found.folder / name).stat().st_size / 1e6
        who = ", ".join(robots(list(held.topics))) or None
        made = held.provenance.stage if held.provenance else None
        duration_s = (held.end_ns - held.start_ns) / 1e9
        rows.append(
            (name, f"{size:.1f}", f"{duration_s:.1f}", len(held.topics), held.count, who, made)
        )
    heads = ("recording", "MB", "s", "topics", "messages", "cameras", "made by")
    return table(heads, rows) if rows else ""


def _origin(found: Found) -> str:
    columns, arrows = ancestry(found.made)
    drawn = charts.chain(columns, arrows) if columns else ""
    libraries: dict[str, set[str]] = {}
    for made in found.made.values():
        libraries.setdefault("dmrl", set()).add(made.dmrl_version)
        for package, version in made.libraries.items():
            libraries.setdefault(package, set()).add(str(version))
    versions = [(package, ", ".join(sorted(known))) for package, known in sorted(libraries.items())]
    rows = [(name, _command(made.stage, made.settings)) for name, made in found.made.items()]
    wide = 8 * len(columns)
    parts = [chart(drawn, "stages, from sources to results", least_rem=wide)] if drawn else []
    if rows:
        parts.append(table(("output", "made by"), rows))
    if versions:
        parts.append(table(("package", "version"), versions))
    return "".join(parts)


def _command(stage: str, settings: Mapping[str, Any]) -> str:
    words: Iterable[str] = (
        f"{key}={_short(value)}" for key, value in settings.items() if value not in NOTHING
    )
    return f"dmrl {stage} {' '.join(words)}"


def _short(value: object, most: int = 60) -> str:
    words = str(value)
    return words if len(words) <= most else words[: most - 3] + "..."
