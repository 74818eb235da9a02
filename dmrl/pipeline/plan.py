"""Plan of a recipe: its steps, with every stage, input, output and setting checked.

All faults are found and reported in one line, before anything runs.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from graphlib import CycleError, TopologicalSorter
from inspect import signature
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any

from dmrl import recipe as recipes
from dmrl.errors import RecipeError, UnsafeName, suggest
from dmrl.evaluation import figure_specs
from dmrl.geometry.camera_file import NAMED_CAMERAS
from dmrl.guards.safe_names import check_file_name
from dmrl.learn import pretrained
from dmrl.pipeline.recipe_language import expand_steps, iter_leaves
from dmrl.pipeline.stage_signature import StageSignature, signature_of
from dmrl.simulation.settings import NAMED_EYES

RECIPE_KEYS = ("kind", "each", "defaults", "step", figure_specs.TITLE_KEY, figure_specs.FIGURE_KEY)
STEP_KEYS = ("stage", "out", "optional", "recipe")
DATA = "{data}"
OTHER_SOURCE = "Name a step's out, or {data}/..."
SUBMITTED = ("network", "labels")
"""Names of ``[each]`` that flags of ``dmrl run`` add a row to."""
RECIPE_FILE, STATE_FILE, UNFINISHED = "recipe.toml", "pipeline.json", "unfinished"
PREVIOUS = "previous"
"""Folder of the outputs that a later run replaced."""
RESERVED_NAMES = (RECIPE_FILE, STATE_FILE, UNFINISHED, PREVIOUS, "report.html")

Table = dict[str, Any]
NOTHING: Mapping[str, Table] = MappingProxyType({})
"""No submission."""


@dataclass(frozen=True, slots=True)
class Step:
    """One stage of a pipeline, to be run once.

    Parameters
    ----------
    stage
        Command name, such as "convert".
    out
        Name of the file or folder it writes in the pipeline's folder.
    inputs
        Names by role: outputs of other steps, ``{data}/...``, what ships, absolute paths.
    settings
        Keys of its settings, and other arguments; those of a recipe filled in.
    optional
        Whether the pipeline goes on if this step fails.
    """

    stage: str
    out: str
    inputs: Mapping[str, str | list[str]] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    optional: bool = False

    @property
    def signature(self) -> StageSignature:
        """Signature of its stage."""
        return signature_of(self.stage)

    @property
    def path_settings(self) -> Table:
        """Settings that name files or folders."""
        return {k: v for k, v in self.settings.items() if k in self.signature.paths}

    @property
    def names(self) -> list[str]:
        """Names of all inputs."""
        return list(iter_leaves([dict(self.inputs), self.path_settings], str))


@dataclass(frozen=True, slots=True)
class Plan:
    """Steps, the text of the recipe they were read from, and whether it has figures."""

    steps: tuple[Step, ...]
    text: str
    pictured: bool = False

    @property
    def needs_data(self) -> bool:
        """Whether a step reads below ``--data``."""
        return any(name.startswith(DATA) for step in self.steps for name in step.names)

    @property
    def order(self) -> TopologicalSorter[str]:
        """Order of the outputs: each with those that it is made of."""
        outs = {step.out for step in self.steps}
        return TopologicalSorter(
            {step.out: find_producers(step.names, outs) for step in self.steps}
        )


def map_strings(value: Any, function: Callable[[str], Any]) -> Any:
    """Return a TOML value with ``function`` applied to every text."""
    if isinstance(value, str):
        return function(value)
    if isinstance(value, list):
        return [map_strings(one, function) for one in value]
    if isinstance(value, dict):
        return {key: map_strings(one, function) for key, one in value.items()}
    return value


def find_producers(names: Iterable[str], outs: set[str]) -> list[str]:
    """Return the outputs that contain the named inputs, each once."""
    return list(dict.fromkeys(n.split("/")[0] for n in names if n.split("/")[0] in outs))


def locate_input(name: str, outs: set[str], folder: Path, data: Path | None) -> Path:
    """Return the path of an input."""
    if name.startswith(DATA) and data is not None:
        return data / name.removeprefix(DATA).lstrip("/")
    if name.split("/")[0] in outs:
        return folder / name
    if name in pretrained.list_pretrained():
        return pretrained.PRETRAINED_DIR / name
    return recipes.locate_recording(name) or Path(name)


def load_plan(name: str | Path, rows: Mapping[str, Table] = NOTHING) -> Plan:
    """Load a pipeline recipe, and find all its faults.

    Parameters
    ----------
    name
        Path, or the name of a shipped recipe.
    rows
        Further rows of its ``[each]``, by name, from the command line.

    Raises
    ------
    RecipeError
        If anything in it is wrong; names every wrong key.
    MissingExtra
        If a package that a stage needs is not installed.
    """
    text, keys = recipes.read_text(name), recipes.read(name)
    keys = _add_submitted(keys, rows)
    return Plan(tuple(_build_steps(name, keys)), text, figure_specs.FIGURE_KEY in keys)


def _add_submitted(keys: Table, rows: Mapping[str, Table]) -> Table:
    """Add rows to ``[each]``, and leave out the steps of a submission that is not there."""
    each, steps = keys.get("each", {}), keys.get("step")
    if not isinstance(each, dict) or not isinstance(steps, list):
        return keys
    each = each | {name: [*each.get(name, []), row] for name, row in rows.items()}
    absent = [f"{{{name}." for name in SUBMITTED if name not in each]
    kept = [step for step in steps if not any(name in str(step) for name in absent)]
    return {**keys, "each": each, "step": kept} if len(kept) < len(steps) or rows else keys


def _build_steps(name: str | Path, recipe: Table) -> list[Step]:
    recipes.check_kind(name, recipe, "pipeline")
    faults = [recipes.describe_unknown_key(k, RECIPE_KEYS) for k in recipe if k not in RECIPE_KEYS]
    found = []
    for number, table in expand_steps(recipe, faults):
        wrong: list[str] = []
        step = _build_step(table, wrong)
        faults += [f"step.{number}.{fault}" for fault in wrong]
        found.append((number, step))
    faults += _check_names(found)
    faults += figure_specs.iter_faults(recipe, {step.out for _, step in found})
    if faults:
        raise recipes.recipe_error(name, dict.fromkeys(faults))
    steps = [step for _, step in found]
    try:
        Plan(tuple(steps), "").order.prepare()
    except CycleError as e:
        circle = " of ".join(e.args[1])
        raise RecipeError(
            f"{name}: steps depend on each other in a cycle: {circle}. Remove one"
        ) from None
    if not steps:
        raise RecipeError(f"{name} expands to no step. Add the keys that `out` uses to its rows")
    return steps


def _build_step(table: Table, faults: list[str]) -> Step:
    """Build a step from a table; add its faults to ``faults``."""
    stage, optional = table["stage"], table.get("optional", False)
    own = {key: value for key, value in table.items() if key not in STEP_KEYS}
    try:
        takes = signature_of(stage)
        theirs = _recipe_settings(table.get("recipe", ""), stage)
        own = dict(takes.filled({**theirs, **own}))
    except RecipeError as e:
        faults.append(f"stage: {e}")
        return Step(stage, table["out"])
    if not isinstance(optional, bool):
        faults.append("optional: must be true or false")
    inputs = {key: own.pop(key) for key in list(own) if key in takes.roles}
    faults += [f for role in takes.roles if (f := _check_input(takes, role, inputs.get(role)))]
    inputs |= {k: [v] for k, v in inputs.items() if takes.roles[k].many and isinstance(v, str)}
    unknown = [key for key in own if key not in takes.keys]
    faults += [f"{key}: {_unknown_key(stage, key, takes)}" for key in unknown]
    known = {key: value for key, value in own.items() if key not in unknown}
    faults += _check_settings(takes, known)
    return Step(stage, table["out"], inputs, known, optional is True)


def _recipe_settings(name: Any, stage: str) -> Table:
    """Return the settings of a stage's own recipe."""
    if not isinstance(name, str):
        raise RecipeError("recipe: must be a path, or the name of a shipped recipe")
    return dict(_read_settings(name, stage)) if name else {}


@cache
def _read_settings(name: str, stage: str) -> Table:
    keys = recipes.read(name)
    recipes.check_kind(name, keys, stage)
    return {key: value for key, value in keys.items() if key != "kind"}


def _check_input(takes: StageSignature, role: str, value: Any) -> str:
    """Return the fault of an input; empty: there is none."""
    many = takes.roles[role].many
    if value is None:
        return f"{role}: is required" if takes.roles[role].required else ""
    if isinstance(value, str):
        return ""
    if not many:
        return f"{role}: takes one name, a text"
    right = isinstance(value, list) and value and all(isinstance(v, str) for v in value)
    return "" if right else f"{role}: must be a name, or a list of names that is not empty"


def _unknown_key(stage: str, key: str, takes: StageSignature) -> str:
    if key in signature(takes.run).parameters:
        return f"{stage} takes it on the command line alone. Leave it out"
    hint = suggest(key, takes.keys, f"See: dmrl {stage} --help")
    return f"{stage} has no such input or setting. {hint}"


def _check_settings(takes: StageSignature, given: Table) -> list[str]:
    own = {key: value for key, value in given.items() if key not in takes.others}
    faults = recipes.find_faults(own, takes.settings) if takes.settings else []
    missing = [f"{key}: is required" for key in takes.others if key not in given]
    others = [
        f"{key}: {fault}"
        for key, hint in takes.others.items()
        if key in given and (fault := recipes.find_argument_fault(given[key], hint))
    ]
    return [*faults, *missing, *others]


def _check_names(found: Sequence[tuple[int, Step]]) -> Iterator[str]:
    """Yield the faults of the names of outputs and inputs."""
    outs = {step.out for _, step in found}
    seen: dict[str, str] = {}
    for number, step in found:
        before = seen.setdefault(step.out.casefold(), step.out)
        if wrong := _check_output_name(step.out):
            yield f"step.{number}.out: {wrong}"
        elif before is not step.out:
            yield f"step.{number}.out: {step.out} is written by two steps. Name another"
        for name in step.names:
            if wrong := _check_source_name(name, outs):
                yield f"step.{number}: {step.stage} reads {name}, {wrong}"


def _check_output_name(name: str) -> str:
    try:
        check_file_name(name, "out")
        plain = "{" not in name and "}" not in name
    except UnsafeName:
        plain = False
    if not plain:
        return f"{name[:80]!r} is no plain name. No slashes, no braces, no dot in front"
    if name.casefold() in RESERVED_NAMES or name.casefold().endswith(".partial"):
        return f"{name} is a name that dmrl uses itself. Choose another"
    return ""


def _check_source_name(name: str, outs: set[str]) -> str:
    """Return the fault of an input's name; empty: there is none."""
    head, *_ = name.split("/")
    if ".." in PurePosixPath(name).parts:
        return "which leads out of its folder. Write it without .."
    shipped = (*NAMED_CAMERAS, *NAMED_EYES, *pretrained.list_pretrained())
    if head in (*outs, DATA) or name in shipped or recipes.locate_recording(name):
        return ""
    if name.startswith("/"):
        return "" if Path(name).exists() else "which is not there. Check the name"
    return f"which no step writes. {suggest(head, outs, OTHER_SOURCE)}"
