"""``dmrl likeness``: what one's own camera does to its pictures, as a recipe for renders."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter, validators

from dmrl import recipe as recipes
from dmrl import topics
from dmrl.datasets.backgrounds import photos_of
from dmrl.errors import RecordingError, SettingError
from dmrl.formats.image_folder import list_pictures
from dmrl.images.codec import Rgb, crop_and_scale, decode, encode_png
from dmrl.output import partial_file, partial_of, refuse_existing
from dmrl.recording import read, summary
from dmrl.rendering import settings as looks
from dmrl.rendering.fitting import KNOBS, fitted, pictures
from dmrl.rendering.interiors import ROOMS
from dmrl.rendering.likeness import FIGURES, Likeness, likeness
from dmrl.terminal.arguments import AsJson, Flat
from dmrl.terminal.progress import say
from dmrl.terminal.tables import print_json, print_line, print_table

LEAST_PX = 48
"""Side of a frame, at least."""
TILE_PX, COLUMNS = (192, 144), 8
FEW = 20
WORDS = {
    "brightness": "mean luma, 0 to 1",
    "contrast": "contrast, of luma",
    "cast": "red over blue",
    "colour": "spread of colours",
    "grain": "grain, levels of 256",
    "grain_correlation": "grain, neighbours alike",
    "edge_px": "width of edges, px",
    "corners": "corners over middle",
}


Count = Annotated[int, Parameter(validator=validators.Number(gte=2))]


@dataclass(frozen=True, slots=True)
class Settings:
    """What is fitted, to how many frames.

    Parameters
    ----------
    preset
        Of dmrl render, to start from: plain, himax or published.
    backgrounds
        What stands for the scene: rooms, which are made by code, a folder of photos, or a dataset.
    frames
        Frames that are looked at, at most, evenly over all.
    seed
        Of the pictures that are made for comparison.
    """

    preset: str = "himax"
    backgrounds: Path = Path(ROOMS)
    frames: Count = 200
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Result:
    """Figures of real frames, of the preset's pictures and the fitted ones; the recipe's keys."""

    frames: int
    real: Likeness
    preset: Likeness
    fitted: Likeness
    keys: dict[str, object]


def run(real: Path, out: Path, settings: Settings) -> Result:
    """Measure real frames, fit a preset to them, and write it as a recipe, with a picture beside.

    Parameters
    ----------
    real
        Folder of frames as the camera stores them, or a recording with images.
    out
        Recipe to write; the picture is of the same name and ends in .png. Neither may exist.
    settings
        See `Settings`.

    Raises
    ------
    SourceError
        If there is no picture, or one cannot be decoded.
    RecordingError
        If a recording cannot be read, or has no images.
    SettingError
        If the frames are not of one size, or too small; if the backgrounds cannot be used.
    RecipeError
        If there is no such preset.
    OutputError
        If the recipe or the picture exists.
    """
    if not out.name or out.suffix == ".png":
        raise SettingError(f"{out} is no name of a recipe. Write one: OUT.toml")
    picture = out.with_suffix(".png")
    refuse_existing(out)
    if not partial_of(out).exists():  # else one that was killed may have left the picture
        refuse_existing(picture)
    own = _frames(real, settings.frames)
    preset = {"preset": settings.preset}
    start = recipes.check(settings.preset, looks.filled(preset), looks.Settings)
    photos = photos_of(settings.backgrounds)
    found = fitted(own, start, photos, settings.seed)
    size_px = (own[0].shape[1], own[0].shape[0])
    before, after = (
        list(pictures(way, photos, size_px, settings.seed + 1)) for way in (start, found)
    )
    keys = _keys(found, start)
    _write(out, _recipe(settings.preset, keys), picture, _sheet([own, before, after]))
    return Result(len(own), likeness(own), likeness(before), likeness(after), keys)


def _write(out: Path, recipe: str, picture: Path, sheet: bytes) -> None:
    """Write the picture, then the recipe; an error leaves neither.

    A process that is killed between the two leaves the picture: the same picture is no obstacle.
    """
    there = picture.is_file() and picture.read_bytes() == sheet
    made = False
    try:
        with partial_file(out) as partial:
            partial.write_text(recipe, encoding="utf-8")
            if not there:
                with partial_file(picture) as beside:
                    beside.write_bytes(sheet)
                made = True
    except BaseException:
        if made:
            with suppress(OSError):
                picture.unlink()
        raise


def _frames(real: Path, most: int) -> list[Rgb]:
    """Frames of a folder or recording, at most so many, evenly over all."""
    if real.is_dir():
        paths = [path for _, path in list_pictures(real, 10.0)]
        data = [(paths[k].read_bytes(), str(paths[k])) for k in _evenly(len(paths), most)]
    else:
        held = summary(real).topics
        topic = next((name for name in held if topics.names(topics.CAMERA_IMAGE, name)), None)
        if topic is None:
            raise RecordingError(f"{real} has no images. Give a folder of frames, or another")
        chosen, count = set(_evenly(held[topic].count, most)), held[topic].count
        stream = enumerate(islice(read(real, topic), count))
        data = [(bytes(s.message.data), f"{real}: image {k}") for k, s in stream if k in chosen]
    own = [decode(content, name) for content, name in data]
    sizes = sorted({(rgb.shape[1], rgb.shape[0]) for rgb in own})
    if len(sizes) != 1:
        words = ", ".join(f"{width}x{height}" for width, height in sizes)
        raise SettingError(f"{real} holds frames of {words} px. Give frames of one camera alone")
    if min(sizes[0]) < LEAST_PX:
        raise SettingError(
            f"{real}: frames of {sizes[0][0]}x{sizes[0][1]} px are too small to measure. Give "
            f"frames of at least {LEAST_PX} px each way"
        )
    return own


def _evenly(count: int, most: int) -> list[int]:
    return sorted({int(k) for k in np.linspace(0, count - 1, min(count, most)).round()})


def _keys(found: looks.Settings, start: looks.Settings) -> dict[str, object]:
    """What the fit changed, as a recipe has it."""
    names = [*(knob.key for knob in KNOBS), "bayer", "jpeg_quality", "image_format"]
    changed = {name: getattr(found, name) for name in names}
    return {
        name: [_rounded(end) for end in value] if isinstance(value, tuple) else value
        for name, value in changed.items()
        if value != getattr(start, name)
    }


def _rounded(value: float) -> float:
    """Three digits that count: more is not known."""
    return value if not value else round(value, 2 - math.floor(math.log10(abs(value))))


def _recipe(preset: str, keys: dict[str, object]) -> str:
    own = [f"{name} = {_toml(value)}" for name, value in keys.items()]
    lines = [
        "# Renders that look like one's own frames, as dmrl likeness found.",
        "# dmrl render THIS.toml renders.mcap --backgrounds rooms --camera camera.toml",
        *("", 'kind = "render"', f'preset = "{preset}"', "", *own, ""),
    ]
    return "\n".join(lines)


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else str(value)


def _sheet(ways: Sequence[Sequence[Rgb]]) -> bytes:
    """PNG of two rows each: real frames, the preset's pictures, the fitted ones."""
    rows = []
    for way in ways:
        tiles = [
            crop_and_scale(way[k], (0, 0, way[k].shape[1], way[k].shape[0]), *TILE_PX)
            for k in _evenly(len(way), 2 * COLUMNS)
        ]
        tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % COLUMNS)
        rows += [np.hstack(tiles[k : k + COLUMNS]) for k in range(0, len(tiles), COLUMNS)]
        rows.append(np.full((8, rows[-1].shape[1], 3), 255, np.uint8))
    return encode_png(np.vstack(rows))


DEFAULTS = Settings()


def command(
    real: Path,
    out: Annotated[Path, Parameter(name="OUT.toml")],
    /,
    *,
    settings: Flat[Settings] = DEFAULTS,
    as_json: AsJson = False,
) -> None:
    """Fit a render recipe to one's own frames, and show both beside each other.

    Parameters
    ----------
    real
        Folder of frames as the camera stores them, or a recording with images.
    out
        Recipe to write. A picture of the same name, .png, shows two rows of real frames, two of
        the preset's pictures, two of the recipe's.
    as_json
        Print one JSON document in place of the table.
    """
    result = run(real, out, settings)
    if result.frames < FEW:
        say(f"{real} holds {result.frames} frames: few to know a camera by. {FEW} are better")
    if as_json:
        print_json({"recipe": str(out), "picture": str(out.with_suffix(".png")), **asdict(result)})
        return
    three = (result.real, result.preset, result.fitted)
    rows = [(WORDS[name], *(f"{getattr(one, name):.3f}" for one in three)) for name in FIGURES]
    print_table(str(out), ("figure", f"{result.frames} real", settings.preset, "fitted"), rows)
    print_line(f"beside each other: {out.with_suffix('.png')}")
