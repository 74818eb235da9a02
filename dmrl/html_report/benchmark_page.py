"""One page of all submissions to the benchmark in a folder."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dmrl.atomic_output import replace_file
from dmrl.guards.bounded_parsing import parse_json
from dmrl.html_report.blocks import Block, Table, build_page

PAGE = "benchmark.html"
TITLES = {
    "detect": "Detect",
    "follow": "Follow",
    "label_with_uwb": "Label with UWB",
    "label_without_uwb": "Label without UWB",
}


def write_benchmark_page(folder: Path) -> Path | None:
    """Write the page of the submissions in a folder; return None if there are none."""
    found = sorted(folder.glob("submission-*.json"))
    documents = [parse_json(path.read_text(encoding="utf-8")) for path in found]
    if not documents:
        return None
    sections = [(title, _build_task(task, documents)) for task, title in TITLES.items()]
    lead = "Mean over the sealed seeds, and standard deviation over them. See docs/benchmark.md."
    with replace_file(folder / PAGE) as partial:
        partial.write_text(build_page("Benchmark", lead, sections), encoding="utf-8")
    return folder / PAGE


def _build_task(task: str, documents: list[Mapping[str, Any]]) -> list[Block]:
    scored = [one for one in documents if task in one["tasks"]]
    if not scored:
        return []
    names = list(scored[0]["tasks"][task])
    rows = [[one["submission"], *map(_format, one["tasks"][task].values())] for one in scored]
    return [Table(["submission", *names], rows)]


def _format(figure: Mapping[str, Any]) -> str:
    if figure["mean"] is None:
        return "-"
    spread = "" if figure["std"] is None else f" ± {figure['std']:.2g}"
    return f"{figure['mean']:.3g}{spread} ({len(figure['values'])})"
