"""``dmrl render``: a recipe to a recording of rendered images with exact labels."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dmrl.errors import SettingError
from dmrl.pipeline.single_run import run_on_cluster
from dmrl.rendering.settings import Settings
from dmrl.rendering.settings import filled as filled
from dmrl.terminal.arguments import AsJson, Count, Flat, On, Recipe
from dmrl.terminal.progress import say
from dmrl.terminal.tables import print_json, print_table

if TYPE_CHECKING:
    from dmrl.render_recording import Rendered


def run(out: Path, settings: Settings, *, resume: bool = False) -> "Rendered":
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
        If the unfinished output was made with other settings.
    """
    from dmrl.render_recording import render_recording

    return render_recording(out, settings, resume=resume)


@dataclass(frozen=True, slots=True)
class Flags:
    """Settings of the recipe that a flag overrules.

    Parameters
    ----------
    images
        Images to render. Without it, as the recipe says, as with the options below.
    seed
        Another seed renders other images.
    workers
        Blender processes; 0: as many as there are cores. Does not affect the output.
    backgrounds
        What to put behind the robots: a folder of photos; rooms, which are made by code; or a
        dataset whose train images are put there, their robots painted over.
    cutouts
        Folder of photographs of your own robot, cut out, PNG with alpha, in place of a model.
    camera
        Calibration of the camera, a TOML file as dmrl calibrate writes, or aideck or published.
    model
        .blend, .glb, .obj or .stl of the robot.
    scale
        Metres per unit of the model; of the Crazyflie that dmrl draws, times life size.
    """

    images: Count | None = None
    seed: int | None = None
    workers: int | None = None
    backgrounds: Path | None = None
    cutouts: Path | None = None
    camera: Path | None = None
    model: Path | None = None
    scale: float | None = None


NO_FLAGS = Flags()


def command(
    recipe: Recipe | None = None,
    out: Path | None = None,
    /,
    *,
    flags: Flat[Flags] = NO_FLAGS,
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
    resume
        Go on with an interrupted OUT.
    setup
        Set up Blender, if it is not, and do nothing else if no recipe is given.
    preview
        Look at the robot first: OUT is a picture, NAME.png, of it from four sides, with its axes,
        its box and its size.
    """
    if setup:
        from dmrl.rendering.blender_environment import ensure_environment

        python = ensure_environment(say)
        if recipe is None:
            return print_json({"python": str(python)}) if as_json else say(f"Blender: {python}")
    if recipe is None or out is None:
        raise SettingError("render wants a recipe and an output. Try: dmrl render --help")
    from dmrl.render_recording import preview_robot, read_render_settings

    settings = read_render_settings(recipe, **asdict(flags))
    if preview and (on is not None or resume):
        raise SettingError("--preview is one picture, made here. Leave out --on and --resume")
    if preview:
        result: Mapping[str, object] = preview_robot(out, settings)
    elif on is not None:
        result = run_on_cluster(on, "render", out, {}, settings) or {}
    else:
        result = asdict(run(out, settings, resume=resume))
    rows = {name.replace("_", " "): value for name, value in result.items()}
    if as_json:
        return print_json({"picture" if preview else "recording": str(out), **rows})
    return print_table(str(out), ("what", "value"), list(rows.items()))
