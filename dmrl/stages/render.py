"""``dmrl render``: a recipe to a recording of rendered images with exact labels."""

import json
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter, validators

from dmrl import recipe as recipes
from dmrl import topics
from dmrl.atomic_output import partial_file, refuse_existing
from dmrl.datasets.backgrounds import photos_of
from dmrl.errors import OutputError, RecipeError, SettingError
from dmrl.geometry.camera_file import KNOWN, camera_named
from dmrl.geometry.frames import Camera
from dmrl.messages import message
from dmrl.pipeline.single_run import done_on
from dmrl.recording import (
    LICENCES_METADATA,
    SPLIT_METADATA,
    Provenance,
    RecordingWriter,
    columns,
    interrupted,
    licence_beside,
    licence_words,
    provenance,
)
from dmrl.rendering.backgrounds.rooms import ROOMS
from dmrl.rendering.blender_environment import ensure
from dmrl.rendering.camera.distortion import canvas_of
from dmrl.rendering.image_messages import ROBOT, samples
from dmrl.rendering.randomise import Drawn, World, draw_scene
from dmrl.rendering.renderer import Model, Renderer, Scene, panoramas_in
from dmrl.rendering.robots.robot_models import DESIGNS
from dmrl.rendering.settings import Settings, filled
from dmrl.samples.sample import Sample, calibration, intervals
from dmrl.terminal.arguments import AsJson, On
from dmrl.terminal.progress import say, track
from dmrl.terminal.tables import print_json, print_table

PREVIEW_SAMPLES = 64

Count = Annotated[int, Parameter(validator=validators.Number(gte=1))]


@dataclass(frozen=True, slots=True)
class Result:
    """What was rendered: images, labels in them, images without, broken photos left out."""

    images: int
    labels: int
    empty_images: int
    broken_photos: int
    resumed_images: int


def settings_of(name: str, **changes: Any) -> Settings:
    """Settings of a recipe, over those of its preset.

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


def camera_of(settings: Settings) -> Camera:
    """The camera that the images are taken with: level with its robot, its clock exact.

    Raises
    ------
    SourceError
        If its file cannot be read.
    SettingError
        If its lens does not fill the image.
    """
    camera = camera_named(settings.camera)
    distortion = camera.distortion if settings.distorted else ()
    camera = replace(camera, distortion=distortion, mount_rad=(0.0, 0.0, 0.0), delay_s=0.0)
    canvas_of(camera)  # Says so now rather than after the first image.
    return camera


def run(out: Path, settings: Settings, *, resume: bool = False) -> Result:
    """Render and write the recording ``out``, as images arrive.

    Parameters
    ----------
    out
        Recording to write. Until it is done it is ``<out>.partial``.
    settings
        See `Settings`.
    resume
        Go on with the interrupted ``<out>.partial``; the result is the same, byte for byte.

    Raises
    ------
    OutputError
        If ``out`` exists, or an interrupted rendering is in the way.
    SettingError
        If model, scale, backgrounds or the camera's lens cannot be used.
    SourceError
        If the camera's file cannot be read.
    BlenderError
        If Blender cannot be set up, or does not start.
    RecordingError
        If what is to be resumed is of other settings.
    """
    refuse_existing(out)
    before = interrupted(out, resume=resume, pictured=True)
    camera = camera_of(settings)
    photos = None if settings.backgrounds is None else photos_of(settings.backgrounds)
    with ExitStack() as stack:
        renderer = stack.enter_context(_renderer(settings))
        made = _provenance(settings, renderer.version)
        before.check(made)
        sink = stack.enter_context(RecordingWriter(out, made, keep_on_error=True))
        sink.add_metadata(SPLIT_METADATA, _split(settings))
        if beside := _licences(settings):
            sink.add_metadata(LICENCES_METADATA, beside)
        done = before.copy(sink)
        world = World(
            settings,
            camera,
            renderer.radius_m,
            tuple(renderer.lights),
            cache(renderer.panorama),
            photos,
            DESIGNS[settings.design],
        )
        _render(world, renderer, sink, done)
    before.forget()
    broken = photos.broken if photos is not None else 0
    return Result(settings.images, *_counts(out), broken, done)


def _renderer(settings: Settings) -> Renderer:
    """Blender with the settings' robot and panoramas."""
    lights = None if settings.lights is None else panoramas_in(settings.lights)
    design = DESIGNS[settings.design]
    model = Model(settings.model, settings.scale, settings.model_up, settings.model_centre, design)
    return Renderer(
        ensure(say), model, lights=lights, workers=settings.workers, samples=settings.samples
    )


def look_at(out: Path, settings: Settings) -> dict[str, float]:
    """Picture of the robot alone, with its axes, its box and its size: what labels are about.

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
    from dmrl.rendering.robot_preview import preview  # noqa: PLC0415 - an extra

    with _renderer(replace(settings, workers=1, samples=PREVIEW_SAMPLES)) as renderer:
        seen = preview(renderer, settings, camera_of(settings))
    with partial_file(out) as partial:
        partial.write_bytes(seen.png)
    sizes = {f"{axis}_m": round(size, 4) for axis, size in zip("xyz", seen.size_m, strict=True)}
    return {**sizes, "px_wide_at_1_m": round(seen.px_wide_at_1_m, 1)}


def _counts(out: Path) -> tuple[int, int]:
    """Labels, and images without, of a recording."""
    numbers = [
        len(peers)
        for batch in columns(out, topics.labels(ROBOT), fields=["peers"])
        for peers in batch["peers"].to_pylist()
    ]
    return sum(numbers), numbers.count(0)


def _provenance(settings: Settings, blender: str) -> Provenance:
    """How the recording is made; the number of workers changes nothing, so it is left out."""
    inputs = _made_from(settings)
    if str(settings.camera) not in KNOWN:
        inputs.append(settings.camera)
    plain = replace(settings, workers=0)
    made = provenance("render", plain, inputs, seed=settings.seed, libraries=("numpy", "pillow"))
    return replace(made, libraries={**made.libraries, "blender": blender})


def _made_from(settings: Settings) -> list[Path]:
    """Files and folders that the images are made from."""
    named = (settings.model, settings.backgrounds, settings.lights)
    return [path for path in named if path is not None and str(path) != ROOMS]


def _licences(settings: Settings) -> dict[str, str]:
    """What is said beside photos, panoramas and model: it holds for the images too."""
    found = {path.name: licence_beside(path) for path in _made_from(settings)}
    return {name: licence_words(path) for name, path in found.items() if path is not None}


def _split(settings: Settings) -> dict[str, str]:
    first_test = settings.images - round(settings.images * settings.test_share)
    times = (_time_ns(settings, k) for k in range(settings.images))
    found = intervals((t, "test" if k >= first_test else "train") for k, t in enumerate(times))
    return {name: json.dumps(parts) for name, parts in found.items()}


def _time_ns(settings: Settings, index: int) -> int:
    return round(index * 1e9 / settings.rate_hz)


def _render(world: World, renderer: Renderer, sink: RecordingWriter, done: int) -> None:
    """Write every image from number ``done`` on, in order, as it arrives."""
    settings, camera = world.settings, world.camera
    if not done:
        _write(sink, calibration(0, ROBOT, camera))
    drawn: deque[Drawn] = deque()

    def scenes() -> Iterator[Scene]:
        for index in range(done, settings.images):
            drawn.append(draw_scene(world, index))
            yield camera, drawn[-1].robots, drawn[-1].look

    shots = track(renderer.shots(scenes()), "Rendering", settings.images - done)
    for index, shot in enumerate(shots, done):
        for sample in samples(_time_ns(settings, index), settings, drawn.popleft(), shot):
            _write(sink, sample)


def _write(sink: RecordingWriter, sample: Sample) -> None:
    sink.write(sample.time_ns, sample.topic, message(sample.message)(**sample.fields))


def command(
    recipe: str | None = None,
    out: Path | None = None,
    /,
    *,
    images: Count | None = None,
    seed: int | None = None,
    workers: int | None = None,
    backgrounds: Path | None = None,
    camera: Path | None = None,
    model: Path | None = None,
    scale: float | None = None,
    resume: Annotated[bool, Parameter(negative=())] = False,
    setup: Annotated[bool, Parameter(negative=())] = False,
    preview: Annotated[bool, Parameter(negative=())] = False,
    on: On = None,
    as_json: AsJson = False,
) -> None:
    """Render images of robots with exact labels, as a recipe says, into a recording.

    Parameters
    ----------
    recipe
        A TOML file, or the name of a shipped recipe, such as synthetic_first_look.
    out
        Recording to write, or with --preview a picture. Must not exist.
    images
        Images to render. Without it, as the recipe says; so for all that follow.
    seed
        Another seed renders other images.
    workers
        Blender processes; 0: as many as there are cores. Changes no byte of the output.
    backgrounds
        What to put behind the robots: a folder of photos; rooms, which are made by code; or a
        dataset whose train images are put there, their robots painted over.
    camera
        Calibration of the camera, a TOML file as dmrl calibrate writes, or aideck or published.
    model
        .blend, .glb, .obj or .stl of the robot.
    scale
        Metres per unit of the model; of the Crazyflie that dmrl draws, times life size.
    resume
        Go on with an interrupted OUT.
    setup
        Set up Blender, if it is not, and do nothing else if no recipe is given.
    preview
        Look at the robot first: OUT is a picture, NAME.png, of it from four sides, with its axes,
        its box and its size.
    as_json
        Print one JSON document in place of the table.
    """
    if setup:
        python = ensure(say)
        if recipe is None:
            return print_json({"python": str(python)}) if as_json else say(f"Blender: {python}")
    if recipe is None or out is None:
        raise SettingError("render wants a recipe and an output. Try: dmrl render --help")
    settings = settings_of(
        recipe,
        images=images,
        seed=seed,
        workers=workers,
        backgrounds=backgrounds,
        camera=camera,
        model=model,
        scale=scale,
    )
    if preview:
        if on is not None or resume:
            raise SettingError("--preview is one picture, made here. Leave out --on and --resume")
        return _print("picture", out, look_at(out, settings), as_json)
    if on is not None:
        return _print("recording", out, done_on(on, "render", out, {}, settings) or {}, as_json)
    return _print("recording", out, asdict(run(out, settings, resume=resume)), as_json)


def _print(kind: str, out: Path, result: Mapping[str, object], as_json: bool) -> None:
    rows = {name.replace("_", " "): value for name, value in result.items()}
    if as_json:
        return print_json({kind: str(out), **rows})
    return print_table(str(out), ("what", "value"), list(rows.items()))
