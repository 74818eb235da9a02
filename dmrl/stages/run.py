"""``dmrl run``: the steps of a pipeline recipe."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter, validators

from dmrl.evaluation.report import report
from dmrl.pipeline import run as pipeline
from dmrl.terminal.arguments import On
from dmrl.terminal.tables import print_line


def command(
    recipe: str,
    /,
    *,
    out: Path | None = None,
    data: Path | None = None,
    workers: Annotated[int | None, Parameter(validator=validators.Number(gte=1))] = None,
    on: On = None,
    as_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> None:
    """Run the steps of a pipeline recipe whose outputs are not up to date, side by side.

    Parameters
    ----------
    recipe
        A TOML file, or the name of a shipped recipe, such as published.
    out
        Folder for every output. Without it, the recipe's name.
    data
        Folder with the data that the recipe reads and that does not ship with dmrl.
    workers
        Steps that run at a time, at most. Without it, as many as there are cores. Changes no byte.
    as_json
        Print one JSON document in place of the tables.
    """
    folder = Path(Path(recipe).stem) if out is None else out
    report(pipeline.run(recipe, folder, data, workers=workers, on=on), as_json=as_json)
    if not as_json:
        print_line(f"On one page: dmrl report {folder}")
