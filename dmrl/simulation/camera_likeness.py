"""A render preset fitted to frames of a real camera, as a recipe with a picture beside it."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from dmrl import recipe as recipes
from dmrl import topics
from dmrl.atomic_output import atomic_file, refuse_existing, to_partial_path
from dmrl.datasets.backgrounds import open_backgrounds
from dmrl.errors import RecordingError, SettingError
from dmrl.formats.files.image_folder import list_images
from dmrl.images.codec import Rgb, decode, read_size
from dmrl.images.contact_sheet import even_indices, make_contact_sheet
from dmrl.recording import read, read_summary
from dmrl.rendering import settings as looks
from dmrl.rendering.camera.image_statistics import (
    FIGURES,
    ImageMeasurements,
    ImageStatistics,
    measure_images,
)
from dmrl.rendering.preset_fitting import KNOBS, ROUNDS, iter_fits, sample_scenes, simulate_images
from dmrl.simulation.settings import LikenessSettings
from dmrl.terminal.progress import track
from dmrl.terminal.tables import print_line, print_table

LEAST_PX, MOST_PX = 48, 2_100_000
"""Side of a frame, at least; pixels of one, at most."""
TOGETHER_PX = 100_000_000
"""Of all frames, at most; of large ones fewer are looked at."""
FEW = 20
WORDS = {
    "brightness": "mean luma, 0 to 1",
    "contrast": "contrast, of luma",
    "cast": "red over blue",
    "colour": "spread of colours",
    "edge_px": "width of edges, px",
    "corners": "corners over middle",
    "grain": "grain, levels of 256",
    "grain_correlation": "grain, neighbours alike",
}
SMALL, WHITE_NOISE = 0.1, 0.15
"""A figure under it is compared by its difference: of hardly anything, per cent say nothing. A
correlation under the second is that of white noise and its error."""
FAR = 0.2
WHITE, MUCH_WHITE = 250, 0.4


@dataclass(frozen=True, slots=True)
class Result:
    """Figures of real frames, of both their halves, of the preset's pictures and the fitted ones.

    ``keys`` are those of the recipe, ``notes`` limits of the frames or the fit.
    """

    frames: int
    real: ImageStatistics
    halves: tuple[ImageStatistics, ...]
    preset: ImageStatistics
    fitted: ImageStatistics
    keys: dict[str, object]
    notes: list[str]

    def print(self, recipe: Path, preset: str) -> None:
        """Print a row for each figure, and the place of the picture."""
        head = ("figure", f"{self.frames} real", preset, "fitted", "off", "halves of real")
        rows = [(WORDS[name], *self._row(name)) for name in FIGURES]
        print_table(str(recipe), head, rows)
        print_line(f"beside each other: {recipe.with_suffix('.png')}")

    def _row(self, name: str) -> list[str]:
        """Return a figure, how far the fit is off, and how far the halves are apart."""
        three = [getattr(one, name) for one in (self.real, self.preset, self.fitted)]
        halves = [getattr(half, name) for half in self.halves] or [None, None]
        words = ["-" if value is None else f"{value:.3f}" for value in three]
        return [*words, _apart(name, three[0], three[2])[1], _apart(name, *halves)[1]]


def fit_preset(real: Path, out: Path, settings: LikenessSettings) -> Result:
    """Measure real frames, fit a preset to them, and write it as a recipe, with a picture beside.

    Parameters
    ----------
    real
        Folder of frames as the camera stores them, or a recording with images.
    out
        Recipe to write; the picture has the same name and ends in .png.
    settings
        See `LikenessSettings`.
    """
    if not out.name or out.suffix == ".png":
        raise SettingError(f"{out} is no name of a recipe. Write one: OUT.toml")
    picture = out.with_suffix(".png")
    refuse_existing(out)
    if not to_partial_path(out).exists():  # else one that was killed may have left the picture
        refuse_existing(picture)
    own = _frames(real, settings.frames)
    preset = {"preset": settings.preset}
    start = recipes.check(settings.preset, looks.filled(preset), looks.Settings)
    photos = open_backgrounds(settings.backgrounds)
    measured = measure_images(own)
    _refuse_nothing(real, own, measured)
    size_px = (own[0].shape[1], own[0].shape[0])
    there = sample_scenes(photos, start, size_px, settings.seed)
    *_, found = track(iter_fits(measured, start, there, settings.seed), "Fitting", ROUNDS)
    fresh = settings.seed + 1  # what the fit has not seen
    there = sample_scenes(photos, start, size_px, fresh)
    before, after = (list(simulate_images(way, there, fresh)) for way in (start, found))
    keys = _keys(found, start)
    _write(out, _recipe(settings.preset, keys), picture, make_contact_sheet([own, before, after]))
    middle = max(len(own) // 2, 1)
    parts = (own[:middle], own[-middle:]) if len(own) > 1 else ()
    wanted, got = measured.to_statistics(), measure_images(after).to_statistics()
    return Result(
        frames=len(own),
        real=wanted,
        halves=tuple(measure_images(part).to_statistics() for part in parts),
        preset=measure_images(before).to_statistics(),
        fitted=got,
        keys=keys,
        notes=_notes(real, own, wanted, got),
    )


def _refuse_nothing(real: Path, own: Sequence[Rgb], measured: ImageMeasurements) -> None:
    """Raise SettingError if frames are of two kinds, or none shows anything."""
    grey = sum(bool(np.ptp(rgb, axis=2).max() == 0) for rgb in own)
    if 0 < grey < len(own):
        raise SettingError(
            f"{real} holds {grey} grey frames and {len(own) - grey} with colours. Give frames of "
            "one camera alone"
        )
    if not measured.figure_values("contrast").max() > 0:
        level = measured.figure_mean("brightness") or 0.0
        raise SettingError(
            f"{real}: every frame is one plain colour, of brightness {level:.2f}: nothing to "
            "measure. Give frames in which something is seen"
        )


def _notes(
    real: Path, own: Sequence[Rgb], wanted: ImageStatistics, got: ImageStatistics
) -> list[str]:
    """Return a sentence for each limit of the frames or the fit."""
    notes = []
    if len(own) < FEW:
        frames = "frame" if len(own) == 1 else "frames"
        notes.append(f"{real} holds {len(own)} {frames}: few to know a camera by. {FEW} are better")
    white = float(np.mean([(rgb.min(axis=2) >= WHITE).mean() for rgb in own]))
    if white > MUCH_WHITE:
        notes.append(
            f"{white:.0%} of the pixels of {real} are white: overexposed, nothing is known there"
        )
    unknown = [WORDS[name] for name in FIGURES if getattr(wanted, name) is None]
    if unknown:
        notes.append(
            f"{real} does not show {', '.join(unknown)}: it is left as the preset has it. Frames "
            "with plain walls and sharp edges, neither black nor white, would show it"
        )
    off = {name: _apart(name, getattr(wanted, name), getattr(got, name))[0] for name in FIGURES}
    if far := [WORDS[name] for name in FIGURES if abs(off[name]) > FAR]:
        notes.append(
            f"the fit is off by more than a fifth in {', '.join(far)}: no range of the preset "
            "reaches it over these backgrounds. Photos nearer to the frames may: --backgrounds DIR"
        )
    return notes


def _write(out: Path, recipe: str, picture: Path, sheet: bytes) -> None:
    """Write the picture, then the recipe; an error leaves neither.

    A process that is killed between the two leaves the picture: the same picture is no obstacle.
    """
    there = picture.is_file() and picture.read_bytes() == sheet
    made = False
    try:
        with atomic_file(out) as partial:
            partial.write_text(recipe, encoding="utf-8")
            if not there:
                with atomic_file(picture) as beside:
                    beside.write_bytes(sheet)
                made = True
    except BaseException:
        if made:
            with suppress(OSError):
                picture.unlink()
        raise


def _frames(real: Path, most: int) -> list[Rgb]:
    """Read at most so many frames of a folder or recording, evenly spaced."""
    if real.is_dir():
        paths = [path for _, path in list_images(real, 10.0)]
        data = [(paths[k].read_bytes(), str(paths[k])) for k in even_indices(len(paths), most)]
    else:
        held = read_summary(real).topics
        topic = next((name for name in held if topics.parse_topic(topics.CAMERA_IMAGE, name)), None)
        if topic is None:
            raise RecordingError(f"{real} has no images. Give a folder of frames, or another")
        chosen, count = set(even_indices(held[topic].count, most)), held[topic].count
        stream = enumerate(islice(read(real, topic), count))
        data = [(bytes(s.message.data), f"{real}: image {k}") for k, s in stream if k in chosen]
    sizes = sorted({read_size(content, name)[:2] for content, name in data})
    if len(sizes) != 1:
        words = ", ".join(f"{width}x{height}" for width, height in sizes)
        raise SettingError(f"{real} holds frames of {words} px. Give frames of one camera alone")
    ((width, height),) = sizes
    if min(sizes[0]) < LEAST_PX or width * height > MOST_PX:
        small = min(sizes[0]) < LEAST_PX
        way = f"at least {LEAST_PX} px each way" if small else "1920x1080 at most, as flown"
        raise SettingError(
            f"{real}: frames of {width}x{height} px are too {'small' if small else 'large'} to "
            f"measure. Give frames of {way}"
        )
    few = even_indices(len(data), max(2, TOGETHER_PX // (width * height)))
    return [decode(*data[k]) for k in few]


def _keys(found: looks.Settings, start: looks.Settings) -> dict[str, object]:
    """Return the keys that the fit changed, for a recipe."""
    names = [*(knob.key for knob in KNOBS), "bayer", "jpeg_quality", "image_format"]
    changed = {name: getattr(found, name) for name in names}
    return {
        name: [_round_values(end) for end in value] if isinstance(value, tuple) else value
        for name, value in changed.items()
        if value != getattr(start, name)
    }


def _round_values(value: float) -> float:
    """Round to three significant digits."""
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


def _apart(name: str, first: float | None, second: float | None) -> tuple[float, str]:
    """Return the relative change, or the difference of small values, as number and text."""
    if first is None or second is None:
        return 0.0, "-"
    if abs(first) < (WHITE_NOISE if name == "grain_correlation" else SMALL):
        return second - first, f"{second - first:+.3f}"
    return second / first - 1, f"{second / first - 1:+.0%}"
