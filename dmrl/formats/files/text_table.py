"""Tables in text files, as loggers, spreadsheets and pandas write them.

Encoding, separator, decimal mark, comments and the line of the header are found; a `Dialect` can
state them. Every row keeps the number of its line. What cannot be used is left out and counted.
"""

import csv
import re
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from dmrl.errors import EmptySource, SourceError
from dmrl.formats.clocks import Ints, settle_times
from dmrl.formats.files import text_cells
from dmrl.formats.files.text_rows import drop_cut_line, is_named, split_rows, strip_unit
from dmrl.geometry.frames import Array
from dmrl.guards import limits
from dmrl.guards.bounded_parsing import parse_number
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import say

TABLE_SUFFIXES = (".csv", ".tsv", ".txt", ".dat")
SEPARATORS = (",", ";", "\t", "|", " ")
"""Separators by preference. A space stands for any white space."""
COMMENT_MARKS = ("#", "%", "//")
TYPED_MINUS = "\u2212"
"""Minus sign of spreadsheets in some languages."""
HEADER_LINES_MAX = 200
"""Lines in which the header is searched."""
BYTE_ORDER_MARKS = (
    (b"\xff\xfe\0\0", "utf-32"),
    (b"\0\0\xfe\xff", "utf-32"),
    (b"\xef\xbb\xbf", "utf-8-sig"),
    (b"\xff\xfe", "utf-16"),
    (b"\xfe\xff", "utf-16"),
)
NO_TEXT, NO_TEXT_BYTES = re.compile(rb"[\0-\x08\x0e-\x1a\x1c-\x1f]"), 4096
"""Characters that no encoding of text in one byte has, and the beginning that is searched."""


@dataclass(frozen=True, slots=True)
class Dialect:
    """Form of a text file. An empty field is found in the file.

    Parameters
    ----------
    separator
        Character between cells; a space: any white space.
    decimal
        Decimal mark, a point or a comma.
    encoding
        Encoding, by its name in Python.
    comment
        Mark at the beginning of a comment.
    """

    separator: str = ""
    decimal: str = ""
    encoding: str = ""
    comment: str = ""


@dataclass(frozen=True, slots=True)
class TextTable:
    """Rows of a text file: column names, line number of each row, and cells by column.

    ``units`` holds the units that the header states, by column.
    """

    path: Path
    columns: dict[str, list[str]]
    lines: list[int]
    units: dict[str, str] = field(default_factory=dict)
    has_decimal_commas: bool = False

    def name_row(self, row: int) -> str:
        """Return the file and line of a row."""
        return f"{self.path}:{self.lines[row]}"

    def select(self, rows: Collection[int]) -> "TextTable":
        """Return a table of some rows."""
        columns = {name: [cells[k] for k in rows] for name, cells in self.columns.items()}
        return replace(self, columns=columns, lines=[self.lines[k] for k in rows])

    def parse_numbers(self, name: str, *, used: bool = True) -> Array | None:
        """Parse a column to (N,) numbers, NaN where a cell has none; None: it is a text column.

        Cells of a used column that are neither numbers nor empty are counted as left out.
        """
        cells = self.columns[name]
        if self.has_decimal_commas:
            cells = [cell.replace(",", ".") for cell in cells]
        try:
            return np.array([parse_number(cell) for cell in cells])
        except ValueError:
            values, bad = text_cells.parse_cells(cells)
        if bad and not (used and np.isfinite(values).any()):
            return None
        if bad:
            leave_out(f"cells of {name!r} that are no number", self.name_row(bad[0]), len(bad))
        return values

    def order_by_time(self, name: str, scale: float) -> tuple["TextTable", Ints]:
        """Return the rows that have a time, in its order, and the (N,) times, nanoseconds.

        Numbers are times in a unit of ``scale`` nanoseconds; dates and times of the day are ISO
        8601. A float has too few digits for nanoseconds since 1970, so digits are kept exactly.

        Raises
        ------
        SourceError
            If no row has a time from 1970 to 2262, or the clock starts again.
        """
        cells = self.columns[name]
        known = (text for text in map(str.strip, cells) if text.lower() not in text_cells.MISSING)
        if (date := text_cells.DATE.fullmatch(next(known, ""))) and not date[8]:
            say(f"{self.path}: times without a zone are read as UTC. Write them with one, as in Z")
        told = [text_cells.parse_time_ns(c, scale, self.has_decimal_commas) for c in cells]
        rows = [k for k, time_ns in enumerate(told) if time_ns is not None]
        told_ns = np.array([time_ns for time_ns in told if time_ns is not None], np.int64)
        if len(rows) < len(cells):
            first = next(k for k, time_ns in enumerate(told) if time_ns is None)
            leave_out("rows without a time", self.name_row(first), len(cells) - len(rows))
        found = settle_times(told_ns, lambda k: self.name_row(rows[k]))
        kept = [rows[k] for k in found.rows[found.time_ns >= 0]]
        if not kept:
            raise SourceError(
                f"{self.name_row(0)}: {cells[0]!r} in {name} is no time from 1970 to 2262, nor are "
                "all others. Check the column and its unit"
            )
        before = len(found.rows) - len(kept)
        leave_out("rows with times before 0", self.name_row(rows[int(found.rows[0])]), before)
        same = kept == list(range(len(cells)))
        return self if same else self.select(kept), found.time_ns[before:]


def read_table(
    path: Path, wanted: Collection[str] = (), dialect: Dialect | None = None
) -> TextTable:
    """Read the table in a text file.

    Parameters
    ----------
    path
        The file.
    wanted
        Names of columns, by which the header is found. They may lack the unit that follows the name
        in the header, as ``roll`` of ``roll [deg]``.
    dialect
        Form of the file, as far as it is known.

    Raises
    ------
    SourceError
        If the file cannot be read, or has no header or no row.
    """
    dialect = dialect or Dialect()
    lines, is_ended = _read_lines(path, dialect.encoding)
    head, separator, names = _find_header(path, lines, wanted, dialect)
    units = {}
    for k, name in enumerate(names):
        known = next((w for w in wanted if w != name and strip_unit(name, w) is not None), None)
        if known and known not in names:
            units[known], names[k] = strip_unit(name, known) or "", known
    marks = (dialect.comment,) if dialect.comment else COMMENT_MARKS
    body = [(n, _cut_comment(line, marks, separator, len(names))) for n, line in lines[head + 1 :]]
    body = [(n, line) for n, line in body if line.strip()]
    numbers, rows = split_rows(path, body, separator, names)
    if not is_ended:
        numbers, rows = drop_cut_line(path, numbers, rows)
    if rows and not any(text_cells.is_number(cell) for cell in rows[0]):
        units |= {name: cell.strip() for name, cell in zip(names, rows[0], strict=True)}
        numbers, rows = numbers[1:], rows[1:]  # a line of units
    if not rows:
        raise EmptySource(f"{path} has no rows below its header. Pass another file")
    columns = dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))
    has_commas = dialect.decimal == "," or (not dialect.decimal and _find_commas(path, rows))
    if has_commas and not dialect.decimal:
        say(f"{path}: numbers are read with decimal commas. [file] decimal in the table decides it")
    return TextTable(path, columns, numbers, units, has_commas)


def read_names(path: Path, wanted: Collection[str]) -> list[str]:
    """Return the names of the columns, from the first 64 KiB of a file; none if it is no table."""
    with path.open("rb") as stream:
        data = stream.read(1 << 16)
    try:
        lines = _number_lines(_decode(path, data, "", whole=False))
        return _find_header(path, lines, wanted, Dialect())[2]
    except SourceError:
        return []


def _read_lines(path: Path, encoding: str) -> tuple[list[tuple[int, str]], bool]:
    """Return the numbered lines of a file, and whether the last one has an end."""
    try:
        text = _decode(path, path.read_bytes(), encoding)
        return _number_lines(text), text.endswith(("\n", "\r"))
    except (OSError, LookupError, UnicodeError) as e:
        raise SourceError(f"{path} cannot be read as text: {e}. Save it as UTF-8") from None


def _number_lines(text: str) -> list[tuple[int, str]]:
    """Return the lines that are not blank, with their numbers."""
    text = text.replace(TYPED_MINUS, "-")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    return [(number, line) for number, line in enumerate(lines, 1) if line.strip()]


def _decode(path: Path, data: bytes, encoding: str, *, whole: bool = True) -> str:
    """Decode a file by its byte-order mark, else as UTF-8, else as Latin-1."""
    if not encoding:
        encoding = next((name for mark, name in BYTE_ORDER_MARKS if data.startswith(mark)), "")
    if not encoding and data[1:400:2].count(0) > 100:
        encoding = "utf-16-le"
    if not encoding and data[:400:2].count(0) > 100:
        encoding = "utf-16-be"
    if encoding:
        return data.decode(encoding, "strict" if whole else "ignore")
    try:
        return data.decode("utf-8", "strict" if whole else "ignore")
    except UnicodeDecodeError:
        if NO_TEXT.search(data[:NO_TEXT_BYTES]):
            raise SourceError(f"{path} is no text. Pass a table in text, such as CSV") from None
        say(f"{path}: is not UTF-8; read as Latin-1. [file] encoding in the table decides it")
        return data.decode("latin-1")


def _find_header(
    path: Path, lines: list[tuple[int, str]], wanted: Collection[str], dialect: Dialect
) -> tuple[int, str, list[str]]:
    """Return the place of the header among the lines, the separator, and the names.

    It is the line with most of the wanted names; without any, the first that is no comment, or the
    comment above it if that line is of numbers. A header may be a comment itself.
    """
    separators = (dialect.separator,) if dialect.separator else SEPARATORS
    marks = (dialect.comment,) if dialect.comment else COMMENT_MARKS
    best: tuple[int, int, str, list[str]] = (0, 0, "", [])
    for number, line in lines[:HEADER_LINES_MAX]:
        if len(line) > limits.LINE_CHARACTERS:
            raise SourceError(f"{path}, line {number}: has {len(line)} characters. Pass a table")
    for place, (_, line) in enumerate(lines[:HEADER_LINES_MAX]):
        for separator in separators if wanted else ():
            plain = _uncomment(line, marks)
            for text in dict.fromkeys((plain, line, _cut_comment(plain, marks))):
                names = _split(text, separator)
                score = sum(any(is_named(name, w) for name in names) for w in set(wanted))
                if score > best[0]:
                    best = score, place, separator, names
        if best[0] == len(set(wanted)) > 0:
            break
    if best[0]:
        return best[1], best[2], _tidy(path, best[3], wanted)
    rows = [k for k, (_, line) in enumerate(lines) if not line.lstrip().startswith(marks)]
    if not rows:
        raise SourceError(f"{path} has no line of names. Pass another file")
    place = rows[0]
    separator = max(separators, key=lambda s: len(_split(lines[place][1], s)))
    if place and all(map(text_cells.is_number, _split(lines[place][1], separator))):
        place -= 1
    names = _split(_uncomment(lines[place][1], marks), separator)
    return place, separator, _tidy(path, names, wanted)


def _uncomment(line: str, marks: tuple[str, ...]) -> str:
    return line.lstrip().lstrip("".join(marks)) if line.lstrip().startswith(marks) else line


def _cut_comment(line: str, marks: tuple[str, ...], separator: str = "", width: int = 0) -> str:
    """Cut a comment: from a mark at the beginning, or behind a space in a line without quotes.

    A mark without which fewer than ``width`` cells would be left is part of a cell: ``80 %``.
    """
    if line.lstrip().startswith(marks):
        return ""
    for mark in marks if '"' not in line else ():
        places = (found.start() for found in re.finditer(f" {re.escape(mark)}", line))
        whole = (k for k in places if not width or len(_split(line[:k], separator)) >= width)
        line = line[: next(whole, None)]
    return line


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        line = " ".join(line.split())
    try:
        names = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:
        return []
    return [name.strip().strip("\ufeff'\"") for name in names]


def _tidy(path: Path, names: list[str], wanted: Collection[str]) -> list[str]:
    """Return names that differ: a repeated one gets a number, an empty one its place."""
    if len(names) > limits.VARIABLES:
        raise SourceError(f"{path} has {len(names)} columns. Keep {limits.VARIABLES} at most")
    found: list[str] = []
    for k, name in enumerate(names):
        if name in found and name in wanted:
            raise SourceError(f"{path}: a column appears twice, {name!r}. Rename one")
        name = name or f"column_{k + 1}"
        while name in found:
            name += "_"
        found.append(name)
    return found


def _find_commas(path: Path, rows: list[list[str]]) -> bool:
    try:
        return text_cells.find_decimal_commas(rows)
    except ValueError as e:
        way = "Write points and no other marks, or state it: [file] decimal in the table"
        raise SourceError(f"{path}: {e}. {way}") from None
