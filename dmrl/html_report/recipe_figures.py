"""Draw the figures that a recipe defines for the top of its report."""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dmrl import plots, topics
from dmrl.evaluation.detections import ImageKey
from dmrl.evaluation.figure_specs import FigureSpec, ReportedValue, find_value
from dmrl.evaluation.figures import iter_maps, read_image
from dmrl.html_report.blocks import (
    INVALID_DATA_ERRORS,
    Block,
    Figure,
    Heading,
    ImageEmbedder,
    Table,
    Text,
    build_row,
)
from dmrl.html_report.collect import ReportInputs, read_document
from dmrl.plots import charts
from dmrl.recording import LoadedRecording, read_summary

IMAGE_FILES = {"images": "circles.png", "errors": "error-violins.png"}
LOSS_LABELS = {"confidence_loss": "confidence loss", "depth_loss": "depth loss"}
MAX_MAPS = 3
"""Images of a figure of maps, at most."""


def build_recipe_figures(found: ReportInputs, pictures: ImageEmbedder) -> list[Block]:
    """Build a recipe's figures, in its order; a figure that fails shows its error."""
    blocks: list[Block] = []
    for shown in found.story:
        try:
            body = FIGURE_BUILDERS[shown.shows](found, shown, pictures)
        except INVALID_DATA_ERRORS as e:
            body = [Text(f"cannot be drawn: {str(e) or repr(e)}")]
        words = [Text(shown.words)] if shown.words else []
        blocks += [Heading(shown.title), *words, *body]
    return blocks


def _build_numbers(found: ReportInputs, shown: FigureSpec, _: ImageEmbedder) -> list[Block]:
    rows = [(one.what, one.published, _format_value(found, one)) for one in shown.rows]
    return [Table(("", "published", "here"), rows)]


def _format_value(found: ReportInputs, number: ReportedValue) -> str:
    value = find_value(read_document(_resolve_output(found, number.of)), number.at)
    if value is None or isinstance(value, str):
        return value or "-"
    return format(value, number.form)


def _resolve_output(found: ReportInputs, name: str) -> Path:
    """Return the path of an output; reject paths outside the folder, and pipes, which never end."""
    path = found.folder / name
    if not path.resolve().is_relative_to(found.folder.resolve()):
        raise ValueError(f"{name} leads out of the folder")
    if path.exists() and not path.is_file():
        raise ValueError(f"{name} is not a file")
    return path


def _build_losses(found: ReportInputs, shown: FigureSpec, _: ImageEmbedder) -> list[Block]:
    drawn = []
    for key, words in LOSS_LABELS.items():
        curves = {}
        for k, name in enumerate(shown.of):
            model = read_document(_resolve_output(found, f"{name}/model.json"))
            history = model["training"]["history"]
            curves[shown.output_label(k)] = [float(epoch[key]) for epoch in history]
        drawn.append(Figure(f"{words} over the epochs", svg=charts.plot_losses(curves, words)))
    return build_row(drawn)


def _build_images(found: ReportInputs, shown: FigureSpec, pictures: ImageEmbedder) -> list[Block]:
    full, file = shown.shows == "images", IMAGE_FILES[shown.shows]
    paths = [_resolve_output(found, f"{name}/{file}") for name in shown.of]
    return build_row(
        pictures.embed(path, shown.output_label(k), full=full) for k, path in enumerate(paths)
    )


def _build_maps(found: ReportInputs, shown: FigureSpec, pictures: ImageEmbedder) -> list[Block]:
    every = {shown.output_label(k): _resolve_output(found, name) for k, name in enumerate(shown.of)}
    names = {who: path for who, path in every.items() if path.exists()}  # some are optional
    drawn = _read_map_pairs(names)
    if not drawn:
        raise ValueError(f"{', '.join(shown.of)} have no maps of the same images")
    with tempfile.TemporaryDirectory() as place:
        plots.plot_map_pairs(drawn, Path(place) / "maps")
        picture = pictures.embed(Path(place) / "maps.png", ", ".join(names), full=True)
    return [*build_row([picture]), _compare_maps(drawn)]


def _compare_maps(drawn: Sequence[plots.MapPair]) -> Table:
    """Build a table that compares the maps with those of the first recording."""
    first, *others = drawn[0].maps
    rows = []
    for who in others:
        for k, words in enumerate(("confidence", "depth, m")):
            pairs = [(one.maps[first][k].ravel(), one.maps[who][k].ravel()) for one in drawn]
            a, b = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
            like = f"{np.corrcoef(a, b)[0, 1]:.3f}" if np.ptp(a) and np.ptp(b) else "-"
            rows.append((who, words, like, f"{np.abs(a - b).mean():.4f}"))
    return Table((f"against {first}", "map", "correlation", "mean difference"), rows)


def _read_map_pairs(names: Mapping[str, Path]) -> list[plots.MapPair]:
    """Return a few images of which all recordings have maps."""
    first = next(iter(names.values()))
    held = list(LoadedRecording(first, topics.GRID).topics)
    robot = next(iter(topics.list_robots(held, topics.GRID)), None)
    if robot is None:
        return []
    grids = {who: dict(iter_maps(path, robot)) for who, path in names.items()}
    times = sorted(set.intersection(*(set(one) for one in grids.values())))
    start_ns = read_summary(first).start_ns  # as in dmrl view --time
    chosen = times[:: max(1, -(-len(times) // MAX_MAPS))]
    return [
        plots.MapPair(
            f"{robot}, {(time_ns - start_ns) / 1e9:.2f} s",
            read_image(ImageKey(first, robot, time_ns)),
            {
                who: (one[time_ns]["confidence"], one[time_ns]["depth_m"])
                for who, one in grids.items()
            },
        )
        for time_ns in chosen
    ]


FIGURE_BUILDERS = {
    "numbers": _build_numbers,
    "losses": _build_losses,
    "images": _build_images,
    "errors": _build_images,
    "maps": _build_maps,
}
