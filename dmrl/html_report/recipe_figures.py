"""Draw the figures that a recipe defines for the top of its report."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl import plots, topics
from dmrl.evaluation.figure_specs import Number, Shown, value_at
from dmrl.guards.bounded_parsing import parse_json
from dmrl.html_report.collect import MOST_BYTES, Found
from dmrl.html_report.html import WRONG, Pictures, chart, row, table, text
from dmrl.images.codec import decode
from dmrl.plots import charts
from dmrl.recording import Contents, read, summary

PICTURE = {"images": "circles.png", "errors": "error-violins.png"}
LOSSES = {"confidence_loss": "confidence loss", "depth_loss": "depth loss"}
MOST_MAPS = 3
"""Images of a figure of maps, at most."""


def story(found: Found, pictures: Pictures) -> str:
    """Build the HTML of a recipe's figures, in its order; a figure that fails shows its error."""
    parts = []
    for shown in found.story:
        try:
            body = DRAWN[shown.shows](found, shown, pictures)
        except WRONG as e:
            body = f"<p>cannot be drawn: {text(str(e) or repr(e))}</p>"
        words = f"<p>{text(shown.words)}</p>" if shown.words else ""
        parts.append(f"<h3>{text(shown.title)}</h3>{words}{body}")
    return "".join(parts)


def _numbers(found: Found, shown: Shown, _: Pictures) -> str:
    rows = [(one.what, one.published, _ours(found, one)) for one in shown.rows]
    return table(("", "published", "here"), rows)


def _ours(found: Found, number: Number) -> str:
    value = value_at(_document(found, number.of), number.at)
    if value is None or isinstance(value, str):
        return value or "-"
    return format(value, number.form)


def _document(found: Found, name: str) -> Any:
    path = _inside(found, name)
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"{name} is larger than {MOST_BYTES >> 20} MB")
    return parse_json(path.read_text(encoding="utf-8"))


def _inside(found: Found, name: str) -> Path:
    """Return the path of an output; reject paths outside the folder, and pipes, which never end."""
    path = found.folder / name
    if not path.resolve().is_relative_to(found.folder.resolve()):
        raise ValueError(f"{name} leads out of the folder")
    if path.exists() and not path.is_file():
        raise ValueError(f"{name} is not a file")
    return path


def _losses(found: Found, shown: Shown, _: Pictures) -> str:
    drawn = []
    for key, words in LOSSES.items():
        curves = {}
        for k, name in enumerate(shown.of):
            history = _document(found, f"{name}/model.json")["training"]["history"]
            curves[shown.label(k)] = [float(epoch[key]) for epoch in history]
        drawn.append(chart(charts.losses(curves, words), f"{words} over the epochs"))
    return row(drawn)


def _pictured(found: Found, shown: Shown, pictures: Pictures) -> str:
    full = shown.shows == "images"
    return row(
        pictures.figure(_inside(found, f"{name}/{PICTURE[shown.shows]}"), shown.label(k), full=full)
        for k, name in enumerate(shown.of)
    )


def _maps(found: Found, shown: Shown, pictures: Pictures) -> str:
    every = {shown.label(k): _inside(found, name) for k, name in enumerate(shown.of)}
    names = {who: path for who, path in every.items() if path.exists()}  # some are optional
    drawn = _rows_of_maps(names)
    if not drawn:
        raise ValueError(f"{', '.join(shown.of)} have no maps of the same images")
    with tempfile.TemporaryDirectory() as place:
        plots.map_pairs(drawn, Path(place) / "maps")
        picture = pictures.figure(Path(place) / "maps.png", ", ".join(names), full=True)
    return row([picture, _agreement(drawn)])


def _agreement(drawn: Sequence[plots.MapPair]) -> str:
    """Build a table that compares the maps with those of the first recording."""
    first, *others = drawn[0].maps
    rows = []
    for who in others:
        for k, words in enumerate(("confidence", "depth, m")):
            pairs = [(one.maps[first][k].ravel(), one.maps[who][k].ravel()) for one in drawn]
            a, b = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
            like = f"{np.corrcoef(a, b)[0, 1]:.3f}" if np.ptp(a) and np.ptp(b) else "-"
            rows.append((who, words, like, f"{np.abs(a - b).mean():.4f}"))
    return table((f"against {first}", "map", "correlation", "mean difference"), rows)


def _rows_of_maps(names: Mapping[str, Path]) -> list[plots.MapPair]:
    """Return a few images of which all recordings have maps."""
    first = next(iter(names.values()))
    robot = next(iter(topics.robots(list(Contents(first, topics.GRID).topics), topics.GRID)), None)
    if robot is None:
        return []
    grids = {who: dict(_grids(path, robot)) for who, path in names.items()}
    times = sorted(set.intersection(*(set(one) for one in grids.values())))
    start_ns = summary(first).start_ns  # as in dmrl view --time
    chosen = times[:: max(1, -(-len(times) // MOST_MAPS))]
    return [
        plots.MapPair(
            f"{robot}, {(time_ns - start_ns) / 1e9:.2f} s",
            _picture(first, robot, time_ns),
            {who: one[time_ns] for who, one in grids.items()},
        )
        for time_ns in chosen
    ]


Maps = tuple[NDArray[np.float64], NDArray[np.float64]]


def _grids(path: Path, robot: str) -> Iterator[tuple[int, Maps]]:
    for stamped in read(path, topics.grid(robot)):
        grid = stamped.message
        shape = (len(grid.channels), grid.rows, grid.cols)
        values = np.frombuffer(grid.data, "<f4").reshape(shape).astype(float)
        named = dict(zip(grid.channels, values, strict=True))
        yield stamped.time_ns, (named["confidence"], named["depth_m"])


def _picture(path: Path, robot: str, time_ns: int) -> NDArray[np.uint8]:
    topic = topics.camera_image(robot)
    taken = next(read(path, topic, start_ns=time_ns, end_ns=time_ns + 1))
    return decode(taken.message.data, what=f"{path}: {topic} at {time_ns} ns")


DRAWN = {
    "numbers": _numbers,
    "losses": _losses,
    "images": _pictured,
    "errors": _pictured,
    "maps": _maps,
}
