"""Kinds of arguments that several commands take."""

from pathlib import Path
from typing import Annotated, TypeVar

from cyclopts import Parameter, validators

T = TypeVar("T")
In = Annotated[Path, Parameter(name="IN")]
"""What is read, called IN in the help."""
Flat = Annotated[T, Parameter(name="*")]
"""A dataclass, ``Flat[Settings]``: each of its fields is a flag."""
AsJson = Annotated[bool, Parameter(name="--json", negative=())]
"""Whether one JSON document is printed in place of the table."""
Seed = Annotated[int, Parameter(validator=validators.Number(gte=0))]
"""Of everything drawn at random."""
Share = Annotated[float, Parameter(validator=validators.Number(gte=0, lte=1))]
On = Annotated[
    str | None,
    Parameter(
        help="Do it on a cluster: ray for the Ray cluster that this machine is part of (or this "
        "machine alone), ray://HOST:PORT for another, slurm to write an array job. Changes no byte."
    ),
]
"""Where it is done, if not here."""
Workers = Annotated[int | None, Parameter(validator=validators.Number(gte=1))]
"""How many processes work side by side."""
