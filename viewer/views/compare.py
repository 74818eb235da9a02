"""Layout ``compare``: detections of two models in the same images, and their errors."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr

from dmrl import topics
from dmrl.colours import RGB, SECOND_DETECTION_RGB
from dmrl.datasets.writing.label_choice import choose_label_source
from dmrl.errors import DmrlError, RecordingError, SettingError
from dmrl.evaluation import detections
from dmrl.geometry.frames import Array
from dmrl.learn.inference.matching import compute_errors
from dmrl.recording import LoadedRecording
from dmrl.terminal.progress import say
from dmrl.viewer import layouts
from dmrl.viewer.content.robot_motion import Times
from dmrl.viewer.drawing import archetypes, time_plots
from dmrl.viewer.drawing.archetypes import Colour
from dmrl.viewer.drawing.entity import Entity
from dmrl.viewer.layouts import PlotPanel
from dmrl.viewer.scene import (
    PreparedEntity,
    Scene,
    build_camera_panels,
    build_colour_bars,
    build_image_rules,
    build_model_rules,
)
from dmrl.viewer.selection import Selection
from dmrl.viewer.settings import Settings

MODEL_COLOURS = (RGB["detection"], SECOND_DETECTION_RGB)
TABLE_PATH = "/models/table"
TABLE_ROWS: tuple[tuple[str, str, Callable[[Array], str]], ...] = (
    ("median error, px", "px", lambda v: f"{np.median(v):.2f}"),
    ("within 8 px", "px", lambda v: f"{np.mean(v <= 8):.1%}"),
    ("within 20 px", "px", lambda v: f"{np.mean(v <= 20):.1%}"),
    ("median depth error, m", "m", lambda v: f"{np.nanmedian(abs(v)):.3f}"),
)


@dataclass(frozen=True, slots=True)
class ModelErrors:
    """Errors of one model: (N,) log times of labels, sorted, and errors of pixel and depth."""

    source: str
    time_ns: Times
    error_px: Array
    error_m: Array


def scene(selection: Selection, settings: Settings) -> Scene:
    """Build the scene of two models in the images of one robot.

    Raises
    ------
    RecordingError
        Unless exactly two recordings have detections of that robot.
    """
    robot, models = _find_models(selection, settings.robot)
    scales = archetypes.build_scales(settings.depth_max_m)
    panels = (build_camera_panels(selection, [robot], scales, model=path) for path in models)
    cameras = [camera for row in panels for camera in row]
    judged = {path: found for path in models if (found := _compute_errors(path, robot, selection))}
    scene = Scene(
        layouts.build_compare_layout(
            cameras, scales, _build_plots(models, judged), TABLE_PATH, overlay=settings.overlay
        ),
        build_image_rules(cameras[0], set()),
        [*build_colour_bars(cameras[0], scales), *_iter_prepared_entities(models, judged)],
        cameras[:1],
    )
    sources = scene.sources.setdefault(robot, set())
    scene.draws = build_image_rules(cameras[0], sources)
    for camera, path, colour in zip(cameras, models, MODEL_COLOURS, strict=True):
        smooth = settings.overlay
        scene.draws += build_model_rules(camera, scales, colour, smooth=smooth, recording=path)
        scene.named[path.stem] = colour
    return scene


def _find_models(selection: Selection, wanted: str | None) -> tuple[str, list[Path]]:
    robot = wanted or min(selection.image_ns, default="")
    topic = topics.DETECTIONS(robot)
    models = [path for path, kept in selection.recordings.items() if topic in kept.topics]
    names = ", ".join(str(path) for path in selection.recordings)
    if len(models) != 2:
        raise RecordingError(
            f"{len(models)} of {names} have detections of {robot}; compare takes two. "
            "Try: dmrl predict MODEL IN.mcap OUT.mcap"
        )
    if models[0].stem == models[1].stem:
        raise SettingError(f"{names} have the same name, but it identifies the model. Rename one")
    return robot, models


def _compute_errors(path: Path, robot: str, selection: Selection) -> ModelErrors | None:
    """Compute the errors of a model; None, with a message, without labels to compare with."""
    try:
        source = choose_label_source(LoadedRecording(path, topics.LABELS), "best")
        pairs = detections.join_by_image([path], source)
    except DmrlError as e:
        say(f"no errors of {path.stem}: {e}")
        return None
    found = compute_errors(pairs.labels, pairs.detections)
    whose = np.array([at.robot for at in pairs.at], object)[pairs.labels.image]
    time_ns = np.array([at.time_ns for at in pairs.at], np.int64)[pairs.labels.image]
    first_ns, end_ns = selection.shown_ns
    own = (whose == robot) & (time_ns >= first_ns) & (time_ns < end_ns)
    return ModelErrors(source, time_ns[own], found.norm_px[own], found.depth_m[own])


def _model_path(path: Path) -> str:
    return f"/models/{path.stem}"


def _build_plots(models: Sequence[Path], judged: dict[Path, ModelErrors]) -> list[PlotPanel]:
    if not judged:
        return []
    source = next(iter(judged.values())).source
    return [
        PlotPanel(title, tuple(f"{_model_path(path)}/{name}" for path in models if path in judged))
        for title, name in (
            (f"pixel error against {source}, px", "error_px"),
            (f"depth error against {source}, m", "error_m"),
        )
    ]


def _iter_prepared_entities(
    models: Sequence[Path], judged: dict[Path, ModelErrors]
) -> Iterator[PreparedEntity]:
    for path, colour in zip(models, MODEL_COLOURS, strict=True):
        if path in judged and len(judged[path].time_ns):
            for entity in _draw_error_lines(path, judged[path], colour):
                yield np.unique(judged[path].time_ns), entity
    if judged:
        yield (
            None,
            Entity(
                TABLE_PATH,
                style=(rr.TextDocument(_format_table(judged), media_type="text/markdown"),),
            ),
        )


def _draw_error_lines(path: Path, judged: ModelErrors, colour: Colour) -> Iterator[Entity]:
    """Yield the error of the worst label of each image as lines."""
    _, row = np.unique(judged.time_ns, return_inverse=True)
    for name, values in (("error_px", judged.error_px), ("error_m", abs(judged.error_m))):
        worst = np.full(row.max() + 1, -np.inf)
        np.maximum.at(worst, row, np.nan_to_num(values, nan=np.inf))
        worst[~np.isfinite(worst)] = np.nan
        yield time_plots.draw_line(
            f"{_model_path(path)}/{name}", worst, path.stem, colour, time_plots.THIN_UI
        )


def _format_table(judged: dict[Path, ModelErrors]) -> str:
    names = [path.stem for path in judged]
    source = next(iter(judged.values())).source
    lines = [f"| against {source} | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    lines.append(f"| labels | {' | '.join(str(len(j.time_ns)) for j in judged.values())} |")
    for words, unit, form in TABLE_ROWS:
        cells = [
            form(j.error_px if unit == "px" else j.error_m) if len(j.time_ns) else "-"
            for j in judged.values()
        ]
        lines.append(f"| {words} | {' | '.join(cells)} |")
    return "\n".join(lines)
