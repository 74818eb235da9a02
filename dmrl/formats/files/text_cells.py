"""Cells of text tables as numbers and times."""

import re
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation

import numpy as np

from dmrl.geometry.frames import Array
from dmrl.guards.bounded_parsing import parse_number

MISSING = {
    *("", "na", "n/a", "nan", "-nan", "null", "none", "nil", "-", "--", "?", "<na>"),
    *("#n/a", "#na", "#n/a n/a", "1.#ind", "-1.#ind", "1.#qnan", "-1.#qnan"),
}
"""Cells without a value, in lower case: those of pandas and of other loggers."""
DATE = re.compile(
    r"(\d{4})[-/](\d\d?)[-/](\d\d?)[T ]+(\d\d?):(\d\d)(?::(\d\d)(?:[.,](\d+))?)?"
    r"\s*(Z|UTC|[+-]\d\d(?::?\d\d)?)?",
    re.IGNORECASE,
)
DECIMAL_COMMA = re.compile(r"\s*[+-]?\d+,\d+(?:[eE][+-]?\d+)?\s*")
THOUSANDS = re.compile(r"\s*[+-]?[1-9]\d{0,2},\d{3}\s*")
"""Numbers whose comma may separate thousands."""
TIME_OF_DAY = re.compile(r"(\d\d?):(\d\d):(\d\d)(?:[.,](\d+))?")
NS_PER_S = 1_000_000_000


def is_number(cell: str) -> bool:
    """Return whether a cell is a number or a time, with a decimal point or comma."""
    try:
        parse_number(cell.strip().replace(",", "."))
    except ValueError:
        return bool(DATE.fullmatch(cell.strip()) or TIME_OF_DAY.fullmatch(cell.strip()))
    return True


def find_decimal_commas(rows: list[list[str]]) -> bool:
    """Return whether numbers have a decimal comma: some cells do, and no number has a point.

    Raises
    ------
    ValueError
        If all of these commas may separate thousands.
    """
    cells = (cell for row in rows for cell in row if "," in cell)
    found = [cell for cell in cells if DECIMAL_COMMA.fullmatch(cell)]
    if not found or any("." in cell and is_number(cell) for row in rows for cell in row):
        return False
    if all(map(THOUSANDS.fullmatch, found)):
        number = found[0].strip()
        raise ValueError(f"{number} may be {number.replace(',', '.')} or {number.replace(',', '')}")
    return True


def parse_cells(cells: list[str]) -> tuple[Array, list[int]]:
    """Parse cells one by one; return the numbers, and the rows of the cells that are none."""
    values, bad = np.full(len(cells), np.nan), []
    for k, cell in enumerate(cells):
        if (text := cell.strip()).lower() in MISSING:
            continue
        try:
            values[k] = parse_number(text)
        except ValueError:
            bad.append(k)
    return values, bad


def parse_time_ns(cell: str, scale: float, has_decimal_commas: bool) -> int | None:
    """Parse nanoseconds from a number, a date with a time, or a time of the day; None: no time."""
    text = cell.strip()
    try:
        number = Decimal((text.replace(",", ".") if has_decimal_commas else text).replace("_", "?"))
        time_ns: int | None = int((number * Decimal(scale)).to_integral_value())
    except (InvalidOperation, ValueError, OverflowError):
        time_ns = _parse_date_ns(text)
    return time_ns if time_ns is not None and abs(time_ns) < 1 << 63 else None


def _parse_date_ns(text: str) -> int | None:
    """Parse nanoseconds since 1970 from a date with a time, or since midnight from a time."""
    if found := TIME_OF_DAY.fullmatch(text):
        hours, minutes, seconds = (int(found[k]) for k in (1, 2, 3))
        fraction_ns = _parse_fraction_ns(found[4])
        return (3600 * hours + 60 * minutes + seconds) * NS_PER_S + fraction_ns
    if not (found := DATE.fullmatch(text)):
        return None
    year, month, day, hour, minute, second = (int(found[k] or 0) for k in range(1, 7))
    zone = (found[8] or "Z").upper().replace("UTC", "+0000").replace("Z", "+0000").replace(":", "")
    try:
        moment = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return None
    offset_s = (3600 * int(zone[1:3]) + 60 * int(zone[3:5] or 0)) * (-1 if zone[0] == "-" else 1)
    return (int(moment.timestamp()) - offset_s) * NS_PER_S + _parse_fraction_ns(found[7])


def _parse_fraction_ns(digits: str | None) -> int:
    return int((digits or "0")[:9].ljust(9, "0"))
