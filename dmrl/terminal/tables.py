"""Results on standard output: a table for people, JSON for programs."""

import json
import sys
from collections.abc import Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from dmrl.errors import to_one_line

NOTE_CHARACTERS = 100
NOT_A_TERMINAL_COLUMNS = 200  # a pipe has no width; wrapped rows cannot be searched


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print a table. A column whose values are all numbers is set flush right.

    Parameters
    ----------
    title
        Line above the table; empty for none.
    columns
        Headers, with the unit where there is one.
    rows
        One sequence per row, as long as ``columns``. None prints as nothing.

    Raises
    ------
    ValueError
        If a row is not as long as ``columns``.
    """
    if wrong := [row for row in rows if len(row) != len(columns)]:
        raise ValueError(f"a row of {len(wrong[0])} cells in a table of {len(columns)} columns")
    head = to_one_line(title) or None
    table = Table(title=head, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    for index, column in enumerate(columns):
        cells = [row[index] for row in rows if row[index] is not None]
        number = bool(cells) and all(isinstance(cell, int | float) for cell in cells)
        table.add_column(column, justify="right" if number else "left")
    for row in rows:
        table.add_row(*[to_cell_text(cell) for cell in row])
    width = None if sys.stdout.isatty() else NOT_A_TERMINAL_COLUMNS
    # Markup and highlighting off: file names hold square brackets.
    Console(width=width, highlight=False, markup=False).print(table)


def to_cell_text(cell: object) -> str:
    """Return the text of a cell of a table, on one line; empty for None."""
    if cell is None:
        return ""
    return f"{cell:.4g}" if isinstance(cell, float) else to_one_line(str(cell))


def count_things(count: int, thing: str) -> str:
    """Return a number with its thing, in the plural where it is not one: ``2 topics``."""
    return f"{count} {thing}{'' if count == 1 else 's'}"


def format_size(size: int) -> str:
    """Return a size in bytes, kB or MB, as large as its unit."""
    if size < 1e5:
        return f"{size / 1e3:.1f} kB" if size >= 1000 else count_things(size, "byte")
    return f"{size / 1e6:.1f} MB"


def print_line(line: str) -> None:
    """Print one line of results, with control characters escaped."""
    sys.stdout.write(to_one_line(line) + "\n")


def print_note(words: str) -> None:
    """Print definitions, which "; " separates, as many in a line as fit ``NOTE_CHARACTERS``.

    A sentence that ends with its line is followed by another line.
    """
    for sentence in words.split(".\n"):
        lines: list[str] = []
        for part in sentence.split("; "):
            if lines and len(lines[-1]) + len(part) + 2 <= NOTE_CHARACTERS:
                lines[-1] += f"; {part}"
            else:
                lines.append(part)
        for line in lines:
            print_line(line)


def print_json(document: Any) -> None:
    """Print one JSON document, keys in the order given.

    Raises
    ------
    ValueError
        If a number is NaN or infinite, which JSON does not know.
    """
    sys.stdout.write(json.dumps(document, indent=2, allow_nan=False, default=str) + "\n")
