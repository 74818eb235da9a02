"""Render the images of a recipe, with exact labels, into a recording."""

import json
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from dmrl import recipe as recipes
from dmrl import topics
from dmrl.atomic_output import atomic_file, refuse_existing
from dmrl.datasets.backgrounds import open_backgrounds
from dmrl.errors import OutputError, RecipeError
from dmrl.geometry.camera_file import NAMED_CAMERAS, find_camera
from dmrl.geometry.frames import Camera
from dmrl.guards.memory import keep_freed_memory
from dmrl.recording import (
    LICENCES_METADATA,
    SPLIT_METADATA,
    Provenance,
    RecordingWriter,
    build_provenance,
    extract_licence_title,
    find_licence_file,
    iter_columns,
    recover_interrupted,
)
from dmrl.rendering.backgrounds.rooms import ROOMS
from dmrl.rendering.blender_environment import ensure_environment
from dmrl.rendering.camera.distortion import pinhole_canvas
from dmrl.rendering.cutouts import CutoutRenderer, open_cutouts
from dmrl.rendering.image_messages import OBSERVER, build_samples
from dmrl.rendering.randomise import RandomScene, SceneSource, draw_scene
from dmrl.rendering.renderer import Renderer, RobotModel, Scene, list_panoramas
from dmrl.rendering.robots.robot_models import DESIGNS
from dmrl.rendering.settings import Settings, filled
from dmrl.samples.sample import build_calibration, find_intervals
from dmrl.terminal.progress import say, track

KEPT_BYTES = 64 << 20
"""Freed bytes that the process keeps. An image's arrays would fault in their pages again."""
PREVIEW_SAMPLES = 64
"""Samples of a pixel of a preview."""


@dataclass(frozen=True, slots=True)
class Rendered:
    """Numbers of images, labels, images without a label, broken photos and resumed images."""

    images: int
    labels: int
    empty_images: int
    broken_photos: int
    resumed_images: int


def read_render_settings(name: str, **changes: Any) -> Settings:
    """Read the settings of a recipe, over those of its preset.

    Parameters
    ----------
    name
        Path, or the name of a shipped recipe.
    changes
        Settings that come before the recipe's; None: the recipe's.

    Raises
    ------
    RecipeError
        If the recipe is not one of kind "render", or any key is wrong: names every one.
    """
    keys = recipes.read(name)
    if (kind := keys.pop("kind", None)) != "render":
        raise RecipeError(f'{name} is of kind {kind!r}. This command wants: kind = "render"')
    given = {key: value for key, value in changes.items() if value is not None}
    return recipes.check(name, filled({**keys, **given}), Settings)


def read_render_camera(settings: Settings) -> Camera:
    """Read the camera of the images: level with its robot, without delay.

    Raises
    ------
    SourceError
        If its file cannot be read.
    SettingError
        If its lens does not fill the image.
    """
    camera = find_camera(settings.camera)
    distortion = camera.distortion if settings.distorted else ()
    camera = replace(camera, distortion=distortion, mount_rad=(0.0, 0.0, 0.0), delay_s=0.0)
    pinhole_canvas(camera)  # an error comes now rather than after the first image
    return camera


def render_recording(out: Path, settings: Settings, *, resume: bool = False) -> Rendered:
    """Render and write the recording ``out``, as images arrive; see ``dmrl.stages.render.run``."""
    refuse_existing(out)
    keep_freed_memory(KEPT_BYTES)
    before = recover_interrupted(out, resume=resume, has_images=True)
    camera = read_render_camera(settings)
    photos = None if settings.backgrounds is None else open_backgrounds(settings.backgrounds)
    with ExitStack() as stack:
        renderer = _open_renderer(settings)
        if isinstance(renderer, Renderer):
            stack.enter_context(renderer)
        made = _describe(settings, renderer.version)
        before.check_provenance(made)
        sink = stack.enter_context(RecordingWriter(out, made, keep_on_error=True))
        sink.add_metadata(SPLIT_METADATA, _assign_splits(settings))
        if beside := _read_licences(settings):
            sink.add_metadata(LICENCES_METADATA, beside)
        done = before.copy_into(sink)
        world = SceneSource(
            settings,
            camera,
            renderer.radius_m,
            tuple(renderer.lights),
            cache(renderer.load_panorama),
            photos,
            DESIGNS[settings.design],
        )
        _write_images(world, renderer, sink, done)
    before.delete_file()
    broken = photos.broken if photos is not None else 0
    return Rendered(settings.images, *_count_labels(out), broken, done)


def _open_renderer(settings: Settings) -> Renderer | CutoutRenderer:
    """Read the settings' cut-outs, or start Blender with their robot and panoramas."""
    if settings.cutouts is not None:
        found = open_cutouts(settings.cutouts)
        tilt = settings.robot_tilt_max_deg
        return CutoutRenderer(found, settings.cutout_width_m, tilt, matched=settings.pasted)
    return _open_blender(settings)


def _open_blender(settings: Settings) -> Renderer:
    """Start Blender with the settings' robot and panoramas."""
    lights = None if settings.lights is None else list_panoramas(settings.lights)
    design = DESIGNS[settings.design]
    model = RobotModel(
        settings.model, settings.scale, settings.model_up, settings.model_centre, design
    )
    return Renderer(
        ensure_environment(say),
        model,
        lights=lights,
        workers=settings.workers,
        samples=settings.samples,
    )


def preview_robot(out: Path, settings: Settings) -> dict[str, float]:
    """Draw the robot alone, with its axes, its box and its size, as labels measure it.

    Parameters
    ----------
    out
        PNG to write. Must not exist.
    settings
        See `Settings`: robot, its scale, axis, centre, and the camera.

    Returns
    -------
    dict
        Size along x, y and z, metres, and how many pixels wide the robot is 1 m before the camera.

    Raises
    ------
    OutputError
        If ``out`` exists, or is not named .png.
    SettingError
        If model or scale cannot be used.
    SourceError
        If the camera's file cannot be read.
    BlenderError
        If Blender cannot be set up, or does not start.
    """
    refuse_existing(out)
    if out.suffix.lower() != ".png":
        raise OutputError(f"{out} is not named .png. With --preview OUT is a picture: NAME.png")
    from dmrl.rendering.robot_preview import render_preview  # noqa: PLC0415 - an extra

    with _open_blender(replace(settings, workers=1, samples=PREVIEW_SAMPLES)) as renderer:
        seen = render_preview(renderer, settings, read_render_camera(settings))
    with atomic_file(out) as partial:
        partial.write_bytes(seen.png)
    sizes = {f"{axis}_m": round(size, 4) for axis, size in zip("xyz", seen.size_m, strict=True)}
    return {**sizes, "px_wide_at_1_m": round(seen.px_wide_at_1_m, 1)}


def _count_labels(out: Path) -> tuple[int, int]:
    """Return the number of labels, and of images without, of a recording."""
    numbers = [
        len(peers)
        for batch in iter_columns(out, topics.LABELS(OBSERVER), fields=["peers"])
        for peers in batch["peers"].to_pylist()
    ]
    return sum(numbers), numbers.count(0)


def _describe(settings: Settings, blender: str) -> Provenance:
    """Return the provenance; the number of workers changes nothing, so it is left out."""
    inputs = _list_sources(settings)
    if str(settings.camera) not in NAMED_CAMERAS:
        inputs.append(settings.camera)
    plain = replace(settings, workers=0)
    libraries = ("numpy", "pillow")
    made = build_provenance("render", plain, inputs, seed=settings.seed, libraries=libraries)
    return replace(made, libraries={**made.libraries, "blender": blender})


def _list_sources(settings: Settings) -> list[Path]:
    """Return the files and folders that the images are made from."""
    named = (settings.model, settings.cutouts, settings.backgrounds, settings.lights)
    return [path for path in named if path is not None and str(path) != ROOMS]


def _read_licences(settings: Settings) -> dict[str, str]:
    """Read the licences beside photos, panoramas and model: they hold for the images too."""
    found = {path.name: find_licence_file(path) for path in _list_sources(settings)}
    return {name: extract_licence_title(path) for name, path in found.items() if path is not None}


def _assign_splits(settings: Settings) -> dict[str, str]:
    first_test = settings.images - round(settings.images * settings.test_share)
    times = (_time_ns(settings, k) for k in range(settings.images))
    found = find_intervals((t, "test" if k >= first_test else "train") for k, t in enumerate(times))
    return {name: json.dumps(parts) for name, parts in found.items()}


def _time_ns(settings: Settings, index: int) -> int:
    return round(index * 1e9 / settings.rate_hz)


def _write_images(
    world: SceneSource, renderer: Renderer | CutoutRenderer, sink: RecordingWriter, done: int
) -> None:
    """Write every image from number ``done`` on, in order, as it arrives."""
    settings, camera = world.settings, world.camera
    if not done:
        sink.write_sample(build_calibration(0, OBSERVER, camera))
    drawn: deque[RandomScene] = deque()

    def scenes() -> Iterator[Scene]:
        for index in range(done, settings.images):
            drawn.append(draw_scene(world, index))
            yield camera, drawn[-1].robots, drawn[-1].look

    shots = track(renderer.render_shots(scenes()), "Rendering", settings.images - done)
    for index, shot in enumerate(shots, done):
        for sample in build_samples(_time_ns(settings, index), settings, drawn.popleft(), shot):
            sink.write_sample(sample)
