"""Types of arguments that several commands share."""

from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, TypeVar

from cyclopts import Parameter, validators

T = TypeVar("T")


def _load(module: str) -> Any:
    """Import a module by its name: it is above this room, and needed by the shell alone."""
    return import_module(module)


def _complete_files(start: str) -> list[str]:
    """Return the files that a word may stand for; a folder ends in a slash."""
    found = sorted(Path(start).parent.glob("*") if "/" in start else Path().glob("*"))
    return [f"{path}/" if path.is_dir() else str(path) for path in found]


def complete_recipe(context: Any) -> list[str]:
    """Return the names of the shipped recipes, and files."""
    return [*_load("dmrl.recipe").list_names(), *_complete_files(context.incomplete)]


def complete_model(context: Any) -> list[str]:
    """Return the names of the shipped networks, and files."""
    return [*_load("dmrl.learn.pretrained").list_pretrained(), *_complete_files(context.incomplete)]


def _read_topics(context: Any) -> list[str]:
    """Return the topics of the recordings that stand in the line so far."""
    read_summary = _load("dmrl.recording").read_summary
    words = (token.value for argument in context.arguments for token in argument.tokens)
    paths = [Path(word) for word in words if word.endswith(".mcap")]
    return sorted({topic for path in paths if path.exists() for topic in read_summary(path).topics})


def complete_topic(context: Any) -> list[str]:
    """Return the topics of the recordings that stand in the line so far."""
    return _read_topics(context)


def complete_robot(context: Any) -> list[str]:
    """Return the robots of the recordings that stand in the line so far."""
    return sorted({topic.split("/")[1] for topic in _read_topics(context) if topic.count("/") > 1})


Recipe = Annotated[str, Parameter(completer=complete_recipe)]
"""A recipe: a TOML file, or the name of a shipped one."""
Model = Annotated[Path, Parameter(completer=complete_model)]
"""A model: a path, or the name of a shipped network."""
Robot = Annotated[str, Parameter(completer=complete_robot)]
In = Annotated[Path, Parameter(name="IN")]
"""Input, called IN in the help."""
Flat = Annotated[T, Parameter(name="*")]
"""A dataclass, ``Flat[Settings]``: each of its fields is a flag."""
AsJson = Annotated[
    bool,
    Parameter(name="--json", negative=(), help="Print one JSON document in place of the table."),
]
"""Whether the result is printed as JSON."""
Strict = Annotated[bool, Parameter(negative=())]
"""Whether anything that is left out is an error; see `dmrl.terminal.left_out`."""
Seed = Annotated[int, Parameter(validator=validators.Number(gte=0))]
"""Seed of all random numbers."""
Share = Annotated[float, Parameter(validator=validators.Number(gte=0, lte=1))]
Positive = Annotated[float, Parameter(validator=validators.Number(gt=0, lt=1e6))]
Count = Annotated[int, Parameter(validator=validators.Number(gte=1))]
On = Annotated[
    str | None,
    Parameter(
        help="Do it on a cluster: ray for the Ray cluster that this machine is part of (or this "
        "machine alone), ray://HOST:PORT for another. Does not affect the output."
    ),
]
"""Cluster that runs the command; None: this machine."""
Workers = Annotated[int | None, Parameter(validator=validators.Number(gte=1))]
"""Number of processes side by side; None: one per core."""
FolderWorkers = Annotated[
    Workers,
    Parameter(
        help="Of a folder: recordings at a time, at most. Without it, as many as there are "
        "cores. Does not affect the output."
    ),
]
"""`Workers` of a command that takes a folder."""
