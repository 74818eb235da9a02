"""Build the section of a report that shows where its outputs come from."""

from collections.abc import Iterator, Mapping
from pathlib import PurePosixPath

from dmrl.html_report.blocks import Block, Figure, Table, build_row
from dmrl.html_report.collect import ReportInputs
from dmrl.html_report.lineage import draw_lineage
from dmrl.recording import Input, Provenance

MAX_VALUE_CHARACTERS = 60
"""Characters of a setting's value in a command line, at most."""
JUDGED_KINDS = ("evaluations", "positions", "tracks", "flights")
"""Documents of ``dmrl evaluate``."""


def build_provenance_section(found: ReportInputs) -> list[Block]:
    """Build a graph of all stages, their settings, and the versions of the packages."""
    svg = draw_lineage(found.made | dict(_iter_evaluations(found)))
    libraries: dict[str, set[str]] = {}
    for made in found.made.values():
        for package, version in {"dmrl": made.dmrl_version, **made.libraries}.items():
            libraries.setdefault(package, set()).add(str(version))
    versions = [(package, ", ".join(sorted(known))) for package, known in sorted(libraries.items())]
    rows = [(name, _format_command(made)) for name, made in found.made.items()]
    tables = [Table(("output", "made by"), rows), Table(("package", "version"), versions)]
    drawn = Figure("stages, from sources to results", svg=svg, full=True) if svg else None
    return build_row([drawn]) + [table for table in tables if table.rows]


def _iter_evaluations(found: ReportInputs) -> Iterator[tuple[str, Provenance]]:
    """Yield the origin of evaluations; their documents only name a recording."""
    made: dict[str, list[Provenance]] = {}
    for name, one in found.made.items():
        made.setdefault(PurePosixPath(name).name, []).append(one)
    for kind in JUDGED_KINDS:
        for name, document in found.documents.get(kind, {}).items():
            source = document.get("recording")
            if name in found.made or not isinstance(source, Mapping):
                continue
            file = str(source.get("name"))
            origins = made.get(file, [])
            origin = origins[0] if len(origins) == 1 else None
            yield (
                name,
                Provenance("evaluate", inputs=(Input(file, str(source.get("sha256")), origin),)),
            )


def _format_command(made: Provenance) -> str:
    most = MAX_VALUE_CHARACTERS
    words = (
        f"{name}={text if len(text) <= most else text[: most - 3] + '...'}"
        for name, text in made.list_settings()
    )
    return " ".join(["dmrl", made.stage, *words])
