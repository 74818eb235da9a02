"""What a stage takes, read from the signature of its ``run``.

==================================  ==========================================================
an argument of ``run``              is, in a recipe
==================================  ==========================================================
``out``                             the output; a stage without one is no step
``settings``                        keys of their own, one for each field
annotated ``Path``                  an input; with a default one that may be left out
annotated ``Sequence[Path]``        any number of inputs, but for none
``resume``                          nothing: set where a killed run has left something
another without a default           a key, checked as its annotation says
another with a default              nothing
==================================  ==========================================================

Fields of settings that are annotated with ``Path``, in whatever, are inputs as well.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, get_args, get_origin, get_type_hints

from dmrl import plugins
from dmrl.errors import RecipeError
from dmrl.recording import Provenance

ALONE = ("processes", "workers")
"""A stage with one of these settings keeps all cores busy by itself."""
NO_CONTENT = ("workers",)
"""Settings that change no byte of any output."""

Keys = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Role:
    """An input of a stage: whether it takes many, and whether it must have it."""

    many: bool
    required: bool


@dataclass(frozen=True, slots=True)
class Interface:
    """What a stage takes.

    Parameters
    ----------
    run
        The function.
    roles
        Inputs, by the name of the argument.
    settings
        Dataclass of its settings; None: it has none.
    others
        Annotations of other arguments, by name.
    paths
        Settings that name files or folders.
    resumes
        Whether it can go on with what a killed run has left.
    alone
        Whether it keeps all cores busy by itself.
    filled
        Makes a recipe's keys settings, where a key stands for several: a preset.
    origin
        Provenance of what ``run`` would write, given the same but ``out``. None: that of its
        inputs and settings.
    """

    run: Callable[..., Any]
    roles: dict[str, Role] = field(default_factory=dict)
    settings: type[Any] | None = None
    others: dict[str, Any] = field(default_factory=dict)
    paths: frozenset[str] = frozenset()
    resumes: bool = False
    alone: bool = False
    filled: Callable[[Keys], Keys] = dict
    origin: Callable[..., Provenance] | None = None

    @property
    def keys(self) -> list[str]:
        """Every key that a step of this stage may have beside those of all steps."""
        own = [f.name for f in fields(self.settings)] if self.settings else []
        return [*self.roles, *self.others, *own]


@cache
def interface_of(stage: str, *, writes: bool = True) -> Interface:
    """What a stage takes.

    Parameters
    ----------
    stage
        Command name.
    writes
        Whether it must write something.

    Raises
    ------
    RecipeError
        If there is no such stage, or it writes nothing.
    MissingExtra
        If a package that it needs is not installed.
    """
    module = _module(stage)
    run = getattr(module, "run", None)
    if run is None or (writes and "out" not in inspect.signature(run).parameters):
        raise RecipeError(f"{stage} writes nothing, so it can be no step. Leave it out")
    hints = get_type_hints(run)
    roles, others = {}, {}
    for parameter in inspect.signature(run).parameters.values():
        hint, required = hints[parameter.name], parameter.default is parameter.empty
        if parameter.name in ("out", "settings", "resume"):
            continue
        if (many := _paths(hint)) is not None:
            roles[parameter.name] = Role(many, required)
        elif required:
            others[parameter.name] = hint
    settings = hints.get("settings")
    names = get_type_hints(settings) if settings else {}
    return Interface(
        run,
        roles,
        settings,
        others,
        frozenset(name for name, hint in names.items() if _mentions_path(hint)),
        resumes="resume" in hints,
        alone=any(name in names for name in ALONE),
        filled=getattr(module, "filled", dict),
        origin=getattr(module, "origin", None),
    )


def _module(stage: str) -> Any:
    # By name, because stages stand above this room and not below it.
    package = "dmrl.stages"
    known = [m.name.replace("_", "-") for m in iter_modules(import_module(package).__path__)]
    added = plugins.found(plugins.STAGES)
    if stage not in known and stage in added:
        return added[stage].load()
    known += list(added)
    if stage not in known:
        near = get_close_matches(stage, known, n=1)
        hint = f"Did you mean {near[0]}?" if near else "See: dmrl --help"
        raise RecipeError(f"no stage {stage!r}. {hint}")
    return import_module(f"{package}.{stage.replace('-', '_')}")


def _paths(hint: Any) -> bool | None:
    """Whether an annotation is of many paths; False: of one; None: of none."""
    kinds = [kind for kind in get_args(hint) if kind is not type(None)] if _union(hint) else [hint]
    if kinds == [Path]:
        return False
    many = len(kinds) == 1 and get_origin(kinds[0]) in (list, tuple, Sequence)
    return True if many and get_args(kinds[0])[:1] == (Path,) else None


def _union(hint: Any) -> bool:
    return type(None) in get_args(hint)


def _mentions_path(hint: Any) -> bool:
    return hint is Path or any(_mentions_path(part) for part in get_args(hint))
