"""Stages as functions, with the settings of the commands of the same names.

Settings are the fields of the stage's ``Settings``, and are checked as a recipe's keys are. A
recording without a name for the output lives in a temporary folder as long as its object.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Any, TypeAlias

from dmrl import recipe as recipes
from dmrl.api.data import Data, dataset
from dmrl.api.models import Model, load
from dmrl.api.recordings import PathLike, Recording
from dmrl.api.results import Result, evaluate_recordings
from dmrl.errors import SettingError
from dmrl.guards.numeric_threads import one_blas_thread
from dmrl.pipeline.stage_signature import signature_of
from dmrl.storage import to_path
from dmrl.terminal.left_out import count_left_out

if TYPE_CHECKING:
    from typing import Unpack

    from dmrl.api import settings as typed

OneOrMore: TypeAlias = PathLike | Sequence[PathLike]


def label(
    recording: PathLike, out: PathLike | None = None, **settings: "Unpack[typed.LabelSettings]"
) -> Recording:
    """Estimate positions of peers and label the images: ``dmrl label``.

    Parameters
    ----------
    recording
        With attitude, velocity, height and ranges of two robots or more.
    out
        Recording to write. None: a temporary one.
    settings
        Fields of ``dmrl.stages.label.Settings``.

    Raises
    ------
    DmrlError
        As the command.
    """
    return _run_to_recording("label", out, settings, recording=to_path(recording))


def predict(
    model: PathLike,
    recording: PathLike,
    out: PathLike | None = None,
    **settings: "Unpack[typed.PredictSettings]",
) -> Recording:
    """Run a network on every image of a recording: ``dmrl predict``.

    Parameters, errors as `label`; ``model`` as `dmrl.load` takes it.
    """
    given = {"model": to_path(model), "recording": to_path(recording)}
    return _run_to_recording("predict", out, settings, **given)


def track(
    recording: PathLike, out: PathLike | None = None, **settings: "Unpack[typed.TrackSettings]"
) -> Recording:
    """Track detected peers over time: ``dmrl track``. Parameters, errors as `label`."""
    return _run_to_recording("track", out, settings, recording=to_path(recording))


def align(
    recording: PathLike, out: PathLike | None = None, **settings: "Unpack[typed.AlignSettings]"
) -> Recording:
    """Align the clocks of robots and cameras: ``dmrl align``. Parameters, errors as `label`."""
    return _run_to_recording("align", out, settings, recording=to_path(recording))


def trim(
    recording: PathLike, out: PathLike | None = None, **settings: "Unpack[typed.TrimSettings]"
) -> Recording:
    """Copy a part of a recording, or some topics: ``dmrl trim``. Parameters, errors as `label`."""
    return _run_to_recording("trim", out, settings, recording=to_path(recording))


def merge(recordings: Sequence[PathLike], out: PathLike | None = None) -> Recording:
    """Merge recordings by time: ``dmrl merge``. Errors as `label`."""
    named = _to_paths("merge", recordings)
    if len(named) < 2:
        raise SettingError("dmrl.merge wants two recordings or more. Name them in a list")
    return _run_to_recording("merge", out, {}, recordings=named)


def convert(
    source: PathLike, out: PathLike | None = None, **settings: "Unpack[typed.ConvertSettings]"
) -> Recording:
    """Convert a foreign file or folder: ``dmrl convert``. Parameters, errors as `label`.

    ``to``, which writes a folder, is an option of ``dmrl.stages.convert.run``.
    """
    if to := settings.get("to"):
        raise SettingError(
            f"dmrl.convert makes recordings, not {to}. Use dmrl.stages.convert.run, or: dmrl "
            f"convert SOURCE OUT --to {to}"
        )
    return _run_to_recording("convert", out, settings, source=to_path(source))


def fly(
    out: PathLike | None = None,
    *,
    recipe: PathLike | None = None,
    **settings: "Unpack[typed.FlySettings]",
) -> Recording:
    """Simulate a flight: ``dmrl fly``.

    Parameters
    ----------
    out
        Recording to write. None: a temporary one.
    recipe
        TOML file, or the name of one that ships with dmrl; ``settings`` override it.
    settings
        Fields of ``dmrl.stages.fly.Settings``.

    Raises
    ------
    DmrlError
        As the command.
    """
    return _run_to_recording("fly", out, _recipe_keys("fly", recipe) | settings)


def render(
    scene: PathLike = "synthetic_first_look",
    out: PathLike | None = None,
    **settings: "Unpack[typed.RenderSettings]",
) -> Recording:
    """Render images of robots with exact labels, by Blender: ``dmrl render``.

    Parameters
    ----------
    scene
        Recipe: a TOML file, or the name of one that ships with dmrl; ``settings`` override it.
    out
        Recording to write. None: a temporary one.
    settings
        Fields of ``dmrl.rendering.settings.Settings``: ``images=200, seed=1``.

    Raises
    ------
    DmrlError
        As the command.
    """
    return _run_to_recording("render", out, _recipe_keys("render", scene) | settings)


def sketch(out: PathLike, **settings: "Unpack[typed.SketchSettings]") -> Path:
    """Draw a folder of images with exact labels: ``dmrl sketch``. Errors as `label`."""
    return _run_to_path("sketch", to_path(out), settings)


def make_dataset(
    recordings: OneOrMore, out: PathLike, **settings: "Unpack[typed.DatasetSettings]"
) -> Data:
    """Build a dataset with its card: ``dmrl dataset``. Errors as `label`."""
    given = _to_paths("make_dataset", recordings)
    return dataset(_run_to_path("dataset", to_path(out), settings, recordings=given))


def train(
    data: PathLike | Data,
    out: PathLike,
    *,
    recipe: PathLike | None = None,
    init: PathLike | None = None,
    **settings: "Unpack[typed.TrainSettings]",
) -> Model:
    """Train a network on a dataset: ``dmrl train``.

    Parameters
    ----------
    data
        A dataset, or its folder.
    out
        Run folder to write.
    recipe
        TOML file, or the name of one that ships with dmrl; ``settings`` override it.
    init
        Model to start from.
    settings
        Fields of ``dmrl.learn.training.config.FitSettings``.

    Raises
    ------
    DmrlError
        As the command.
    """
    given = {"dataset": data.path if isinstance(data, Data) else to_path(data)}
    if init is not None:
        given["init"] = to_path(init)
    return load(
        _run_to_path("train", to_path(out), _recipe_keys("train", recipe) | settings, **given)
    )


def quantize(
    model: PathLike,
    data: PathLike | Data,
    out: PathLike,
    **settings: "Unpack[typed.QuantizeSettings]",
) -> Model:
    """Quantize a network to int8: ``dmrl quantize``. Errors as `label`."""
    images = data.path if isinstance(data, Data) else to_path(data)
    return load(
        _run_to_path("quantize", to_path(out), settings, model=to_path(model), dataset=images)
    )


def calibrate(
    sources: OneOrMore, out: PathLike, **settings: "Unpack[typed.CalibrateSettings]"
) -> Path:
    """Calibrate a camera by chessboards or flights: ``dmrl calibrate``. Errors as `label`."""
    given = _to_paths("calibrate", sources)
    return _run_to_path("calibrate", to_path(out), settings, sources=given)


def evaluate(recordings: OneOrMore, **settings: "Unpack[typed.EvaluateSettings]") -> Result:
    """Evaluate detections, tracks or positions: ``dmrl evaluate``.

    Parameters
    ----------
    recordings
        One, or several whose detections are evaluated together.
    settings
        Fields of ``dmrl.stages.evaluate.Settings``.

    Returns
    -------
    Result
        Figures by name, as ``--json`` prints them; in a notebook, the table.

    Raises
    ------
    DmrlError
        As the command.
    """
    named = _to_paths("evaluate", recordings)
    return evaluate_recordings(named, _check_settings("evaluate", settings)["settings"])


def _recipe_keys(kind: str, name: PathLike | None) -> dict[str, Any]:
    """Return the keys of a recipe of this kind, without the kind."""
    if name is None:
        return {}
    keys = recipes.read(to_path(name))
    recipes.check_kind(str(name), keys, kind)
    return {key: value for key, value in keys.items() if key != "kind"}


def _to_paths(what: str, given: OneOrMore) -> list[Path]:
    """Return one path or several as a list. Raise SettingError if there is none."""
    several = [given] if isinstance(given, str | os.PathLike) else list(given)
    if not several:
        raise SettingError(f"dmrl.{what} was given an empty list. Name one file at least")
    return [to_path(path) for path in several]


def _run_to_recording(
    stage: str, out: PathLike | None, settings: Mapping[str, Any], **given: Any
) -> Recording:
    """Run a stage that writes a recording, and return it."""
    if out is not None:
        return Recording(_run_to_path(stage, to_path(out), settings, **given))
    folder = Path(mkdtemp(prefix="dmrl-"))
    try:
        return Recording(_run_to_path(stage, folder / f"{stage}.mcap", settings, **given), folder)
    except BaseException:
        rmtree(folder)
        raise


def _run_to_path(stage: str, out: Path, settings: Mapping[str, Any], **given: Any) -> Path:
    """Run a stage, and return the path that it wrote."""
    checked = _check_settings(stage, settings)
    strict = getattr(checked.get("settings"), "strict", False)
    with one_blas_thread(), count_left_out(strict=strict):
        signature_of(stage).run(out=out, **given, **checked)
    return out


def _check_settings(stage: str, keys: Mapping[str, Any]) -> dict[str, Any]:
    """Return the argument ``settings`` of a stage, checked, if it has one."""
    face = signature_of(stage)
    if face.settings is None:
        return {}
    checked = recipes.check(
        f"dmrl.{stage}", face.filled(recipes.to_json_values(keys)), face.settings
    )
    return {"settings": checked}
