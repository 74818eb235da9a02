"""Types of arguments that several commands share."""

from pathlib import Path
from typing import Annotated, TypeVar

from cyclopts import Parameter, validators

T = TypeVar("T")
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
On = Annotated[
    str | None,
    Parameter(
        help="Do it on a cluster: ray for the Ray cluster that this machine is part of (or this "
        "machine alone), ray://HOST:PORT for another, slurm to write an array job. Changes no byte."
    ),
]
"""Cluster that runs the command; None: this machine."""
Workers = Annotated[int | None, Parameter(validator=validators.Number(gte=1))]
"""Number of processes side by side; None: one per core."""
FolderWorkers = Annotated[
    Workers,
    Parameter(
        help="Of a folder: recordings at a time, at most. Without it, as many as there are "
        "cores. Changes no byte."
    ),
]
"""`Workers` of a command that takes a folder."""
