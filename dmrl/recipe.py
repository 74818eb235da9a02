"""Recipes: TOML files that describe a run, checked before anything is done.

A recipe of one stage holds ``kind`` and that stage's settings. A pipeline holds ``[[step]]``
tables, each a stage with its inputs, output and settings, run in order; one with ``each`` stands
for several. A recipe with faults is refused whole, every fault named.
"""

import json
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from difflib import get_close_matches
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from pydantic import BaseModel, ConfigDict, ValidationError, create_model

from dmrl import limits
from dmrl.documents import parse_toml
from dmrl.errors import RecipeError

Settings = TypeVar("Settings")
EACH = "{each}"


@dataclass(frozen=True, slots=True)
class Step:
    """One stage of a pipeline.

    Parameters
    ----------
    stage
        Command name, such as "convert".
    out
        File or folder it writes, relative to the pipeline's folder.
    inputs
        What it reads: outputs of earlier steps, or ``{data}/...`` below ``--data``.
    settings
        The stage's settings.
    recipe
        Path or name of a recipe of this stage, whose keys the settings overrule. Empty: none.
    optional
        Go on without it where it cannot be done.
    """

    stage: str
    out: str
    inputs: tuple[str, ...] = ()
    settings: dict[str, Any] = field(default_factory=dict)
    recipe: str = ""
    optional: bool = False


@dataclass(frozen=True, slots=True)
class Pipeline:
    """Stages to run in order, and the text they were read from."""

    steps: tuple[Step, ...]
    text: str

    @property
    def needs_data(self) -> bool:
        """Whether a step reads below ``--data``."""
        return any("{data}" in name for step in self.steps for name in step.inputs)


def names() -> list[str]:
    """Names of the recipes that ship with dmrl."""
    return sorted(f.name[:-5] for f in _shipped().iterdir() if f.name.endswith(".toml"))


def read(name: str | Path) -> dict[str, Any]:
    """Keys of a recipe, by path or by the name of a shipped one.

    Raises
    ------
    RecipeError
        If there is no such recipe, or it is not TOML.
    """
    return _parse(name, text(name))


def text(name: str | Path) -> str:
    """Text of a recipe, by path or by the name of a shipped one.

    Raises
    ------
    RecipeError
        If there is no such recipe.
    """
    path = Path(name)
    source = path if path.suffix == ".toml" else _shipped() / f"{name}.toml"
    try:
        return source.read_text(encoding="utf-8")
    except (FileNotFoundError, IsADirectoryError):
        near = get_close_matches(path.stem, names(), n=1)
        hint = f"Did you mean {near[0]}?" if near else f"Shipped ones: {', '.join(names())}"
        raise RecipeError(f"no recipe {name}. {hint}") from None
    except (UnicodeDecodeError, OSError) as e:
        raise RecipeError(f"{name} cannot be read: {e}. Give a TOML text file") from e


def load(name: str | Path, kind: str, schema: type[Settings]) -> Settings:
    """Settings of one stage, from a recipe.

    Parameters
    ----------
    name
        Path, or the name of a shipped recipe.
    kind
        What the recipe must describe, such as "train".
    schema
        The stage's settings dataclass.

    Raises
    ------
    RecipeError
        If there is no such recipe, it is not TOML, is of another kind, or any key is wrong;
        names every wrong key.
    """
    keys = read(name)
    _check_kind(name, keys, kind)
    return check(name, {k: v for k, v in keys.items() if k != "kind"}, schema)


def load_pipeline(
    name: str | Path, stages: Collection[str], schema_of: Callable[[str], type[Any]]
) -> Pipeline:
    """Steps of a pipeline recipe, every setting checked.

    Parameters
    ----------
    name
        Path, or the name of a shipped recipe.
    stages
        Stages that a step may name.
    schema_of
        The settings dataclass of a stage; asked only for stages that the recipe names.

    Raises
    ------
    RecipeError
        If anything in it is wrong; names every wrong key.
    """
    content = text(name)
    keys = _parse(name, content)
    _check_kind(name, keys, "pipeline")
    faults = [f"{k}: extra inputs are not permitted" for k in keys if k not in ("kind", "step")]
    steps = keys.get("step")
    if not isinstance(steps, list) or not steps:
        raise _faulty(name, [*faults, "step: at least one [[step]] is required"])
    if sum(map(_size, steps)) > limits.STEPS:
        raise _faulty(name, [f"step: more than {limits.STEPS} steps and inputs, each written out"])
    numbered = [
        (number, _with_recipe(one))
        for number, step in enumerate(steps, start=1)
        for one in _repeated(step)
    ]
    for number, step in numbered:
        faults += [f"step.{number}.{fault}" for fault in _step_faults(step, stages, schema_of)]
    if faults:
        raise _faulty(name, dict.fromkeys(faults))
    return Pipeline(
        tuple(Step(**{**step, "inputs": tuple(step.get("inputs", ()))}) for _, step in numbered),
        content,
    )


def check(name: str | Path, keys: Mapping[str, Any], schema: type[Settings]) -> Settings:
    """An instance of a settings dataclass from a recipe's keys.

    Raises
    ------
    RecipeError
        Naming the recipe and every wrong key.
    """
    if faults := _faults(keys, schema):
        raise _faulty(name, faults)
    return _instance(keys, schema)


def _shipped() -> Traversable:
    return files("dmrl.recipes")


def _parse(name: str | Path, content: str) -> dict[str, Any]:
    try:
        return parse_toml(content)
    except ValueError as e:
        raise RecipeError(f"{name} is not TOML: {e}. Mend that line") from e


def _check_kind(name: str | Path, keys: Mapping[str, Any], kind: str) -> None:
    if (found := keys.get("kind")) != kind:
        has = f"is of kind {found!r}" if found is not None else "has no kind"
        raise RecipeError(f'{name} {has}. This command wants a recipe with: kind = "{kind}"')


def _faulty(name: str | Path, faults: Iterable[str]) -> RecipeError:
    lines = list(faults)
    keys = "1 wrong key" if len(lines) == 1 else f"{len(lines)} wrong keys"
    return RecipeError(f"{name} has {keys}: {'; '.join(lines)}. Mend them all")


def _size(step: Any) -> int:
    """How many steps and inputs of theirs a step stands for."""
    if not isinstance(step, dict):
        return 1
    each, inputs = step.get("each", 1), step.get("inputs", ())
    count = each if isinstance(each, int) else len(each) if isinstance(each, list) else 1
    return max(count, 1) * (1 + (len(inputs) if isinstance(inputs, list) else 0))


def _repeated(step: Any) -> list[Any]:
    """The steps that one with ``each`` stands for, a count or a list of numbers.

    Where ``{each}`` is in the output there is a step for each number, and a setting that is
    "{each}" is that number. Where it is in inputs alone, there is an input for each.
    """
    match step:
        case {"each": int(count), **others} if count > 0 and count is not True:
            return _repeated({"each": list(range(1, count + 1)), **others})
        case {"each": [_, *_] as numbers, "out": str(out), **others}:
            if EACH in out:
                return [_numbered({"out": out, **others}, number) for number in numbers]
            names: Any = others.get("inputs", [])
            inputs = [
                _numbered(name, number)
                for name in names
                for number in (numbers if EACH in str(name) else numbers[:1])
            ]
            return [{"out": out, **others, "inputs": inputs}]
    return [step]


def _numbered(value: Any, number: Any) -> Any:
    """A value of a step with a number for every ``{each}``."""
    match value:
        case str():
            return number if value == EACH else value.replace(EACH, str(number))
        case list():
            return [_numbered(one, number) for one in value]
        case dict():
            return {key: _numbered(one, number) for key, one in value.items()}
    return value


def _with_recipe(step: Any) -> Any:
    """A step whose settings are its recipe's, where its own do not overrule them."""
    match step:
        case {"recipe": str(name), "stage": str(stage)} if name:
            keys = read(name)
            _check_kind(name, keys, stage)
            theirs = {key: value for key, value in keys.items() if key != "kind"}
            return {**step, "settings": {**theirs, **step.get("settings", {})}}
    return step


def _step_faults(
    step: Any, stages: Collection[str], schema_of: Callable[[str], type[Any]]
) -> list[str]:
    if isinstance(step, dict) and "each" in step:  # what could be repeated has it no more
        return ["each: must be a count or a list of numbers, beside an out"]
    if faults := _faults(step, Step):
        return faults
    if step["stage"] not in stages:
        return [f"stage: no stage {step['stage']!r}; there are {', '.join(sorted(stages))}"]
    return [f"settings.{f}" for f in _faults(step.get("settings", {}), schema_of(step["stage"]))]


def _model(schema: type[Any]) -> type[BaseModel]:
    hints = get_type_hints(schema)
    required = {f.name for f in fields(schema) if f.default is f.default_factory is MISSING}
    keys = {n: (t, ... if n in required else None) for n, t in hints.items()}
    config = ConfigDict(strict=True, extra="forbid", frozen=True)
    model: type[BaseModel] = create_model(schema.__name__, __config__=config, **keys)  # type: ignore[call-overload]
    return model


def _validated(keys: Mapping[str, Any], schema: type[Any]) -> dict[str, Any]:
    # JSON, because pydantic's strict mode takes lists for tuples and text for paths only there.
    model = _model(schema).model_validate_json(json.dumps(keys, default=str))
    return {name: getattr(model, name) for name in keys}


def _faults(keys: Any, schema: type[Any]) -> list[str]:
    try:
        schema(**_validated(keys, schema))
    except ValidationError as e:
        return [f"{'.'.join(map(str, d['loc']))}: {_said(d['msg'])}" for d in e.errors()]
    except ValueError as e:
        return [str(e)]
    return []


def _said(message: str) -> str:
    """What pydantic says, or what a nested dataclass said to it."""
    return message.removeprefix("Value error, ") if "Value error" in message else message.lower()


def _instance(keys: Mapping[str, Any], schema: type[Settings]) -> Settings:
    return schema(**_validated(keys, schema))
