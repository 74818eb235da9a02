"""``dmrl run``: the steps of a pipeline recipe."""

import re
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dmrl.errors import MissingExtra, SettingError
from dmrl.storage import to_path
from dmrl.terminal.arguments import AsJson, On, Recipe, Workers
from dmrl.terminal.progress import say
from dmrl.terminal.tables import print_json, print_line, print_table

if TYPE_CHECKING:
    from dmrl.pipeline.recipe_run import Forecast


def command(
    recipe: Recipe,
    /,
    *,
    out: Path | None = None,
    data: Path | None = None,
    network: Path | None = None,
    labels: Path | None = None,
    dry_run: Annotated[bool, Parameter(negative=())] = False,
    workers: Workers = None,
    on: On = None,
    as_json: AsJson = False,
) -> None:
    """Run the steps of a pipeline recipe whose outputs are not up to date, side by side.

    RECIPE may be a recording that dmrl wrote: it is made again as OUT, from its provenance, and
    both are compared.

    An output that is made again replaces the one before, which moves to previous/ in the folder.
    A recipe with figures, such as paper, ends with report.html in its folder.

    Parameters
    ----------
    recipe
        A TOML file, the name of a shipped recipe, such as published, or a recording.
    out
        Folder for every output. Without it, the recipe's name. For a recording, the new one.
    data
        Folder with the data that the recipe reads and that does not ship with dmrl, or with
        the inputs of a recording.
    network
        Network that the recipe benchmark scores, such as an ONNX file.
    labels
        CSV of positions that the recipe benchmark scores.
    dry_run
        Print what the run would make and replace, and why. Write nothing.
    workers
        Steps that run at a time, at most. Without it, one per core. Does not affect the output.
    """
    from dmrl.evaluation.pipeline_summary import print_report
    from dmrl.pipeline import recipe_run as pipeline
    from dmrl.pipeline.plan import load_plan

    if recipe.endswith(".mcap"):
        _rebuild(to_path(recipe), out, data, as_json=as_json)
        return
    folder = Path(Path(recipe).stem) if out is None else out
    given = _submitted("network", "name", network) | _submitted("labels", "csv", labels)
    if dry_run:
        _print_forecast(pipeline.forecast(recipe, folder, data, given), as_json=as_json)
        return
    plan, before = load_plan(recipe, given), pipeline.read_recipe_text(folder)
    done = pipeline.run(recipe, folder, data, workers=workers, on=on, submitted=given)
    print_report(done, as_json=as_json)
    if any(one.stage == "score" for one in done):
        from dmrl.html_report.benchmark_page import write_benchmark_page

        scored = write_benchmark_page(folder)
        if not as_json:
            print_line(f"{scored}: all submissions")
    changed = plan.text != before or not all(one.skipped for one in done)
    page = _write_page(folder, changed=changed) if plan.pictured else None
    if not as_json:
        print_line(
            f"{page}: open it in a browser" if page else f"On one page: dmrl report {folder}"
        )


def _rebuild(source: Path, out: Path | None, data: Path | None, *, as_json: bool) -> None:
    """Make a recording again, and print the differences."""
    from dmrl.pipeline.rebuild import rebuild

    if out is None:
        raise SettingError(f"{source} is made again as another file. Name it: --out NEW.mcap")
    found = rebuild(source, out, data)
    if as_json:
        print_json({"same": not found, "differences": [asdict(one) for one in found]})
        return
    if found:
        rows = [(one.what, one.before, one.after) for one in found]
        print_table("", ("came out otherwise", "before", "now"), rows)
    print_line(f"{out}: {'differs from' if found else 'the same messages as'} {source}")


def _print_forecast(found: "list[Forecast]", *, as_json: bool) -> None:
    """Print the plan of a run, a row for each step."""
    if as_json:
        print_json({"steps": [asdict(one) for one in found]})
        return
    rows = [(one.stage, one.out, one.action, one.reason) for one in found]
    print_table("", ("step", "output", "would", "because"), rows)


def _submitted(each: str, key: str, path: Path | None) -> dict[str, dict[str, str]]:
    """Return the row of a submitted file, named by its stem; empty: there is none."""
    if path is None:
        return {}
    if not path.exists():
        raise SettingError(f"no {path}. Check --{each}")
    stem = re.sub(r"[^\w.-]+", "-", path.stem).strip("-.") or "submission"
    return {each: {key: stem, "file": str(path.absolute())}}


def _write_page(folder: Path, *, changed: bool) -> Path | None:
    """Write the page of a recipe with figures, if anything changed; None where it cannot be."""
    there = folder / "report.html"
    if there.is_file() and not changed:
        return there
    try:
        from dmrl.html_report import write_html_report
    except MissingExtra:
        say("no page: that needs matplotlib. pip install 'dmrl[plot]', then dmrl report")
        return None
    return write_html_report(folder)
