"""Result of an evaluation as an object: figures by name, and a table in a notebook."""

from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from dmrl.api import notebook_display


class Result(Mapping[str, Any]):
    """Figures by name, as ``dmrl evaluate --json`` prints them.

    Parameters
    ----------
    document
        The figures: numbers, texts, lists and mappings; None if nothing could be measured.
    title, columns, rows
        The table that the command prints.
    """

    def __init__(
        self,
        document: Mapping[str, Any],
        title: str,
        columns: Sequence[str],
        rows: Sequence[Sequence[Any]],
    ) -> None:
        self._document = document
        self._table = title, columns, rows

    def __getitem__(self, name: str) -> Any:
        """Return a figure, or the figures below a name.

        Raises
        ------
        KeyError
            If there is none of that name.
        """
        return self._document[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._document)

    def __len__(self) -> int:
        """Return the number of names."""
        return len(self._document)

    def __repr__(self) -> str:
        title, columns, rows = self._table
        lines = ["  ".join(map(str, row)) for row in [columns, *rows]]
        return "\n".join([title, *lines])

    def _repr_html_(self) -> str:
        return notebook_display.html_table(*self._table)


def evaluate_recordings(recordings: Sequence[Path], settings: Any) -> Result:
    """Return the result of ``dmrl.stages.evaluate`` for recordings."""
    report = import_module("dmrl.evaluation.detection_report")
    found = import_module("dmrl.stages.evaluate").run(recordings, None, settings)
    named = str(recordings[0]) if len(recordings) == 1 else f"{len(recordings)} recordings"
    if isinstance(found, dict):
        kind = import_module("dmrl.evaluation.evaluate_recordings").find_module(found)
        columns = [kind.EACH, *(words for _, words, _ in kind.COLUMNS)]
        return Result(found, f"{named}: {kind.TITLE}", columns, kind.rows(found))
    document = report.describe_evaluation(recordings, found)
    tables = import_module("dmrl.evaluation.figure_tables")
    headers, rows = tables.build_band_table([document["overall"], *document["bands"]])
    columns = ["detection minus label", *headers]
    return Result(document, f"{named}: {found.pairs.images} images", columns, rows)
