"""Rows of text tables: lines split into cells, and headers that stand among them."""

import csv
import re
from collections.abc import Sequence
from pathlib import Path

from dmrl.errors import SourceError
from dmrl.formats.files import text_cells
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import say

UNIT_SUFFIX = re.compile(r"\s*[\[(<{/]\s*([^\])>}]*?)\s*[\])>}]?\s*")
HEADER_SHARE = 0.5
"""Share of the names of the header from which a line of text among the rows is another header."""

ROWS_MIN = 10
"""Rows from which the decimals of a column are known."""
NumberedRows = list[tuple[int, list[str]]]
"""Cells of each row, with the number of its line."""


def strip_unit(name: str, wanted: str) -> str | None:
    """Return the unit that follows a wanted name in a header, as in ``roll [deg]``; or None."""
    if not name.startswith(wanted) or name == wanted:
        return None
    found = UNIT_SUFFIX.fullmatch(name[len(wanted) :])
    return found[1] if found else None


def is_named(name: str, wanted: str) -> bool:
    """Return whether a column has a wanted name, with a unit behind it or without."""
    return name == wanted or strip_unit(name, wanted) is not None


def split_rows(
    path: Path, body: list[tuple[int, str]], separator: str, names: list[str]
) -> tuple[list[int], list[list[str]]]:
    """Split lines into rows with as many cells as there are names; return their lines and cells.

    Raises
    ------
    SourceError
        If a line is no CSV, or is a header of other columns.
    """
    rows = _read_rows(path, body, separator)
    width = len(names)
    if rows and all(len(row) == width + 1 for _, row in rows):
        ends_empty = all(not row[-1].strip() for _, row in rows)
        # A separator at the end of each row, or R's names of rows, which have no name.
        rows = [(number, row[:-1] if ends_empty else row[1:]) for number, row in rows]
    odd = [number for number, row in rows if len(row) != width]
    if odd:
        reason = "lines with fewer or more cells than the header"
        leave_out(reason, f"{path}:{odd[0]}", len(odd))
    kept = [(number, row) for number, row in rows if len(row) == width]
    kept = _follow_headers(path, kept, names)
    return [number for number, _ in kept], [row for _, row in kept]


def drop_cut_line(
    path: Path, numbers: list[int], rows: list[list[str]]
) -> tuple[list[int], list[list[str]]]:
    """Leave out the last row of a file without a last line end, if its last number was cut off.

    It was if the numbers above it all have the same number of decimals, and it has fewer.
    """
    decimals = [len(row[-1].strip().partition(".")[2]) for row in rows]
    same = len(rows) >= ROWS_MIN and len({*decimals[:-1]}) == 1
    if not (same and decimals[-1] < decimals[0] and text_cells.is_number(rows[-1][-1])):
        return numbers, rows
    leave_out("last lines that were cut short", f"{path}:{numbers[-1]}")
    return numbers[:-1], rows[:-1]


def _read_rows(path: Path, body: list[tuple[int, str]], separator: str) -> NumberedRows:
    texts = [line for _, line in body]
    if separator == " ":
        texts = [" ".join(line.split()) for line in texts]
    reader = csv.reader(texts, delimiter=separator, skipinitialspace=True)
    try:
        return [(body[reader.line_num - 1][0], row) for row in reader]
    except csv.Error as e:
        line = body[min(reader.line_num, len(body)) - 1][0]
        raise SourceError(f"{path}:{line} cannot be read as CSV: {e}. Fix the line") from None


def _follow_headers(path: Path, rows: NumberedRows, names: Sequence[str]) -> NumberedRows:
    """Return rows without the headers among them; cells below one in another order are put back."""
    order = list(range(len(names)))
    plain = order
    found: NumberedRows = []
    for number, row in rows:
        if not (places := _find_names(row, names)):
            found.append((number, row if order is plain else [row[k] for k in order]))
        elif -1 in places:
            raise SourceError(f"{path}:{number}: a header of other columns. Split the file there")
        elif places != order:
            say(f"{path}:{number}: a header with the columns in another order; followed")
            order = places
    return found


def _find_names(row: list[str], names: Sequence[str]) -> list[int]:
    """Return the cell of each name, -1 without one, of a row that is a header; else nothing."""
    first = row[0].strip()
    if not first or first[0] in "+-.0123456789" or any(map(text_cells.is_number, row)):
        return []
    cells = [cell.strip() for cell in row]
    places = [next((k for k, c in enumerate(cells) if is_named(c, name)), -1) for name in names]
    return places if sum(k >= 0 for k in places) >= HEADER_SHARE * len(names) else []
