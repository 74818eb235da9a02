"""What is asked for, into a rerun stream or file."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import rerun as rr

from dmrl import topics
from dmrl.colours import RGB
from dmrl.errors import OutputError
from dmrl.output import partial_file
from dmrl.viewer import entities, layouts
from dmrl.viewer.browse import browse
from dmrl.viewer.compare import compare_scene
from dmrl.viewer.flight import flight_scene
from dmrl.viewer.layouts import TIMELINE
from dmrl.viewer.scene import Scene, bars, eyes_of, logged, model_draws, picture_draws
from dmrl.viewer.selection import Selection, Settings, at_time, moment_ns, select
from dmrl.viewer.show import Logger, Show, cursor_at, stream_of


def save(paths: Sequence[Path], out: Path, settings: Settings) -> int:
    """Write what would be shown, with its layout, as an .rrd file.

    Returns
    -------
    int
        Images in it.

    Raises
    ------
    DatasetError
        If a folder is not a dataset.
    OutputError
        If ``out`` exists or cannot be written.
    RecordingError
        If no recording has what the layout shows, or one cannot be read.
    SettingError
        If nothing lies in the time asked for, or the layout does not fit.
    """
    show = prepare(paths, settings)
    with partial_file(out) as unfinished:
        write(show, unfinished)
    return show.images


def prepare(
    paths: Sequence[Path],
    settings: Settings,
    *,
    picture: bool = False,
    time_s: float | None = None,
    rank: int = 1,
) -> Show:
    """What the settings ask for; ``picture``: one image only, at a time or of a rank.

    Raises
    ------
    As `save`.
    """
    if any(path.is_dir() for path in paths):
        return browse(paths, settings, rank=rank if picture else None)
    selection = select(paths, settings)
    if picture:
        selection = at_time(selection, time_s)
    scene = _SCENES[selection.layout](selection, settings)
    shown_ns = moment_ns(selection, time_s)
    return Show(
        " + ".join(recording.stem for recording in selection.recordings),
        scene.blueprint,
        partial(logged, selection, scene),
        selection.images,
        cursor_at(TIMELINE, shown_ns, on_wall_clock=selection.on_wall_clock),
        f"at {(shown_ns - selection.start_ns) / 1e9:.3f} s",
    )


def write(show: Show, path: Path) -> None:
    """Write an .rrd file, whatever stands at ``path``.

    Raises
    ------
    OutputError
        If the disk is full, or refuses.
    """
    stream = stream_of()
    stream.save(path, default_blueprint=show.blueprint)
    try:
        log(show, stream)
        stream.flush()
    except RuntimeError as e:
        # All that rerun tells of a failed write, after the reason went to standard error.
        raise OutputError(f"cannot write {path}: {e}. Free some space, or name another") from e
    finally:
        stream.disconnect()


def log(show: Show, stream: rr.RecordingStream, wanted: Callable[[], bool] = lambda: True) -> None:
    """Log everything to a stream, as long as it is wanted."""
    stream.send_recording_name(show.title)
    logger = Logger(stream)
    for times, entity in show.logged():
        if not wanted():
            return
        logger.log(times, entity)


def image_scene(selection: Selection, settings: Settings) -> Scene:
    """Images and maps of every robot."""
    scales = entities.scales(settings.depth_max_m)
    eyes = eyes_of(selection, sorted(selection.image_ns), scales)
    scene = Scene(layouts.image(eyes, scales, overlay=settings.overlay), [], [], eyes)
    for eye in eyes:
        scene.draws += picture_draws(eye, scene.sources.setdefault(eye.robot, set()))
        scene.draws += model_draws(eye, scales, smooth=settings.overlay)
        scene.stills += bars(eye, scales)
        if any(n["robot"] == eye.robot for n in selection.found(topics.DETECTIONS)):
            scene.named["detection"] = RGB["detection"]
    return scene


_SCENES: dict[str, Callable[[Selection, Settings], Scene]] = {
    "image": image_scene,
    "flight": flight_scene,
    "compare": compare_scene,
}
