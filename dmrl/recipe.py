"""Recipes: TOML files that describe a run, checked before anything is done.

A recipe of one stage holds ``kind`` and that stage's settings; of many, see `dmrl.pipeline`. A
recipe with faults is refused whole, every fault named.
"""

import json
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, fields
from difflib import get_close_matches
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError, create_model

from dmrl.errors import RecipeError
from dmrl.guards import limits
from dmrl.guards.bounded_parsing import parse_toml
from dmrl.guards.paths import refuse_pipe

Settings = TypeVar("Settings")
MOST_BYTES = 4 * limits.TOML_CHARACTERS
"""Of a recipe, before it is text."""


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
    refuse_pipe(path)
    source = path if path.suffix == ".toml" else _shipped() / f"{name}.toml"
    try:
        with source.open("rb") as stream:
            content = stream.read(MOST_BYTES + 1)
        if len(content) > MOST_BYTES:
            raise RecipeError(f"{name} has more than {MOST_BYTES} bytes. That is no recipe")
        return content.decode("utf-8")
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
    check_kind(name, keys, kind)
    return check(name, {k: v for k, v in keys.items() if k != "kind"}, schema)


def check(name: str | Path, keys: Mapping[str, Any], schema: type[Settings]) -> Settings:
    """An instance of a settings dataclass from a recipe's keys.

    Raises
    ------
    RecipeError
        Naming the recipe and every wrong key.
    """
    if wrong := faults(keys, schema):
        raise faulty(name, wrong)
    return _instance(keys, schema)


def _shipped() -> Traversable:
    return files("dmrl.recipes")


def _parse(name: str | Path, content: str) -> dict[str, Any]:
    try:
        return parse_toml(content)
    except ValueError as e:
        raise RecipeError(f"{name} is not TOML: {e}. Mend that line") from e


def check_kind(name: str | Path, keys: Mapping[str, Any], kind: str) -> None:
    """Nothing, if a recipe is of this kind.

    Raises
    ------
    RecipeError
        If it is of another.
    """
    if (found := keys.get("kind")) != kind:
        has = f"is of kind {found!r}" if found is not None else "has no kind"
        raise RecipeError(f'{name} {has}. This command wants a recipe with: kind = "{kind}"')


def faulty(name: str | Path, wrong: Iterable[str]) -> RecipeError:
    """The one-line error that names all that is wrong with a recipe."""
    lines = list(wrong)
    keys = "1 wrong key" if len(lines) == 1 else f"{len(lines)} wrong keys"
    return RecipeError(f"{name} has {keys}: {'; '.join(lines)}. Mend them all")


def argument_fault(value: Any, hint: Any) -> str:
    """What is wrong with a value for an argument of this annotation; empty: nothing."""
    try:
        argument(value, hint)
    except ValidationError as e:
        return "; ".join(d["msg"].lower() for d in e.errors())
    return ""


def argument(value: Any, hint: Any) -> Any:
    """A value of TOML as an argument of this annotation.

    Raises
    ------
    ValueError
        If it cannot be one.
    """
    return TypeAdapter(hint).validate_json(json.dumps(value, default=str), strict=True)


def plain(values: Any) -> Any:
    """Settings as values of JSON."""
    return json.loads(json.dumps(values, default=str))


@cache
def _model(schema: type[Any]) -> type[BaseModel]:
    hints = get_type_hints(schema)
    required = {f.name for f in fields(schema) if f.default is f.default_factory is MISSING}
    keys = {n: (t, ... if n in required else None) for n, t in hints.items()}
    config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)
    with warnings.catch_warnings():
        # A setting may be called as a method of pydantic's is: only fields are asked for.
        warnings.filterwarnings("ignore", "Field name .* shadows an attribute")
        model: type[BaseModel] = create_model(schema.__name__, __config__=config, **keys)  # type: ignore[call-overload]
    return model


def _validated(keys: Mapping[str, Any], schema: type[Any]) -> dict[str, Any]:
    # JSON, because pydantic's strict mode takes lists for tuples and text for paths only there.
    model = _model(schema)  # type: ignore[arg-type] # a class has a hash
    made = model.model_validate_json(json.dumps(keys, default=str))
    return {name: getattr(made, name) for name in keys}


def faults(keys: Any, schema: type[Any]) -> list[str]:
    """What is wrong with the keys of a settings dataclass, one line for each."""
    try:
        values = _validated(keys, schema)
        schema(**values)
    except ValidationError as e:
        return [f"{'.'.join(map(str, d['loc']))}: {_said(d['msg'])}" for d in e.errors()]
    except ValueError as e:
        return [str(e)]
    return list(_out_of_range(values, schema))


def _out_of_range(values: Mapping[str, Any], schema: type[Any]) -> Iterator[str]:
    """What the validators say that a settings dataclass has for the command line."""
    hints = get_type_hints(schema, include_extras=True)
    for name, value in values.items():
        for note in getattr(hints[name], "__metadata__", ()):
            for validator in getattr(note, "validator", ()):
                try:
                    validator(type(value), value)
                except (ValueError, TypeError) as e:
                    yield f"{name}: {str(e)[:1].lower()}{str(e)[1:].rstrip('.')}"


def _said(message: str) -> str:
    """What pydantic says, or what a nested dataclass said to it."""
    return message.removeprefix("Value error, ") if "Value error" in message else message.lower()


def _instance(keys: Mapping[str, Any], schema: type[Settings]) -> Settings:
    return schema(**_validated(keys, schema))
