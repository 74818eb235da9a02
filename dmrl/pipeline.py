"""Pipelines: every stage of a recipe, in order, each output whole before the next begins.

A stage is done when its output stands under its final name, which no stage gives to half
an output; so a pipeline that was stopped goes on where it was.
"""

import time
from importlib import import_module
from pathlib import Path
from typing import Any

from dmrl import recipe as recipes
from dmrl.errors import DmrlError, RecipeError, SettingError
from dmrl.evaluation.report import Done
from dmrl.output import partial_of
from dmrl.recipe import Pipeline, Step
from dmrl.terminal.progress import say

# Stages that a step may name, and how many inputs each takes; None: a list of any length.
# They are loaded by name, because stages stand above this module and not below it.
STAGES: dict[str, int | None] = {
    "render": 0,
    "sketch": 0,
    "fly": 0,
    "convert": 1,
    "label": 1,
    "merge": None,
    "dataset": None,
    "train": 1,
    "predict": 2,
    "evaluate": None,
    "quantize": 2,
    "export": 1,
    "view": None,
}
# What one more input is, where a stage takes one.
ONE_MORE = {"train": "init"}
# These go on with what a killed run has left.
RESUMABLE = ("train", "render")
RECIPE_FILE, DATA_FILE = "recipe.toml", "data.txt"


def run(name: str | Path, out: Path, data: Path | None = None) -> list[Done]:
    """Run what is not done yet of a pipeline recipe.

    Parameters
    ----------
    name
        Path of a recipe, or the name of a shipped one.
    out
        Folder for all outputs; made if it is not there.
    data
        Folder that ``{data}`` in the recipe stands for.

    Raises
    ------
    RecipeError
        If the recipe is wrong; before anything is done.
    SettingError
        If the recipe needs ``data`` and has none, or ``out`` belongs to another recipe or data.
    DmrlError
        What a stage raises.
    """
    pipeline = recipes.load_pipeline(name, STAGES, settings_of)
    if pipeline.needs_data and data is None:
        raise SettingError(f"{name} reads data that does not ship with dmrl. Say where: --data DIR")
    _check_order(name, pipeline)
    _claim(out, pipeline, data if pipeline.needs_data else None)
    return [
        _do(step, out, data, f"[{k}/{len(pipeline.steps)}]")
        for k, step in enumerate(pipeline.steps, start=1)
    ]


def settings_of(stage: str) -> type[Any]:
    """The settings dataclass of a stage."""
    settings: type[Any] = _module(stage).Settings
    return settings


def _module(stage: str) -> Any:
    return import_module(f"dmrl.stages.{stage}")


def _check_order(name: str | Path, pipeline: Pipeline) -> None:
    """Refuse a step that reads what no earlier step writes, and outputs given twice."""
    made: set[str] = set()
    for number, step in enumerate(pipeline.steps, start=1):
        if wrong := _wrong_inputs(step):
            raise RecipeError(f"{name}: step {number} {wrong}. See: dmrl {step.stage} --help")
        for source in step.inputs:
            if not source.startswith("{data}") and source.split("/")[0] not in made:
                raise RecipeError(
                    f"{name}: step {number} ({step.stage}) reads {source}, which no step before "
                    "it writes. Name an earlier step's out, or {data}/..."
                )
        if step.out in made:
            raise RecipeError(f"{name}: step {number} writes {step.out} again. Name another out")
        made.add(step.out)


def _wrong_inputs(step: Step) -> str:
    """What is wrong with the number of a step's inputs; empty: nothing."""
    count, wants = len(step.inputs), STAGES[step.stage]
    if wants is None:
        right, words = count > 0, "one or more"
    else:
        counts = (wants, wants + 1) if step.stage in ONE_MORE else (wants,)
        right, words = count in counts, " or ".join(map(str, counts))
    return "" if right else f"({step.stage}) has {count} inputs, not {words}"


def _claim(out: Path, pipeline: Pipeline, data: Path | None) -> None:
    """Make ``out`` the folder of this recipe and its data, or see that it is."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise SettingError(f"{out} is a file. Name a folder: --out DIR") from None
    known = out / RECIPE_FILE
    if known.exists() and known.read_text(encoding="utf-8") != pipeline.text:
        raise SettingError(
            f"{out} was made by another recipe. Remove it or name another: --out DIR"
        )
    if not known.exists() and any(out.iterdir()):
        raise SettingError(f"{out} is not empty. Remove it or name another: --out DIR")
    known.write_text(pipeline.text, encoding="utf-8")
    if data is None:
        return
    whence, here = out / DATA_FILE, str(data.resolve())
    before = whence.read_text(encoding="utf-8") if whence.exists() else here
    if before != here and any((out / step.out).exists() for step in pipeline.steps):
        raise SettingError(
            f"{out} was made of the data in {before}. Name another folder: --out DIR, or, if it is "
            f"the same data elsewhere, remove {whence}"
        )
    whence.write_text(here, encoding="utf-8")


def _do(step: Step, folder: Path, data: Path | None, count: str) -> Done:
    out = folder / step.out
    if out.exists():
        say(f"{count} {step.stage}: {out} is there already")
        return Done(step.stage, out, 0.0, skipped=True)
    say(f"{count} {step.stage}: {out}")
    begun = time.perf_counter()
    try:
        _call(step, [_located(name, folder, data) for name in step.inputs], out)
    except DmrlError as e:
        if not step.optional:
            raise
        say(f"{count} {step.stage}: left out. {e}")
    return Done(step.stage, out, time.perf_counter() - begun, skipped=False)


def _located(name: str, folder: Path, data: Path | None) -> Path:
    if data is not None and name.startswith("{data}"):
        return data / name.removeprefix("{data}").lstrip("/")
    return folder / name


def _call(step: Step, inputs: list[Path], out: Path) -> None:
    module = _module(step.stage)
    settings = recipes.check(f"step {step.stage}", step.settings, settings_of(step.stage))
    extra: dict[str, Any] = {}
    if step.stage in RESUMABLE and partial_of(out).exists():
        extra["resume"] = True
    wants = STAGES[step.stage]
    if wants is not None and len(inputs) > wants:
        extra[ONE_MORE[step.stage]] = inputs.pop()
    sources = [inputs] if wants is None else inputs
    module.run(*sources, out, settings, **extra)
