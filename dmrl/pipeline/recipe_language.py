"""Language of pipeline recipes: the steps that a table of a recipe expands to.

``[each]`` gives names a range ("1-144"), a list, or rows with values of their own. A name in a
step's ``out`` repeats the step; one in another value alone gathers. This module knows no stages: a
step is a table that is filled in, and `plan` interprets it.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import product
from math import prod
from typing import Any, TypeVar

from dmrl.errors import suggest
from dmrl.guards import limits

NAME = re.compile(r"\{([A-Za-z_]\w*)(?:\.([A-Za-z_]\w*))?\}")
RANGE = re.compile(r"(0|[1-9]\d{0,8})-(0|[1-9]\d{0,8})")
DATA = "data"
"""``{data}`` is no name of a recipe: it is the folder given with ``--data``."""

Table = dict[str, Any]
Leaf = TypeVar("Leaf")
Values = Sequence[Any]
Bound = Mapping[str, Any]


MISSING_VALUE = object()
"""Value that a row does not have: a key with it is left out."""


class _NoStep(Exception):
    """A row lacks a value within a text of a step, so the step is left out."""


def expand_steps(recipe: Mapping[str, Any], faults: list[str]) -> list[tuple[int, Table]]:
    """Return every step of a recipe, with the number of its table, from 1.

    Parameters
    ----------
    recipe
        Its keys: ``step``, and ``each`` and ``defaults`` where it has them.
    faults
        List that faults are added to. With faults, steps may be missing.
    """
    each = _parse_each(recipe.get("each", {}), faults)
    defaults = _parse_defaults(recipe.get("defaults", {}), faults)
    steps = recipe.get("step")
    if not isinstance(steps, list) or not steps:
        faults.append("step: at least one [[step]] is required")
        return []
    made: list[tuple[int, Table]] = []
    room = [limits.STEPS, limits.GATHERED_VALUES, limits.STEP_CHARACTERS]
    used = {*_find_names(steps), *_find_names(defaults)}
    for number, step in enumerate(steps, start=1):
        where = f"step.{number}"
        if wrong := _check_step(step, each, room):
            faults.append(where + wrong)
            continue
        usual = defaults.get(str(step.get("stage")), {})
        made += [(number, one) for one in _repeat_step(step, usual, each)]
    _report_unused(each, defaults, steps, used, faults)
    return made


def _parse_each(table: Any, faults: list[str]) -> dict[str, Values]:
    if not isinstance(table, dict):
        faults.append('each: must be a table, such as [each] and flight = "1-144"')
        return {}
    found = {}
    for name, value in table.items():
        values = _parse_values(value)
        if isinstance(values, str):
            faults.append(f"each.{name}: {values}")
        elif name == DATA or not NAME.fullmatch(f"{{{name}}}"):
            faults.append(f"each.{name}: cannot be a name. Use letters, digits and _, not data")
        else:
            found[name] = values
    return found


def _parse_values(value: Any) -> Values | str:
    """Return the values of a name, or its fault."""
    if isinstance(value, str) and (match := RANGE.fullmatch(value)):
        return _parse_range(value, int(match[1]), int(match[2]))
    if not isinstance(value, list) or not value:
        return 'must be a range, such as "1-144", or a list that is not empty'
    return _check_list(value) or value


def _parse_range(text: str, first: int, last: int) -> Values | str:
    """Return the numbers from the first to the last, or the fault."""
    if first > last:
        return f"{text} runs backwards. Write the smaller number first"
    if last - first >= limits.STEPS:
        return f"{text} is too long. A recipe may have {limits.STEPS} steps"
    return range(first, last + 1)


def _check_list(values: list[Any]) -> str:
    """Return the fault of a list of values; empty: there is none."""
    if len(values) > limits.STEPS:
        return f"is too long. A recipe may have {limits.STEPS} steps"
    plain = all(isinstance(v, int | float | str) and not isinstance(v, bool) for v in values)
    tables = all(isinstance(v, dict) and v for v in values)
    if not plain and not tables:
        return "must hold numbers, texts, or tables, all of one kind"
    if any(values.index(v) != k for k, v in enumerate(values)):
        return "has a value twice"
    return ""


def _parse_defaults(table: Any, faults: list[str]) -> dict[str, Table]:
    if isinstance(table, dict) and all(isinstance(v, dict) for v in table.values()):
        return table
    faults.append("defaults: must hold a table per stage, such as [defaults.train]")
    return {}


def iter_leaves(value: Any, kind: type[Leaf]) -> Iterator[Leaf]:
    """Yield the values of a type in nested lists and tables."""
    if isinstance(value, kind):
        yield value
    elif isinstance(value, dict | list | tuple):
        for one in value.values() if isinstance(value, dict) else value:
            yield from iter_leaves(one, kind)


def _find_names(value: Any) -> dict[tuple[str, str | None], None]:
    """Return the names in a value in order, each with its row's key or None."""
    found = (m.groups() for text in iter_leaves(value, str) for m in NAME.finditer(text))
    return {(name, key): None for name, key in found if name != DATA}


def _check_step(step: Any, each: Mapping[str, Values], room: list[int]) -> str:
    """Return why a step cannot be repeated; empty: it can. Subtract its needs from ``room``."""
    if not isinstance(step, dict):
        return ": must be a table"
    for key in ("stage", "out"):
        if not isinstance(step.get(key), str):
            return f".{key}: a text is required"
    for name, field in _find_names(step):
        if wrong := _check_name(name, field, each):
            return f".out: {wrong}"
    repeats = {name for name, _ in _find_names(step["out"])}
    count = prod(len(each[name]) for name in repeats)
    gathered = sum(
        prod(len(each[name]) for name in {n for n, _ in _find_names(text)} - repeats)
        for text in iter_leaves(step, str)
    )
    for k, needs in enumerate((count, count * gathered, count * len(str(step)))):
        if needs > room[k]:
            return f".out: stands for too much. A recipe may have {limits.STEPS} steps in all"
        room[k] -= needs
    return ""


def _check_name(name: str, key: str | None, each: Mapping[str, Values]) -> str:
    if name not in each:
        return f"no {name} in [each]. {suggest(name, each, 'Add it')}"
    rows = isinstance(each[name][0], dict)
    if rows and key is None:
        return f"{{{name}}} has rows. Name a value of theirs: {{{name}.{min(each[name][0])}}}"
    if not rows and key is not None:
        return f"{{{name}.{key}}}: {name} has no rows. Write {{{name}}}"
    if rows and not any(key in row for row in each[name]):
        return f"no row of {name} has {key}. Fix one of them"
    return ""


def _report_unused(
    each: Mapping[str, Values],
    defaults: Mapping[str, Table],
    steps: list[Any],
    used: set[tuple[str, str | None]],
    faults: list[str],
) -> None:
    """Add a fault for each name and default that no step uses."""
    for name, values in each.items():
        keys = {k for row in values if isinstance(row, dict) for k in row} or {None}
        for key in sorted(keys - {k for n, k in used if n == name}, key=str):
            what = name if key is None else f"{name}.{key}"
            faults.append(f"each.{what}: no step names {{{what}}}")
    stages = {step.get("stage") for step in steps if isinstance(step, dict)}
    faults += [f"defaults.{s}: no step is of that stage" for s in sorted(set(defaults) - stages)]


def _repeat_step(step: Table, usual: Table, each: Mapping[str, Values]) -> Iterator[Table]:
    """Yield the step for all values of the names in its ``out``, where rows have these values."""
    names = list(dict.fromkeys(name for name, _ in _find_names(step["out"])))
    for values in product(*(each[name] for name in names)):
        bound = dict(zip(names, values, strict=True))
        try:
            own = _fill_names(step, bound, each)
            known = _fill_names({k: v for k, v in usual.items() if k not in own}, bound, each)
        except _NoStep:
            continue
        if "out" in own:
            yield {**known, **own, "out": str(own["out"])}


def _fill_names(value: Any, bound: Bound, each: Mapping[str, Values]) -> Any:
    """Return a value with names replaced; parts that name a missing value are left out."""
    match value:
        case str():
            return _fill_text(value, bound, each)
        case list():
            found: list[Any] = []
            for one in value:
                made = _fill_names(one, bound, each)
                found += made if isinstance(made, list) and isinstance(one, str) else [made]
            kept = [one for one in found if one is not MISSING_VALUE]
            return MISSING_VALUE if found and not kept else kept
        case dict():
            filled = {key: _fill_names(one, bound, each) for key, one in value.items()}
            return {key: one for key, one in filled.items() if one is not MISSING_VALUE}
    return value


def _fill_text(text: str, bound: Bound, each: Mapping[str, Values]) -> Any:
    """Return a text with names replaced, a list if a name gathers, or a value itself."""
    free = list(dict.fromkeys(name for name, _ in _find_names(text) if name not in bound))
    if not free:
        return _fill_bound(text, bound)
    found = []
    for choice in product(*(each[name] for name in free)):
        with suppress(_NoStep):
            found.append(_fill_bound(text, {**bound, **dict(zip(free, choice, strict=True))}))
    return [one for one in found if one is not MISSING_VALUE] or MISSING_VALUE


def _fill_bound(text: str, bound: Bound) -> Any:
    def value(match: re.Match[str]) -> Any:
        name, key = match.groups()
        if name == DATA:
            return match[0]
        return bound[name] if key is None else bound[name].get(key, MISSING_VALUE)

    if whole := NAME.fullmatch(text):
        return value(whole)
    if any(value(match) is MISSING_VALUE for match in NAME.finditer(text)):
        raise _NoStep
    return NAME.sub(lambda match: str(value(match)), text)
