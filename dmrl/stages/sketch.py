"""``dmrl sketch``: a folder of pictures drawn by code, as ``dmrl convert --from images`` reads.

So a demonstration takes the same road as anyone's own pictures.
"""

from contextlib import closing
from functools import partial
from itertools import chain
from pathlib import Path

from dmrl.atomic_output import atomic_folder
from dmrl.errors import SettingError
from dmrl.pipeline.parallel_map import parallel_map
from dmrl.pipeline.stage_command import stage_command
from dmrl.simulation.settings import SketchSettings as Settings
from dmrl.terminal.closing import Closing
from dmrl.terminal.progress import track

PART_IMAGES = 100
"""Pictures that a process is given at once: it takes as long to begin as to draw them."""


def run(out: Path, settings: Settings, *, workers: int = 1) -> dict[str, int]:
    """Draw a folder of pictures of small drones, with exact labels.

    Parameters
    ----------
    out
        Folder to write. Must not exist.
    settings
        See `Settings`.
    workers
        Processes that draw, at most. Without it, one per core. Does not affect the output.

    Returns
    -------
    dict
        Number of pictures, of robots, and of pictures without one.

    Raises
    ------
    SettingError
        If a setting is out of range.
    OutputError
        If ``out`` exists or cannot be written.
    """
    from dmrl.formats.files.image_folder import LABELS_FILE
    from dmrl.formats.files.label_csv import LabelRow, write_labels
    from dmrl.formats.files.labelled_pictures import CALIBRATION_FILE
    from dmrl.geometry.camera_file import format_camera
    from dmrl.geometry.frames import AIDECK_PINHOLE
    from dmrl.recording import build_provenance
    from dmrl.simulation.drawn_pictures import draw_files

    _check(settings)
    rows: list[LabelRow] = []
    numbers = range(settings.images)
    parts = [numbers[k : k + PART_IMAGES] for k in range(0, len(numbers), PART_IMAGES)]
    drawn = parallel_map(partial(draw_files, settings=settings), parts, workers)
    # A signal may come between two parts: closing ends the processes, which would work on.
    with atomic_folder(out) as folder, closing(drawn):
        for name, png, labels in track(chain.from_iterable(drawn), "Drawing", settings.images):
            (folder / name).write_bytes(png)
            rows += labels
        with (folder / LABELS_FILE).open("w", newline="", encoding="utf-8") as stream:
            write_labels(stream, rows)
        (folder / CALIBRATION_FILE).write_text(format_camera(AIDECK_PINHOLE), encoding="utf-8")
        made = build_provenance(
            "sketch", settings, seed=settings.seed, libraries=("numpy", "pillow")
        )
        made.write(folder)
    empty = sum(not row.peer for row in rows)
    return {"images": settings.images, "robots": len(rows) - empty, "empty images": empty}


def _check(settings: Settings) -> None:
    """Raise SettingError if a setting is out of range: ``run`` may be called without a check."""
    if not (1 <= settings.images <= 999_999 and 1 <= settings.robots_max <= 20):
        raise SettingError("--images must be 1 to 999999 and --robots-max 1 to 20. Change them")
    if settings.seed < 0:
        raise SettingError(f"--seed {settings.seed} is negative. Choose 0 or more")
    if not (0 <= settings.empty_share <= 1 and 0 <= settings.test_share <= 1):
        raise SettingError("--empty-share and --test-share must be 0 to 1. Change them")


command = stage_command(run, Closing(columns=("what", "count"), path_key="folder"))
