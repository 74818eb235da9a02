"""``dmrl sketch``: a folder of pictures drawn by code, as ``dmrl convert --from images`` reads.

So a demonstration takes the same road as anyone's own pictures.
"""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter, validators
from numpy.random import Generator

from dmrl.atomic_output import partial_folder
from dmrl.errors import SettingError
from dmrl.formats.files.image_folder import CALIBRATION, LABELS
from dmrl.formats.files.label_csv import LabelRow, write_labels
from dmrl.geometry.camera_file import write_camera
from dmrl.geometry.frames import AIDECK_PINHOLE, Camera
from dmrl.images.codec import encode_png
from dmrl.pipeline.parallel_map import spread
from dmrl.pipeline.process_pool import cores
from dmrl.recording import provenance
from dmrl.rendering.sketch_renderer import Sketch, draw
from dmrl.rendering.sketch_scene import random_look, random_poses
from dmrl.terminal.arguments import AsJson, Flat, Seed, Share, Workers
from dmrl.terminal.progress import track
from dmrl.terminal.tables import print_json, print_table

AT_ONCE = 100
"""Pictures that are given to a process: it takes as long to begin as to draw them."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What is drawn.

    Parameters
    ----------
    images
        Pictures to draw.
    seed
        Another seed draws other pictures.
    robots_max
        Robots in a picture, at most.
    empty_share
        Share of pictures without a robot, 0 to 1.
    test_share
        Share of pictures, the last ones, that form the test split, 0 to 1.
    """

    images: Annotated[int, Parameter(validator=validators.Number(gte=1, lte=999_999))] = 600
    seed: Seed = 0
    robots_max: Annotated[int, Parameter(validator=validators.Number(gte=1, lte=20))] = 3
    empty_share: Share = 0.1
    test_share: Share = 0.2


def run(out: Path, settings: Settings, *, workers: int = 1) -> dict[str, int]:
    """Counts of pictures and robots drawn into the folder ``out``.

    Parameters
    ----------
    out
        Folder to write. Must not exist.
    settings
        See `Settings`.
    workers
        Processes that draw, at most; changes no byte.

    Raises
    ------
    SettingError
        If a setting is out of range.
    OutputError
        If ``out`` exists or cannot be written.
    """
    _check(settings)
    rows: list[LabelRow] = []
    numbers = range(settings.images)
    parts = [numbers[k : k + AT_ONCE] for k in range(0, len(numbers), AT_ONCE)]
    drawn = spread(partial(_drawn, settings=settings), parts, workers)
    # A signal may come between two parts: closing ends the processes, which would work on.
    with partial_folder(out) as folder, closing(drawn):
        for name, png, labels in track(chain.from_iterable(drawn), "Drawing", settings.images):
            (folder / name).write_bytes(png)
            rows += labels
        with (folder / LABELS).open("w", newline="", encoding="utf-8") as stream:
            write_labels(stream, rows)
        (folder / CALIBRATION).write_text(write_camera(AIDECK_PINHOLE), encoding="utf-8")
        made = provenance("sketch", settings, seed=settings.seed, libraries=("numpy", "pillow"))
        made.write(folder)
    empty = sum(not row.peer for row in rows)
    return {"images": settings.images, "robots": len(rows) - empty, "empty images": empty}


def _drawn(indices: range, settings: Settings) -> list[tuple[str, bytes, list[LabelRow]]]:
    """Of each picture: the name of its file, its PNG, its labels."""
    made = []
    for index in indices:
        name, picture = f"{index:06d}.png", sketch(settings, index)
        labels = list(_rows(name, picture, _split(settings, index)))
        made.append((name, encode_png(picture.rgb), labels))
    return made


def sketch(settings: Settings, index: int, camera: Camera = AIDECK_PINHOLE) -> Sketch:
    """Picture number ``index``, the same whatever else is drawn.

    Parameters
    ----------
    settings
        Seed, and how many robots.
    index
        Number of the picture, from 0.
    camera
        Without distortion.
    """
    rng = np.random.default_rng((settings.seed, index))
    poses = random_poses(rng, camera, _count(rng, settings))
    return draw(camera, poses, random_look(rng, camera))


def _count(rng: Generator, settings: Settings) -> int:
    empty = rng.random() < settings.empty_share
    return 0 if empty else int(rng.integers(1, settings.robots_max + 1))


def _split(settings: Settings, index: int) -> str:
    first_test = settings.images - round(settings.images * settings.test_share)
    return "test" if index >= first_test else "train"


def _rows(name: str, picture: Sketch, split: str) -> Iterator[LabelRow]:
    if not len(picture.depth_m):
        yield LabelRow(name, "", source="truth", split=split)
    for k, ((u_px, v_px), depth_m) in enumerate(zip(picture.uv_px, picture.depth_m, strict=True)):
        box = tuple(picture.box_px[k].tolist())
        yield LabelRow(
            file=name,
            peer=f"cf{k + 2}",
            u_px=u_px,
            v_px=v_px,
            depth_m=depth_m,
            box_px=() if np.isnan(box).any() else box,
            visible_share=float(picture.visible_share[k]),
            source="truth",
            split=split,
        )


def _check(settings: Settings) -> None:
    if not (1 <= settings.images <= 999_999 and 1 <= settings.robots_max <= 20):
        raise SettingError("--images must be 1 to 999999 and --robots-max 1 to 20. Change them")
    if settings.seed < 0:
        raise SettingError(f"--seed {settings.seed} is negative. Choose 0 or more")
    if not (0 <= settings.empty_share <= 1 and 0 <= settings.test_share <= 1):
        raise SettingError("--empty-share and --test-share must be 0 to 1. Change them")


DEFAULTS = Settings()


def command(
    out: Path,
    /,
    *,
    settings: Flat[Settings] = DEFAULTS,
    workers: Workers = None,
    as_json: AsJson = False,
) -> None:
    """Draw a folder of pictures of small drones, with exact labels.

    Parameters
    ----------
    out
        Folder to write. Must not exist.
    workers
        Processes that draw, at most. Without it, as many as there are cores. Changes no byte.
    as_json
        Print one JSON document in place of the table.
    """
    counts = run(out, settings, workers=workers or cores())
    if as_json:
        print_json({"folder": str(out), **counts})
        return
    print_table(str(out), ("what", "count"), list(counts.items()))
