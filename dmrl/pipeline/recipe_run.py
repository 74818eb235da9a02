"""Pipelines: recipes of many steps. A step is run unless its output is there and up to date.

An output is made again when a setting that affects it, or the content of an input, has changed.
The old one stays until the new one is complete. See docs/pipelines.md.
"""

import errno
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from dmrl.atomic_output import as_output_error, replace_file, to_partial_path
from dmrl.errors import OutputError, SettingError
from dmrl.evaluation.pipeline_summary import StepOutcome
from dmrl.guards.paths import require_text_path
from dmrl.guards.posix import fcntl
from dmrl.pipeline.build_cache import BuildCache, build_key
from dmrl.pipeline.executor import open_executor
from dmrl.pipeline.plan import (
    DATA,
    NOTHING,
    PREVIOUS,
    RECIPE_FILE,
    STATE_FILE,
    UNFINISHED,
    Plan,
    Table,
    find_producers,
    load_plan,
    locate_input,
)
from dmrl.pipeline.runner import Runner, keep_previous
from dmrl.storage import RemotePath
from dmrl.storage.upload import require_bucket
from dmrl.terminal.progress import say

MAX_VALUE_CHARACTERS = 40
"""Length of a setting's value in a reason."""
LEFTOVER_NAMES = (UNFINISHED, to_partial_path(Path(STATE_FILE)).name)
"""Files that remain if a disk failed before a pipeline began."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """Action of a run on one output, and its reason."""

    stage: str
    out: Path
    action: Literal["keep", "make", "replace"]
    reason: str


def run(
    name: str | Path,
    out: Path,
    data: Path | None = None,
    *,
    workers: int | None = None,
    on: str | None = None,
    submitted: Mapping[str, Table] = NOTHING,
) -> list[StepOutcome]:
    """Run the steps of a pipeline recipe whose outputs are not there, or not up to date.

    Parameters
    ----------
    name
        Path of a recipe, or the name of a shipped one.
    out
        Folder for all outputs; created if missing.
    data
        Folder that replaces ``{data}`` in the recipe.
    workers
        Steps that run at a time, at most. None: as many as there are cores. The bytes are the
        same with any number.
    on
        Cluster that runs the steps in place of processes here; see `open_executor`.
    submitted
        Rows that the recipe's ``[each]`` gets in addition; see `load_plan`.

    Returns
    -------
    list
        Outcome of every step, in the order of the recipe.

    Raises
    ------
    RecipeError
        If the recipe is wrong, before anything runs.
    SettingError
        If the recipe needs ``data`` and has none, or something in it is missing.
    OutputError
        If ``out`` cannot be used.
    DmrlError
        If a step fails.
    """
    plan = load_plan(name, submitted)
    _check_data(name, plan, data)
    with _lock_folder(out) as folder:
        memory = BuildCache.load(folder / STATE_FILE)
        memory.save()
        _announce_replacements(Runner(plan, folder, data, memory))
        if read_recipe_text(folder) is None:
            _write_recipe(folder, plan)
        try:
            with open_executor(on, workers, bars=True) as crew:
                replace = partial(_write_recipe, folder, plan)
                done = Runner(plan, folder, data, memory, before_output=replace).run(crew)
        finally:
            with suppress(OSError):  # what can be resumed stays
                (folder / UNFINISHED).rmdir()
        _write_recipe(folder, plan)
        memory.drop_missing_files()
        memory.save()
    if skipped := sum(one.skipped for one in done):
        say(f"{skipped} of {len(done)} steps were up to date")
    return done


def forecast(
    name: str | Path, out: Path, data: Path | None = None, submitted: Mapping[str, Table] = NOTHING
) -> list[Forecast]:
    """Return what `run` would do, step by step. Nothing is written.

    Parameters, errors as `run`.
    """
    plan = load_plan(name, submitted)
    _check_data(name, plan, data)
    _refuse_foreign_folder(out)
    return _forecast_steps(Runner(plan, out, data, BuildCache.load(out / STATE_FILE)))


def _forecast_steps(runner: Runner) -> list[Forecast]:
    """Return a forecast of every step, in the order of the recipe. Nothing is written.

    Raises
    ------
    OutputError
        If an output exists that the pipeline did not write.
    OSError
        If an input cannot be read.
    """
    found: dict[str, Forecast] = {}
    for out in runner.order.static_order():
        step, path = runner.steps[out], runner.folder / out
        changed = [
            f"{name} is made again" if found[name].action == "replace" else f"{name} is made first"
            for name in find_producers(step.names, runner.outs)
            if found[name].action != "keep"
        ]
        if not path.exists():
            found[out] = Forecast(step.stage, path, "make", "; ".join(changed) or "it is missing")
            continue
        runner.refuse_foreign_output(step)
        if changed:
            found[out] = Forecast(step.stage, path, "replace", "; ".join(changed))
            continue
        made_of = runner.describe_step(step)
        if runner.memory.is_up_to_date(path, build_key(made_of)):
            found[out] = Forecast(step.stage, path, "keep", "up to date")
            continue
        reason = "; ".join(_iter_changes(runner.memory.made_of.get(out), made_of))
        found[out] = Forecast(step.stage, path, "replace", reason)
    return [found[out] for out in runner.steps]


def _iter_changes(before: Mapping[str, Any] | None, now: Mapping[str, Any]) -> Iterator[str]:
    """Yield the differences between the recorded and the present settings and inputs."""
    if before is None:
        yield "its settings or inputs have changed"
        return
    if before == now:
        yield "it was changed after the run"
        return
    for what in ("dmrl", "stage"):
        if before[what] != now[what]:
            yield f"{what} {before[what]} -> {now[what]}"
    for key in sorted({*before["settings"], *now["settings"]}):
        old, new = (_to_text(one["settings"].get(key)) for one in (before, now))
        if old != new:
            yield f"{key} {old} -> {new}"
    for role in sorted({*before["inputs"], *now["inputs"]}):
        if before["inputs"].get(role) != now["inputs"].get(role):
            yield f"the input {role} has changed"


def _to_text(value: Any) -> str:
    text = str(value)
    return text if len(text) <= MAX_VALUE_CHARACTERS else text[: MAX_VALUE_CHARACTERS - 3] + "..."


def _announce_replacements(runner: Runner) -> None:
    """Print a line for each output that the run replaces."""
    with suppress(OSError, OutputError):  # the runner reports them, with their step
        for one in _forecast_steps(runner):
            if one.action == "replace":
                place = one.out.parent / PREVIOUS
                say(f"{one.out.name} is replaced: {one.reason}. The one before moves to {place}")


def _check_data(name: str | Path, plan: Plan, data: Path | None) -> None:
    """Refuse a recipe whose data is not there; optional steps are left out then."""
    if not plan.needs_data:
        return
    if data is None:
        raise SettingError(f"{name} reads data that does not ship with dmrl. Say where: --data DIR")
    if not data.is_dir():
        raise SettingError(f"no folder {data}. Say where the data is: --data DIR")
    needed = (step for step in plan.steps if not step.optional)
    names = dict.fromkeys(n for step in needed for n in step.names if n.startswith(DATA))
    missing = [path for n in names if not (path := locate_input(n, set(), data, data)).exists()]
    if missing:
        more = f" and {len(missing) - 1} more that {name} reads" * (len(missing) > 1)
        raise SettingError(f"no {missing[0]}{more}. Check --data {data}")


@contextmanager
def _lock_folder(out: Path) -> Iterator[Path]:
    """Lock the folder of outputs for this process; in a bucket nothing can be locked."""
    if isinstance(out, RemotePath):
        _refuse_foreign_folder(out)
        require_bucket(out)
        yield out
        return
    require_text_path(out)
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out} is a file. Name a folder: --out DIR")
    try:
        _refuse_foreign_folder(out)
        (out / UNFINISHED).mkdir(parents=True, exist_ok=True)
        if (out / UNFINISHED).is_symlink():
            raise OutputError(f"{out / UNFINISHED} is a link to another folder. Remove it")
    except (FileExistsError, NotADirectoryError):
        raise OutputError(f"{out} is a file. Name a folder: --out DIR") from None
    except OSError as e:
        raise as_output_error(out, e) from e
    held = os.open(out, os.O_RDONLY)
    try:
        _lock_open_folder(held, out)
        yield out
    except OSError as e:
        if e.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES):
            raise as_output_error(out, e) from e
        raise
    finally:
        os.close(held)


def _refuse_foreign_folder(out: Path) -> None:
    """Raise OutputError unless a folder is empty, or a pipeline's."""
    if not out.exists() or (out / STATE_FILE).exists():
        return
    if any(inner.name not in LEFTOVER_NAMES for inner in out.iterdir()):
        raise OutputError(f"{out} is not empty. Remove it or name another: --out DIR")


def _lock_open_folder(held: int, out: Path) -> None:
    """Lock an open folder until it is closed, or this process dies."""
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OutputError(f"another dmrl run is at work in {out}. Wait for it") from None
    except OSError:
        return  # a file system without locks


def read_recipe_text(folder: Path) -> str | None:
    """Return the text of the recipe that last ran in a folder; None, if there is none."""
    try:
        return (folder / RECIPE_FILE).read_text(encoding="utf-8")
    except (OSError, ValueError):
        return None


def _write_recipe(folder: Path, plan: Plan) -> None:
    """Write the recipe into the folder of its outputs, unless it is there.

    Not before an output is new: a stopped run would leave a recipe that made none of the outputs.
    """
    kept = folder / RECIPE_FILE
    if (before := read_recipe_text(folder)) == plan.text:
        return
    if before is not None:
        keep_previous(kept)
    with replace_file(kept) as unfinished:
        unfinished.write_text(plan.text, encoding="utf-8")
