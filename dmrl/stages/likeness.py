"""``dmrl likeness``: a render recipe fitted to the images of a camera."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from dmrl.pipeline.stage_command import stage_command
from dmrl.simulation.settings import LikenessSettings as Settings
from dmrl.terminal.closing import Closing, Given

if TYPE_CHECKING:
    from dmrl.simulation.camera_likeness import Result


def run(
    real: Path, out: Annotated[Path, Parameter(name="OUT.toml")], settings: Settings
) -> "Result":
    """Fit a render recipe to your own frames, and show both side by side.

    Parameters
    ----------
    real
        Folder of frames as the camera stores them, or a recording with images.
    out
        Recipe to write. A picture of the same name, .png, shows two rows of real frames, two of
        the preset's pictures, two of the recipe's.
    settings
        See `Settings`.

    Raises
    ------
    SourceError
        If there is no picture, or one cannot be decoded.
    RecordingError
        If a recording cannot be read, or has no images.
    SettingError
        If the frames are not of one size and kind, too small or too large, or show nothing; if
        the backgrounds cannot be used.
    RecipeError
        If there is no such preset.
    OutputError
        If the recipe or the picture exists.
    """
    from dmrl.simulation.camera_likeness import fit_preset

    return fit_preset(real, out, settings)


def _document(result: "Result", given: Given) -> dict[str, Any]:
    picture = given.out.with_suffix(".png")
    return {"recipe": str(given.out), "picture": str(picture), **asdict(result)}


command = stage_command(
    run,
    Closing(
        show=lambda result, given: result.print(given.out, given.settings.preset),
        document=_document,
    ),
    warnings=lambda result, _: result.notes,
)
