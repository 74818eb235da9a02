"""Figures and numbers that a recipe defines for the top of its report.

``[[figure]]`` tables of a pipeline recipe. They name outputs of steps; `dmrl.html_report` draws
them.
"""

import re
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from dmrl import recipe as recipes

FIGURE_KEY, TITLE_KEY = "figure", "title"
MAX_FIGURES = 40
"""Figures of one recipe, at most."""
_FORMAT_PATTERN = re.compile(r",?(\.\d{1,2})?[efg%]")
"""Allowed number formats: no width, since a large one would need gigabytes of spaces."""


@dataclass(frozen=True, slots=True)
class ReportedValue:
    """A measured value beside a published one.

    Parameters
    ----------
    what
        Name of the value.
    published
        The published value, as text; empty: not published.
    of
        A JSON document: an output of a step, or a file in it if the output is a folder.
    at
        Path of the value in it: keys and indices separated by dots, such as
        overall.median_px.value. In a list, a word selects the table that has it as a value.
    form
        Python format of the value, such as .1%.
    """

    what: str
    of: str
    at: str
    published: str = ""
    form: str = ".3g"


@dataclass(frozen=True, slots=True)
class FigureSpec:
    """A figure of a recipe's report.

    Parameters
    ----------
    title
        Its heading.
    shows
        losses: loss curves of trainings. images: images with detections. errors: violin plots.
        maps: maps of confidence and depth from several computations. numbers: a table.
    of
        Outputs of steps: of train for losses, of evaluate for images and errors; recordings of
        the same images, by predict, for maps.
    named
        A label for each of them. Default: their names.
    words
        Text above the figure, such as the published result.
    rows
        Rows of numbers.
    """

    title: str
    shows: Literal["losses", "images", "errors", "maps", "numbers"]
    of: tuple[str, ...] = ()
    named: tuple[str, ...] = ()
    words: str = ""
    rows: tuple[ReportedValue, ...] = ()

    @property
    def outputs(self) -> list[str]:
        """Outputs of steps that the figure reads."""
        return [*self.of, *(row.of for row in self.rows)]

    def output_label(self, place: int) -> str:
        """Return the label of one of its outputs."""
        return self.named[place] if place < len(self.named) else self.of[place]


def read_figures(name: str | Path, recipe: Mapping[str, Any]) -> list[FigureSpec]:
    """Read the figures of a recipe; empty if it defines none.

    Raises
    ------
    RecipeError
        If a table is invalid.
    """
    if wrong := list(iter_faults(recipe)):
        raise recipes.recipe_error(name, wrong)
    return [recipes.check(name, table, FigureSpec) for table in recipe.get(FIGURE_KEY, [])]


def iter_faults(recipe: Mapping[str, Any], outs: Set[str] | None = None) -> Iterator[str]:
    """Yield the errors in the figures of a recipe.

    Parameters
    ----------
    recipe
        Its keys.
    outs
        Outputs of its steps. None: unknown.
    """
    if not isinstance(recipe.get(TITLE_KEY, ""), str):
        yield f"{TITLE_KEY}: must be a text"
    tables = recipe.get(FIGURE_KEY, [])
    if not isinstance(tables, list) or len(tables) > MAX_FIGURES:
        yield f"{FIGURE_KEY}: must be [[{FIGURE_KEY}]] tables, {MAX_FIGURES} at most"
        return
    for number, table in enumerate(tables, start=1):
        where = f"{FIGURE_KEY}.{number}"
        wrong = ["must be a table"]
        if isinstance(table, dict):
            wrong = list(recipes.find_faults(table, FigureSpec))
        yield from (f"{where}.{fault}" for fault in wrong)
        if not wrong:
            shown = recipes.check("", table, FigureSpec)
            yield from (f"{where}.{fault}" for fault in _iter_spec_faults(shown, outs))


def _iter_spec_faults(shown: FigureSpec, outs: Set[str] | None) -> Iterator[str]:
    needs, unused = ("rows", "of") if shown.shows == "numbers" else ("of", "rows")
    if not getattr(shown, needs) or getattr(shown, unused):
        yield f"{needs}: {shown.shows} needs {needs}, and no {unused}"
    if len(shown.named) > len(shown.of):
        yield "named: has more words than there are outputs"
    for name in shown.outputs:
        parts = name.split("/")
        if ".." in parts or (outs is not None and parts[0] not in outs):
            yield f"of: no step writes {name}. Name a step's out"
    for row in shown.rows:
        if not _FORMAT_PATTERN.fullmatch(row.form):
            yield f"rows: {row.form} is not a number format. Try: .2f, .1%"


def find_value(document: Any, at: str) -> float | int | str | None:
    """Return the value at a path of a JSON document; None if the path does not exist.

    Parameters
    ----------
    document
        A document.
    at
        See `ReportedValue`.
    """
    for part in at.split("."):
        try:
            inside = _get_from_list if isinstance(document, list) else _get_from_table
            document = inside(document, part)
        except (KeyError, IndexError, TypeError, StopIteration):
            return None
    return document if isinstance(document, float | int | str) else None


def _get_from_table(table: Any, part: str) -> Any:
    return table[part]


def _get_from_list(rows: list[Any], part: str) -> Any:
    if part.lstrip("-").isdecimal():
        return rows[int(part)]
    return next(row for row in rows if isinstance(row, dict) and part in row.values())
