"""``dmrl run``: the steps of a pipeline recipe."""

from pathlib import Path
from types import ModuleType
from typing import Annotated

from cyclopts import Parameter, validators

from dmrl.errors import MissingExtra
from dmrl.evaluation.pipeline_summary import report
from dmrl.pipeline import recipe_run as pipeline
from dmrl.terminal.arguments import AsJson, On
from dmrl.terminal.progress import say
from dmrl.terminal.tables import print_line

pages: ModuleType | None
try:
    from dmrl import html_report as pages
except MissingExtra:
    pages = None


def command(
    recipe: str,
    /,
    *,
    out: Path | None = None,
    data: Path | None = None,
    workers: Annotated[int | None, Parameter(validator=validators.Number(gte=1))] = None,
    on: On = None,
    as_json: AsJson = False,
) -> None:
    """Run the steps of a pipeline recipe whose outputs are not up to date, side by side.

    A recipe with figures, such as paper, ends with report.html in its folder.

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
    plan, before = pipeline.load(recipe), pipeline.kept_recipe(folder)
    done = pipeline.run(recipe, folder, data, workers=workers, on=on)
    report(done, as_json=as_json)
    changed = plan.text != before or not all(one.skipped for one in done)
    page = _page(folder, changed=changed) if plan.pictured else None
    if not as_json:
        print_line(
            f"{page}: open it in a browser" if page else f"On one page: dmrl report {folder}"
        )


def _page(folder: Path, *, changed: bool) -> Path | None:
    """The page of a recipe with figures, drawn if anything changed; None where it cannot be."""
    there = folder / "report.html"
    if there.is_file() and not changed:
        return there
    if pages is None:
        say("no page: that needs matplotlib. pip install 'dmrl[plot]', then dmrl report")
        return None
    written: Path = pages.write(folder)
    return written
