"""run: every stage of a pipeline recipe, in order."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dmrl import pipeline
from dmrl.evaluation.report import report


def command(
    recipe: str,
    /,
    *,
    out: Path | None = None,
    data: Path | None = None,
    as_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> None:
    """Run every stage of a pipeline recipe, in order; go on where it stopped.

    Parameters
    ----------
    recipe
        A TOML file, or the name of a shipped recipe, such as published.
    out
        Folder for every output. Without it, the recipe's name.
    data
        Folder with the data that the recipe reads and that does not ship with dmrl.
    as_json
        Print one JSON document in place of the tables.
    """
    folder = Path(Path(recipe).stem) if out is None else out
    report(pipeline.run(recipe, folder, data), as_json=as_json)
