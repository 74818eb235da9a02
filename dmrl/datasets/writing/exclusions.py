"""Rows that a person does not want in a dataset: a CSV file, a line for each.

``source, robot, log_time`` as the columns of a dataset have them; ``reason`` may say why. The
page of ``dmrl view DATASET --flag`` writes such files, and so does any spreadsheet.
"""

import csv
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from dmrl.errors import SettingError

NEEDED = ("source", "robot", "log_time")
OPTIONAL = ("reason", "row", "split")
_TIME = re.compile(r"-?\d{1,19}", re.ASCII)
MOST = 1_000_000
"""Lines of a file of flags."""
Flag = tuple[str, str, int]
"""File name of a recording, whose image, its log time in nanoseconds."""


def read_flags(path: Path) -> frozenset[Flag]:
    """Which images are flagged.

    Raises
    ------
    SettingError
        If the file is not there, is no CSV, lacks a column, or a time is no whole number: names
        the line.
    """
    found: set[Flag] = set()
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.DictReader(stream, strict=True)
            _check(path, reader.fieldnames or ())
            for cells in reader:
                if len(found) >= MOST:
                    raise SettingError(f"{path} has more than {MOST} lines. Split the recordings")
                found.add(_flag(f"{path}:{reader.line_num}", cells))
    except FileNotFoundError:
        raise SettingError(f"no file {path}. Name the flags with --without") from None
    except (OSError, UnicodeDecodeError, csv.Error) as e:
        raise SettingError(f"{path} is not a CSV file: {e}. Save it as CSV in UTF-8") from None
    return frozenset(found)


def _check(path: Path, columns: Sequence[str]) -> None:
    missing = [name for name in NEEDED if name not in columns]
    unknown = [name for name in columns if name not in (*NEEDED, *OPTIONAL)]
    if missing or unknown or len(set(columns)) < len(columns):
        wrong = f"no column {missing[0]}" if missing else f"column {(unknown or columns)[0]!r}"
        raise SettingError(
            f"{path}:1: {wrong}. The first line names the columns, each once: {', '.join(NEEDED)}, "
            f"and {', '.join(OPTIONAL)} where wanted"
        )


def _flag(where: str, cells: Mapping[str | None, str | None]) -> Flag:
    values = [(cells.get(name) or "").strip() for name in NEEDED]
    if None in cells or not all(values):
        raise SettingError(f"{where}: not a {', '.join(NEEDED)}. Mend the line")
    source, robot, time = values
    if not _TIME.fullmatch(time):
        raise SettingError(f"{where}: {time[:40]!r} is no time in nanoseconds. Mend the line")
    return source, robot, int(time)
