"""The command line of a stage, built from the signature and docstring of its ``run``.

The command has the arguments of ``run``, in their order. Those before ``settings`` are given by
their place. Each field of the settings is a flag, and so is every argument behind them. ``--on``
and the folder form come with ``folder``, ``--json`` with a `Closing` that has a document. Help is
the docstring of ``run``, and that of the settings.
"""

import inspect
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

from dmrl.guards.posix import count_cores
from dmrl.pipeline.batch import is_collection, run_over_folder
from dmrl.pipeline.stage_signature import resolve_hints, takes_paths
from dmrl.terminal.arguments import AsJson, Flat, FolderWorkers, On, Workers
from dmrl.terminal.closing import Closing, Given
from dmrl.terminal.left_out import count_left_out
from dmrl.terminal.progress import say

POSITIONAL: Any = inspect.Parameter.POSITIONAL_ONLY
KEYWORD: Any = inspect.Parameter.KEYWORD_ONLY
Find = Callable[[Given], Mapping[Path, Path] | None]


def stage_command(
    run: Callable[..., Any],
    closing: Closing,
    *,
    name: str = "",
    folder: str = "",
    find: Find | None = None,
    hidden: Collection[str] = (),
    warnings: Callable[[Any, Given], list[str]] | None = None,
    status: Callable[[Any, Given], int] | None = None,
) -> Callable[..., int | None]:
    """Return the function that the command line calls for a stage.

    Parameters
    ----------
    run
        Function of the stage.
    closing
        Form of the printed result.
    name
        Name of the command. Empty: that of the module of ``run``.
    folder
        Argument that may also be a folder of recordings. Empty: none.
    find
        Return the inputs of a folder by the names of their outputs; None: it is one input.
        Without it, they are the recordings of a folder or a pattern.
    hidden
        Arguments of ``run`` that the command does not have.
    warnings
        Return lines that go to standard error before the result is printed.
    status
        Return the exit status. Without it, 0.

    Raises
    ------
    TypeError
        If the folder form would lose an argument, being neither a path nor of the settings.
    """
    name = name or run.__module__.rpartition(".")[2].replace("_", "-")
    taken = [key for key in inspect.signature(run).parameters if key not in hidden]
    if folder:
        _require_settings(run, taken)
    signature = inspect.Signature([*_parameters(run, taken, closing, folder)])

    def command(*arguments: Any, **named: Any) -> int | None:
        bound = signature.bind(*arguments, **named)
        bound.apply_defaults()
        given = Given(**{"as_json": False, "on": None, **bound.arguments})
        values = {key: getattr(given, key) for key in taken}
        if "workers" in values:
            values["workers"] = values["workers"] or count_cores()
        strict = getattr(getattr(given, "settings", None), "strict", False)
        with count_left_out(strict=strict) as left_out:
            if folder and _run_as_folder(name, folder, given, find):
                return None
            result = run(**values)
        for line in warnings(result, given) if warnings else ():
            say(line)
        closing.print(result, given, as_json=given.as_json, left_out=left_out.counts)
        return int(status(result, given)) if status else None

    command.__doc__, command.__module__ = run.__doc__, run.__module__
    command.__signature__ = signature  # type: ignore[attr-defined]
    return command


def _require_settings(run: Callable[..., Any], taken: list[str]) -> None:
    """Raise TypeError if an argument is neither a path nor of the settings."""
    hints = resolve_hints(run)
    for key in taken:
        if key not in ("settings", "workers", "resume") and takes_paths(hints[key]) is None:
            raise TypeError(
                f"run() takes {key}, which its folder form would lose: make it a field of a "
                "dataclass, the argument settings"
            )


def _parameters(
    run: Callable[..., Any], taken: list[str], closing: Closing, folder: str
) -> Iterator[inspect.Parameter]:
    """Yield the parameters of the command."""
    hints, flat = resolve_hints(run, extras=True), Flat
    kind, workers, of_run = POSITIONAL, FolderWorkers if folder else None, inspect.signature(run)
    for key in taken:
        hint, default = hints[key], of_run.parameters[key].default
        if key == "workers":
            workers = Workers
            continue
        if of_run.parameters[key].kind is KEYWORD or is_dataclass(hint):
            kind = KEYWORD
        if isinstance(hint, type) and is_dataclass(hint):
            hint, default = flat[hint], hint()
        yield inspect.Parameter(key, kind, default=default, annotation=hint)
    more = {"workers": workers, "on": On if folder else None}
    for key, hint in more.items():
        if hint is not None:
            yield inspect.Parameter(key, KEYWORD, default=None, annotation=hint)
    if closing.has_json:
        yield inspect.Parameter("as_json", KEYWORD, default=False, annotation=AsJson)


def _run_as_folder(name: str, role: str, given: Given, find: Find | None) -> bool:
    """Run a stage over a folder or on a cluster; return whether that was asked for."""
    source, out = getattr(given, role), given.out
    found = find(given) if find else None
    many = found is not None if find else is_collection(source)
    if not many and given.on is None:
        return False
    paths = {key: value for key, value in vars(given).items() if isinstance(value, Path)}
    run_over_folder(
        name,
        source,
        out if many else out.parent,
        getattr(given, "settings", None),
        workers=given.workers,
        on=given.on,
        as_json=given.as_json,
        role=role,
        inputs={key: path for key, path in paths.items() if key not in (role, "out")},
        found=found if many else {Path(out.name): source},
    )
    return True
