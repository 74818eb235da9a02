"""Stages as functions: each does what the command of its name does, with the same settings.

Settings are the fields of the stage's ``Settings``, and are checked as a recipe's keys are. A
recording without a name for the output lives in a temporary folder as long as its object.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any, TypeAlias

from dmrl import recipe as recipes
from dmrl.api.data import Data, dataset
from dmrl.api.models import Model, load
from dmrl.api.recordings import PathLike, Recording
from dmrl.api.results import Result, judged
from dmrl.errors import SettingError
from dmrl.pipeline.stage_signature import interface_of

OneOrMore: TypeAlias = PathLike | Sequence[PathLike]


def label(recording: PathLike, out: PathLike | None = None, **settings: Any) -> Recording:
    """Positions of peers and labels of images, from ranges and odometry: ``dmrl label``.

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
        As the command says it.
    """
    return _recording("label", out, settings, recording=Path(recording))


def predict(
    model: PathLike, recording: PathLike, out: PathLike | None = None, **settings: Any
) -> Recording:
    """Detections of a network in every image of a recording: ``dmrl predict``.

    Parameters, errors as `label`; ``model`` as `dmrl.load` takes it.
    """
    given = {"model": Path(model), "recording": Path(recording)}
    return _recording("predict", out, settings, **given)


def track(recording: PathLike, out: PathLike | None = None, **settings: Any) -> Recording:
    """Detected peers followed over time: ``dmrl track``. Parameters, errors as `label`."""
    return _recording("track", out, settings, recording=Path(recording))


def align(recording: PathLike, out: PathLike | None = None, **settings: Any) -> Recording:
    """Clocks set by each other: ``dmrl align``. Parameters, errors as `label`."""
    return _recording("align", out, settings, recording=Path(recording))


def trim(recording: PathLike, out: PathLike | None = None, **settings: Any) -> Recording:
    """A stretch of a recording, or some topics: ``dmrl trim``. Parameters, errors as `label`."""
    return _recording("trim", out, settings, recording=Path(recording))


def merge(recordings: Sequence[PathLike], out: PathLike | None = None) -> Recording:
    """Recordings in one, by time: ``dmrl merge``. Errors as `label`."""
    named = _paths("merge", recordings)
    if len(named) < 2:
        raise SettingError("dmrl.merge wants two recordings or more. Name them in a list")
    return _recording("merge", out, {}, recordings=named)


def convert(source: PathLike, out: PathLike | None = None, **settings: Any) -> Recording:
    """A foreign file or folder as a recording: ``dmrl convert``. Parameters, errors as `label`."""
    return _recording("convert", out, settings, source=Path(source))


def fly(
    out: PathLike | None = None, *, recipe: PathLike | None = None, **settings: Any
) -> Recording:
    """A simulated flight: ``dmrl fly``.

    Parameters
    ----------
    out
        Recording to write. None: a temporary one.
    recipe
        TOML file, or the name of one that ships with dmrl; ``settings`` go before it.
    settings
        Fields of ``dmrl.stages.fly.Settings``.

    Raises
    ------
    DmrlError
        As the command says it.
    """
    return _recording("fly", out, _keys("fly", recipe) | settings)


def render(
    scene: PathLike = "synthetic_first_look", out: PathLike | None = None, **settings: Any
) -> Recording:
    """Images of robots with exact labels, by Blender: ``dmrl render``.

    Parameters
    ----------
    scene
        Recipe: a TOML file, or the name of one that ships with dmrl; ``settings`` go before it.
    out
        Recording to write. None: a temporary one.
    settings
        Fields of ``dmrl.rendering.settings.Settings``: ``images=200, seed=1``.

    Raises
    ------
    DmrlError
        As the command says it.
    """
    return _recording("render", out, _keys("render", scene) | settings)


def sketch(out: PathLike, **settings: Any) -> Path:
    """A folder of drawn pictures with exact labels: ``dmrl sketch``. Errors as `label`."""
    return _made("sketch", Path(out), settings)


def make_dataset(recordings: OneOrMore, out: PathLike, **settings: Any) -> Data:
    """A dataset of recordings, with its card: ``dmrl dataset``. Errors as `label`."""
    given = _paths("make_dataset", recordings)
    return dataset(_made("dataset", Path(out), settings, recordings=given))


def train(
    data: PathLike | Data,
    out: PathLike,
    *,
    recipe: PathLike | None = None,
    init: PathLike | None = None,
    **settings: Any,
) -> Model:
    """A network trained on a dataset: ``dmrl train``.

    Parameters
    ----------
    data
        A dataset, or its folder.
    out
        Run folder to write.
    recipe
        TOML file, or the name of one that ships with dmrl; ``settings`` go before it.
    init
        Model to start from.
    settings
        Fields of ``dmrl.learn.training.config.FitSettings``.

    Raises
    ------
    DmrlError
        As the command says it.
    """
    given = {"dataset": data.path if isinstance(data, Data) else Path(data)}
    if init is not None:
        given["init"] = Path(init)
    return load(_made("train", Path(out), _keys("train", recipe) | settings, **given))


def quantize(model: PathLike, data: PathLike | Data, out: PathLike, **settings: Any) -> Model:
    """An int8 network, with the float one beside it: ``dmrl quantize``. Errors as `label`."""
    images = data.path if isinstance(data, Data) else Path(data)
    return load(_made("quantize", Path(out), settings, model=Path(model), dataset=images))


def calibrate(sources: OneOrMore, out: PathLike, **settings: Any) -> Path:
    """A camera file from chessboards or flights: ``dmrl calibrate``. Errors as `label`."""
    return _made("calibrate", Path(out), settings, sources=_paths("calibrate", sources))


def evaluate(recordings: OneOrMore, **settings: Any) -> Result:
    """How good detections, tracks or positions are: ``dmrl evaluate``.

    Parameters
    ----------
    recordings
        One, or several whose detections are judged together.
    settings
        Fields of ``dmrl.stages.evaluate.Settings``.

    Returns
    -------
    Result
        Figures by name, as ``--json`` prints them; in a notebook, the table.

    Raises
    ------
    DmrlError
        As the command says it.
    """
    named = _paths("evaluate", recordings)
    return judged(named, _settings("evaluate", settings)["settings"])


def _keys(kind: str, name: PathLike | None) -> dict[str, Any]:
    """Keys of a recipe of this kind, but for the kind."""
    if name is None:
        return {}
    keys = recipes.read(Path(name))
    recipes.check_kind(str(name), keys, kind)
    return {key: value for key, value in keys.items() if key != "kind"}


def _paths(what: str, given: OneOrMore) -> list[Path]:
    """One file or folder, or several; never none."""
    several = [given] if isinstance(given, str | os.PathLike) else list(given)
    if not several:
        raise SettingError(f"dmrl.{what} was given an empty list. Name one file at least")
    return [Path(path) for path in several]


def _recording(
    stage: str, out: PathLike | None, settings: dict[str, Any], **given: Any
) -> Recording:
    """What a stage that writes a recording has written."""
    if out is not None:
        return Recording(_made(stage, Path(out), settings, **given))
    folder = Path(mkdtemp(prefix="dmrl-"))
    try:
        return Recording(_made(stage, folder / f"{stage}.mcap", settings, **given), folder)
    except BaseException:
        rmtree(folder)
        raise


def _made(stage: str, out: Path, settings: dict[str, Any], **given: Any) -> Path:
    """Run a stage; what it has written."""
    interface_of(stage).run(out=out, **given, **_settings(stage, settings))
    return out


def _settings(stage: str, keys: dict[str, Any]) -> dict[str, Any]:
    """The argument ``settings`` of a stage, where it has one."""
    face = interface_of(stage)
    if face.settings is None:
        return {}
    checked = recipes.check(f"dmrl.{stage}", face.filled(recipes.plain(keys)), face.settings)
    return {"settings": checked}
