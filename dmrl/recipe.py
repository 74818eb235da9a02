"""Recipes: TOML files with the settings of a run, checked before anything runs.

A recipe of one stage has ``kind`` and that stage's settings; for several stages, see
`dmrl.pipeline`. Errors name all wrong keys of a recipe.
"""

import json
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, asdict, fields, is_dataclass, replace
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError, create_model

from dmrl.errors import RecipeError, SettingError, UnsafeName, suggest
from dmrl.guards import limits
from dmrl.guards.bounded_parsing import parse_toml
from dmrl.guards.paths import refuse_pipe
from dmrl.storage import to_path

Settings = TypeVar("Settings")
MAX_BYTES = 4 * limits.TOML_CHARACTERS
"""Maximum size of a recipe file, bytes."""
PRETRAINED = "pretrained"
"""Folder of the recipes that trained the shipped networks, below the recipes for users."""


def list_names() -> list[str]:
    """Return the names of the shipped recipes for users."""
    return _names_in(_recipe_files())


def list_pretrained_names() -> list[str]:
    """Return the names of the shipped recipes that trained the shipped networks."""
    return _names_in(_recipe_files() / PRETRAINED)


def locate_recording(name: str) -> Path | None:
    """Return the path of a recording that ships beside the recipes; None, if none has this name."""
    path = Path(str(_recipe_files() / Path(name).name))
    return path if path.name == name and path.suffix == ".mcap" and path.is_file() else None


def read(name: str | Path) -> dict[str, Any]:
    """Read the keys of a recipe, by path or by the name of a shipped one.

    Raises
    ------
    RecipeError
        If the recipe does not exist, or is not TOML.
    """
    return _parse_recipe(name, read_text(name))


def read_text(name: str | Path) -> str:
    """Read the text of a recipe, by path or by the name of a shipped one.

    Raises
    ------
    RecipeError
        If the recipe does not exist.
    """
    path = Path(name)
    refuse_pipe(path)
    source = path if path.suffix == ".toml" else _find_shipped(str(name))
    try:
        with source.open("rb") as stream:
            content = stream.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise RecipeError(f"{name} has more than {MAX_BYTES} bytes. Use a smaller recipe")
        return content.decode("utf-8")
    except (FileNotFoundError, IsADirectoryError):
        hint = suggest(path.stem, list_names() + list_pretrained_names(), _list_shipped())
        if path.suffix:
            hint = suggest(path.name, [one.name for one in path.parent.glob("*.toml")], hint)
        raise RecipeError(f"no recipe {name}. {hint}") from None
    except (UnicodeDecodeError, OSError) as e:
        raise RecipeError(f"{name} cannot be read: {e}. Give a TOML text file") from e


def load(name: str | Path, kind: str, schema: type[Settings], flags: Any = None) -> Settings:
    """Load the settings of one stage from a recipe.

    Parameters
    ----------
    name
        Path, or the name of a shipped recipe.
    kind
        Required kind, such as "train".
    schema
        Settings dataclass of the stage.
    flags
        Dataclass of settings that replace the recipe's, where they are not None.

    Raises
    ------
    RecipeError
        If the recipe does not exist, is not TOML, has another kind, or any key is wrong. Names
        all wrong keys.
    SettingError
        If a flag is out of range.
    """
    keys = read(name)
    check_kind(name, keys, kind)
    settings: Any = check(name, {k: v for k, v in keys.items() if k != "kind"}, schema)
    given = {} if flags is None else asdict(flags)
    try:
        loaded: Settings = replace(settings, **{k: v for k, v in given.items() if v is not None})
    except ValueError as e:
        raise SettingError(f"{e}. Give another value") from None
    return loaded


def check(name: str | Path, keys: Mapping[str, Any], schema: type[Settings]) -> Settings:
    """Create an instance of a settings dataclass from a recipe's keys.

    Raises
    ------
    RecipeError
        If keys are wrong. Names the recipe and all wrong keys.
    """
    if wrong := find_faults(keys, schema):
        raise recipe_error(name, wrong)
    return schema(**_validate_keys(keys, schema))


def _recipe_files() -> Traversable:
    return files("dmrl.recipes")


def _names_in(folder: Traversable) -> list[str]:
    return sorted(f.name[:-5] for f in folder.iterdir() if f.name.endswith(".toml"))


def _find_shipped(name: str) -> Traversable:
    """Return the file of a shipped recipe, whether it exists or not."""
    folder = _recipe_files() / PRETRAINED if name in list_pretrained_names() else _recipe_files()
    return folder / f"{name}.toml"


def _list_shipped() -> str:
    """Return the names of all shipped recipes as one line for errors."""
    others = ", ".join(list_pretrained_names())
    return f"Shipped ones: {', '.join(list_names())}; those of the shipped networks: {others}"


def _parse_recipe(name: str | Path, content: str) -> dict[str, Any]:
    try:
        return parse_toml(content)
    except ValueError as e:
        raise RecipeError(f"{name} is not TOML: {e}. Fix that line") from e


def check_kind(name: str | Path, keys: Mapping[str, Any], kind: str) -> None:
    """Raise RecipeError unless a recipe has this kind.

    Raises
    ------
    RecipeError
        If it has another kind, or none.
    """
    if (found := keys.get("kind")) != kind:
        has = f"is of kind {found!r}" if found is not None else "has no kind"
        raise RecipeError(f'{name} {has}. Use a recipe with: kind = "{kind}"')


def recipe_error(name: str | Path, wrong: Iterable[str]) -> RecipeError:
    """Return the one-line error that names all faults of a recipe."""
    lines = list(wrong)
    many = len(lines) > 1
    keys, fix = (f"{len(lines)} wrong keys", "them all") if many else ("1 wrong key", "it")
    words = "; ".join(lines)
    end = "" if words.endswith("?") else "."
    return RecipeError(f"{name} has {keys}: {words}{end} Fix {fix}")


def find_argument_fault(value: Any, hint: Any) -> str:
    """Return the fault of a value for an argument of this annotation, or an empty text."""
    try:
        to_argument(value, hint)
    except ValidationError as e:
        return "; ".join(d["msg"].lower() for d in e.errors())
    return ""


def to_argument(value: Any, hint: Any) -> Any:
    """Convert a TOML value to an argument of this annotation.

    Raises
    ------
    ValueError
        If the value does not fit the annotation.
    """
    return TypeAdapter(hint).validate_json(json.dumps(value, default=str), strict=True)


def to_json_values(values: Any) -> Any:
    """Convert settings to JSON values."""
    return json.loads(json.dumps(values, default=str))


@cache
def _build_model(schema: type[Any]) -> type[BaseModel]:
    hints = get_type_hints(schema)
    required = {f.name for f in fields(schema) if f.default is f.default_factory is MISSING}
    keys = {n: (t, ... if n in required else None) for n, t in hints.items()}
    config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)
    with warnings.catch_warnings():
        # A setting may have the name of a pydantic method: only the fields are read.
        warnings.filterwarnings("ignore", "Field name .* shadows an attribute")
        model: type[BaseModel] = create_model(schema.__name__, __config__=config, **keys)  # type: ignore[call-overload]
    return model


def _validate_keys(keys: Mapping[str, Any], schema: type[Any]) -> dict[str, Any]:
    # JSON, because pydantic's strict mode accepts lists as tuples and text as paths only there.
    model = _build_model(schema)  # type: ignore[arg-type] # a class has a hash
    made = model.model_validate_json(json.dumps(keys, default=str))
    return {name: _keep_remote(getattr(made, name), keys[name]) for name in keys}


def _keep_remote(value: Any, given: Any) -> Any:
    """Return a path in a bucket as such: pydantic's ``Path`` has lost a slash of its scheme."""
    if isinstance(value, dict) and isinstance(given, Mapping):
        return {key: _keep_remote(one, given[key]) for key, one in value.items() if key in given}
    return to_path(str(given)) if isinstance(value, Path) else value


def find_faults(keys: Any, schema: type[Any]) -> list[str]:
    """List the faults in keys of a settings dataclass, one line each."""
    try:
        values = _validate_keys(keys, schema)
        schema(**values)
    except ValidationError as e:
        return [_describe_fault(fault, schema) for fault in e.errors()]
    except (ValueError, UnsafeName) as e:
        return [str(e)]
    return list(_iter_range_faults(values, schema))


def _iter_range_faults(
    values: Mapping[str, Any], schema: type[Any], within_key: str = ""
) -> Iterator[str]:
    """Yield faults that a dataclass's command-line validators find, of its tables too."""
    hints = get_type_hints(schema, include_extras=True)
    for name, value in values.items():
        if is_dataclass(value) and not isinstance(value, type):
            inner = {one.name: getattr(value, one.name) for one in fields(value)}
            yield from _iter_range_faults(inner, type(value), f"{within_key}{name}.")
        # An optional number, such as Share | None, has its limits within the union.
        within = () if value is None else get_args(hints[name])
        for kind in (hints[name], *within):
            for note in getattr(kind, "__metadata__", ()):
                for validator in getattr(note, "validator", ()):
                    try:
                        validator(type(value), value)
                    except (ValueError, TypeError) as e:
                        yield f"{within_key}{name}: {str(e)[:1].lower()}{str(e)[1:].rstrip('.')}"


def _describe_fault(fault: Any, schema: type[Any]) -> str:
    """Describe a fault that pydantic found, in plain words; of an unknown key, the nearest one."""
    where, words = ".".join(map(str, fault["loc"])), fault["msg"]
    if fault["type"] == "extra_forbidden":
        return describe_unknown_key(where, [f.name for f in fields(schema)])
    plain = words.removeprefix("Value error, ") if "Value error" in words else words.lower()
    return f"{where}: {plain}"


def describe_unknown_key(key: str, known: Iterable[str]) -> str:
    """Return the fault of a key that does not exist, with the nearest one that does."""
    near = suggest(key, known, "").replace("Did", "did")
    return f"{key}: extra inputs are not permitted" + (f" ({near})" if near else "")
