"""Pipelines: recipes of many steps. A step is run unless its output is there and up to date.

An output is made again when a setting that matters, or the content of something that it is made
of, has changed. Until the new one is whole the old one stays. See docs/pipelines.md.
"""

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dmrl.atomic_output import as_output_error, partial_of, rewritten_file
from dmrl.errors import OutputError, SettingError
from dmrl.evaluation.pipeline_summary import Done
from dmrl.guards.paths import refuse_no_text
from dmrl.pipeline.build_cache import Memory
from dmrl.pipeline.executor import executor
from dmrl.pipeline.plan import DATA, RECIPE_FILE, STATE_FILE, UNFINISHED, Plan, Step, load, located
from dmrl.pipeline.runner import Runner
from dmrl.storage import Remote
from dmrl.storage.upload import require_bucket
from dmrl.terminal.progress import say

__all__ = ["Done", "Plan", "Step", "kept_recipe", "load", "run"]

BEGUN = (UNFINISHED, partial_of(Path(STATE_FILE)).name)
"""What is left where a disk broke before a pipeline had begun, and refused to remove it."""


def run(
    name: str | Path,
    out: Path,
    data: Path | None = None,
    *,
    workers: int | None = None,
    on: str | None = None,
) -> list[Done]:
    """Run the steps of a pipeline recipe whose outputs are not there, or not up to date.

    Parameters
    ----------
    name
        Path of a recipe, or the name of a shipped one.
    out
        Folder for all outputs; made if it is not there.
    data
        Folder that ``{data}`` in the recipe stands for.
    workers
        Steps that run at a time, at most. None: as many as there are cores. The bytes are the
        same with any number.
    on
        A cluster that does the steps in place of processes here; see `executor`.

    Returns
    -------
    list
        What became of every step, in the order of the recipe.

    Raises
    ------
    RecipeError
        If the recipe is wrong; before anything is done.
    SettingError
        If the recipe needs ``data`` and has none, or something in it is missing.
    OutputError
        If ``out`` cannot be used.
    DmrlError
        What a stage says against its step.
    """
    plan = load(name)
    _check_data(name, plan, data)
    with _owned(out) as folder:
        memory = Memory.of(folder / STATE_FILE)
        memory.save()
        _keep_recipe(folder, plan)
        with executor(on, workers, bars=True) as crew:
            done = Runner(plan, folder, data, memory, crew).run()
        memory.forget_what_is_gone()
        memory.save()
        with suppress(OSError):
            (folder / UNFINISHED).rmdir()
    if skipped := sum(one.skipped for one in done):
        say(f"{skipped} of {len(done)} steps were up to date")
    return done


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
    missing = [path for n in names if not (path := located(n, set(), data, data)).exists()]
    if missing:
        more = f" and {len(missing) - 1} more that {name} reads" * (len(missing) > 1)
        raise SettingError(f"no {missing[0]}{more}. Check --data {data}")


@contextmanager
def _owned(out: Path) -> Iterator[Path]:
    """The folder of outputs, for this process alone; in a bucket nothing can be locked."""
    if isinstance(out, Remote):
        _refuse_another_s(out)
        require_bucket(out)
        yield out
        return
    refuse_no_text(out)
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out} is a file. Name a folder: --out DIR")
    try:
        _refuse_another_s(out)
        (out / UNFINISHED).mkdir(parents=True, exist_ok=True)
        if (out / UNFINISHED).is_symlink():
            raise OutputError(f"{out / UNFINISHED} is a link to another folder. Remove it")
    except (FileExistsError, NotADirectoryError):
        raise OutputError(f"{out} is a file. Name a folder: --out DIR") from None
    except OSError as e:
        raise as_output_error(out, e) from e
    held = os.open(out, os.O_RDONLY)
    try:
        _lock(held, out)
        yield out
    except OSError as e:
        if e.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES):
            raise as_output_error(out, e) from e
        raise
    finally:
        os.close(held)


def _refuse_another_s(out: Path) -> None:
    """Nothing, if a folder has been a pipeline's, or holds nothing but what one began with."""
    if not out.exists() or (out / STATE_FILE).exists():
        return
    if any(inner.name not in BEGUN for inner in out.iterdir()):
        raise OutputError(f"{out} is not empty. Remove it or name another: --out DIR")


def _lock(held: int, out: Path) -> None:
    """Lock an open folder until it is closed, or this process dies."""
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OutputError(f"another dmrl run is at work in {out}. Wait for it") from None
    except OSError:
        return  # a file system without locks


def kept_recipe(folder: Path) -> str | None:
    """Text of the recipe that a folder was made by last; None, if there is none to be read."""
    try:
        return (folder / RECIPE_FILE).read_text(encoding="utf-8")
    except (OSError, ValueError):
        return None


def _keep_recipe(folder: Path, plan: Plan) -> None:
    """Leave the recipe beside what it makes."""
    kept = folder / RECIPE_FILE
    with rewritten_file(kept) as partial:
        partial.write_text(plan.text, encoding="utf-8")
