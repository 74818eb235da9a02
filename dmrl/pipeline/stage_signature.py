"""Signature of a stage: inputs, settings and other arguments of its ``run``.

==================================  ==========================================================
an argument of ``run``              is, in a recipe
==================================  ==========================================================
``out``                             the output; a stage without one is no step
``settings``                        keys of their own, one for each field
annotated ``Path``                  an input; with a default one that may be left out
annotated ``Sequence[Path]``        any number of inputs, but for none
``resume``                          nothing: set if a killed run left a partial output
another without a default           a key, checked as its annotation says
another with a default              nothing
==================================  ==========================================================

Fields of settings whose annotation contains ``Path`` are inputs as well.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, get_args, get_origin, get_type_hints

from dmrl import entry_points
from dmrl.errors import RecipeError, suggest

if TYPE_CHECKING:
    from dmrl.recording import Provenance

EXCLUSIVE_SETTINGS = ("processes", "workers")
"""Settings of stages that keep all cores busy by themselves."""
SETTINGS_WITHOUT_EFFECT = ("workers",)
"""Settings that change no byte of any output."""

Keys = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class InputRole:
    """An input of a stage: whether it is a list, and whether it is required."""

    many: bool
    required: bool


@dataclass(frozen=True, slots=True)
class StageSignature:
    """Inputs, settings and other arguments of a stage.

    Parameters
    ----------
    run
        The function.
    roles
        Inputs, by the name of the argument.
    settings
        Dataclass of the settings; None: there is none.
    others
        Annotations of other arguments, by name.
    paths
        Settings that name files or folders.
    resumes
        Whether it can resume a killed run.
    exclusive
        Whether it keeps all cores busy by itself.
    filled
        Function that expands keys of a recipe, such as a preset, into settings.
    origin
        Function that builds the provenance of the output from the arguments of ``run`` without
        ``out``. None: it follows from inputs and settings.
    """

    run: Callable[..., Any]
    roles: dict[str, InputRole] = field(default_factory=dict)
    settings: type[Any] | None = None
    others: dict[str, Any] = field(default_factory=dict)
    paths: frozenset[str] = frozenset()
    resumes: bool = False
    exclusive: bool = False
    filled: Callable[[Keys], Keys] = dict
    origin: "Callable[..., Provenance] | None" = None

    @property
    def keys(self) -> list[str]:
        """Keys that a step of this stage may have beside those of all steps."""
        own = [f.name for f in fields(self.settings)] if self.settings else []
        return [*self.roles, *self.others, *own]


@cache
def signature_of(stage: str, *, writes: bool = True) -> StageSignature:
    """Read the signature of a stage.

    Parameters
    ----------
    stage
        Command name.
    writes
        Whether it must have an output.

    Raises
    ------
    RecipeError
        If there is no such stage, or it writes nothing.
    MissingExtra
        If a package that it needs is not installed.
    """
    module = _load_stage(stage)
    run = getattr(module, "run", None)
    if run is None or (writes and "out" not in inspect.signature(run).parameters):
        raise RecipeError(f"{stage} writes nothing, so it can be no step. Leave it out")
    hints = resolve_hints(run)
    roles, others = {}, {}
    for parameter in inspect.signature(run).parameters.values():
        hint, required = hints[parameter.name], parameter.default is parameter.empty
        if parameter.name in ("out", "settings", "resume"):
            continue
        if (many := takes_paths(hint)) is not None:
            roles[parameter.name] = InputRole(many, required)
        elif required:
            others[parameter.name] = hint
    settings = hints.get("settings")
    names = get_type_hints(settings) if settings else {}
    return StageSignature(
        run,
        roles,
        settings,
        others,
        frozenset(name for name, hint in names.items() if _mentions_path(hint)),
        resumes="resume" in hints,
        exclusive=any(name in names for name in EXCLUSIVE_SETTINGS),
        filled=getattr(module, "filled", dict),
        origin=getattr(module, "origin", None),
    )


def resolve_hints(run: Callable[..., Any], *, extras: bool = False) -> dict[str, Any]:
    """Return the annotations of the arguments of ``run``, without that of its result."""
    taken = {name: hint for name, hint in run.__annotations__.items() if name != "return"}
    named = SimpleNamespace(__annotations__=taken)
    return get_type_hints(named, run.__globals__, include_extras=extras)


def _load_stage(stage: str) -> Any:
    # By name, because stages are above this room.
    package = "dmrl.stages"
    known = [m.name.replace("_", "-") for m in iter_modules(import_module(package).__path__)]
    added = entry_points.find_plugins(entry_points.STAGES)
    if stage not in known and stage in added:
        return added[stage].load()
    known += list(added)
    if stage not in known:
        raise RecipeError(f"no stage {stage!r}. {suggest(stage, known, 'See: dmrl --help')}")
    return import_module(f"{package}.{stage.replace('-', '_')}")


def takes_paths(hint: Any) -> bool | None:
    """Return whether an annotation is a list of paths; False: one path; None: neither."""
    members = get_args(hint)
    kinds = [one for one in members if one is not type(None)] if type(None) in members else [hint]
    if kinds == [Path]:
        return False
    many = len(kinds) == 1 and get_origin(kinds[0]) in (list, tuple, Sequence)
    return True if many and get_args(kinds[0])[:1] == (Path,) else None


def _mentions_path(hint: Any) -> bool:
    return hint is Path or any(_mentions_path(part) for part in get_args(hint))
