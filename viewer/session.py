"""Log what is asked for into a rerun stream or file."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, cast

import rerun as rr

from dmrl.errors import OutputError
from dmrl.output import partial_file
from dmrl.viewer.layouts import TIMELINE
from dmrl.viewer.scene import Scene, logged
from dmrl.viewer.selection import Settings, at_time, moment_ns, select
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
        browse: Callable[..., Show] = _loaded(_DATASET)
        return browse(paths, settings, rank=rank if picture else None)
    selection = select(paths, settings)
    if picture:
        selection = at_time(selection, time_s)
    scene: Scene = _loaded(f"dmrl.viewer.views.{selection.layout}:scene")(selection, settings)
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


# Loaded when they are shown: the picture waits for what is imported, and compare and dataset
# judge models.
_DATASET = "dmrl.viewer.browse:browse"


def _loaded(name: str) -> Callable[..., Any]:
    return cast(Callable[..., Any], resolve_name(name))
