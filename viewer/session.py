"""Log a selection into a rerun stream or file."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from threading import Thread
from typing import Any, Protocol

import rerun as rr

from dmrl.atomic_output import atomic_file
from dmrl.viewer.layouts import TIMELINE
from dmrl.viewer.scene import Scene, iter_scene
from dmrl.viewer.selection import choose_moment_ns, select_recordings, select_time
from dmrl.viewer.settings import Settings
from dmrl.viewer.show import EntityLogger, Show, build_cursor, open_stream

COPY_BYTES = 1 << 20
"""Size of the pieces in which an .rrd file is written."""


class Writable(Protocol):
    """Protocol of a binary file that is written from start to end."""

    @property
    def name(self) -> Any:
        """Name for errors."""

    def write(self, block: bytes, /) -> int:
        """Append bytes."""

    def flush(self) -> None:
        """Pass appended bytes to the system."""


def save(paths: Sequence[Path], out: Path, settings: Settings) -> int:
    """Write the selected images, with their layout, as an .rrd file.

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
        If no recording has data for the layout, or one cannot be read.
    SettingError
        If the recordings are empty at the requested time, or the layout does not fit.
    """
    show = prepare_show(paths, settings)
    with atomic_file(out) as unfinished, unfinished.open("wb") as file:
        write_rrd(show, file)
    return show.images


def prepare_show(
    paths: Sequence[Path],
    settings: Settings,
    *,
    picture: bool = False,
    time_s: float | None = None,
    rank: int = 1,
) -> Show:
    """Prepare a show from the settings; ``picture``: one image only, by time or rank.

    Raises
    ------
    As `save`.
    """
    if any(path.is_dir() for path in paths):
        # Imported when shown: compare and dataset import model evaluation, which takes time.
        browse: Callable[..., Show] = resolve_name("dmrl.viewer.browse:browse")
        return browse(paths, settings, rank=rank if picture else None)
    selection = select_recordings(paths, settings)
    if picture:
        selection = select_time(selection, time_s)
    build_scene = resolve_name(f"dmrl.viewer.views.{selection.layout}:scene")
    scene: Scene = build_scene(selection, settings)
    shown_ns = choose_moment_ns(selection, time_s)
    return Show(
        " + ".join(recording.stem for recording in selection.recordings),
        scene.blueprint,
        partial(iter_scene, selection, scene),
        selection.images,
        build_cursor(TIMELINE, shown_ns, selection.zero_ns),
        f"at {(shown_ns - selection.start_ns) / 1e9:.3f} s",
    )


def write_rrd(show: Show, file: Writable, wanted: Callable[[], bool] = lambda: True) -> None:
    """Write the data of an .rrd file, as long as it is wanted.

    Raises
    ------
    OSError
        If writing fails.
    """
    with _relay_to_file(file) as (pipe, still_written):
        stream = open_stream()
        stream.save(pipe, default_blueprint=show.blueprint)
        try:
            log_show(show, stream, lambda: still_written() and wanted())
            stream.flush()
        finally:
            stream.disconnect()


@contextmanager
def _relay_to_file(file: Writable) -> Iterator[tuple[str, Callable[[], bool]]]:
    """Yield a pipe that is copied to a file, and a function that is False after an error.

    rerun reports a failed write only on standard error, and may then wait for its writer for ever
    (0.41). So it never writes to the disk itself: the pipe accepts everything, to its end.
    """
    refused: list[OSError] = []
    ear, mouth = os.pipe()

    def drain() -> None:
        with os.fdopen(ear, "rb", buffering=0) as stream:
            for block in iter(partial(stream.read, COPY_BYTES), b""):
                if not refused:
                    try:
                        file.write(block)
                        file.flush()
                    except OSError as e:
                        refused.append(e)

    drained = Thread(target=drain, daemon=True)
    drained.start()
    try:
        yield f"/dev/fd/{mouth}", lambda: not refused
    finally:
        os.close(mouth)
        drained.join()
    if refused:
        error = refused[0]
        raise OSError(error.errno, error.strerror, str(file.name)) from error


def log_show(
    show: Show, stream: rr.RecordingStream, wanted: Callable[[], bool] = lambda: True
) -> None:
    """Log everything to a stream, as long as it is wanted."""
    stream.send_recording_name(show.title)
    logger = EntityLogger(stream)
    for times, entity in show.logged():
        if not wanted():
            return
        logger.log_entity(times, entity)
