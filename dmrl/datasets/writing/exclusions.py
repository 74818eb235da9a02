"""Read the CSV file of images that a person excludes from a dataset, one line each.

Columns ``source, robot, log_time`` as in a dataset; ``reason`` is optional. The page of
``dmrl view DATASET --flag`` writes such files, and so does any spreadsheet.
"""

import csv
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from dmrl.errors import SettingError

REQUIRED_COLUMNS = ("source", "robot", "log_time")
OPTIONAL_COLUMNS = ("reason", "row", "split")
_TIME_PATTERN = re.compile(r"-?\d{1,19}", re.ASCII)
MAX_LINES = 1_000_000
"""Lines of a file of flags, at most."""
FlaggedImage = tuple[str, str, int]
"""File name of a recording, robot whose camera took the image, log time in nanoseconds."""


def load_flags(path: Path) -> frozenset[FlaggedImage]:
    """Read the flagged images.

    Raises
    ------
    SettingError
        If the file is missing, not CSV, or lacks a column, or if a time is not a whole number. The
        message names the line.
    """
    found: set[FlaggedImage] = set()
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.DictReader(stream, strict=True)
            _check_columns(path, reader.fieldnames or ())
            for cells in reader:
                if len(found) >= MAX_LINES:
                    raise SettingError(
                        f"{path} has more than {MAX_LINES} lines. Split the recordings"
                    )
                found.add(_parse_flag(f"{path}:{reader.line_num}", cells))
    except FileNotFoundError:
        raise SettingError(f"no file {path}. Name the flags with --without") from None
    except (OSError, UnicodeDecodeError, csv.Error) as e:
        raise SettingError(f"{path} is not a CSV file: {e}. Save it as CSV in UTF-8") from None
    return frozenset(found)


def _check_columns(path: Path, columns: Sequence[str]) -> None:
    missing = [name for name in REQUIRED_COLUMNS if name not in columns]
    unknown = [name for name in columns if name not in (*REQUIRED_COLUMNS, *OPTIONAL_COLUMNS)]
    if missing or unknown or len(set(columns)) < len(columns):
        wrong = f"no column {missing[0]}" if missing else f"column {(unknown or columns)[0]!r}"
        raise SettingError(
            f"{path}:1: {wrong}. Name each column once in the first line: "
            f"{', '.join(REQUIRED_COLUMNS)}, "
            f"and optionally {', '.join(OPTIONAL_COLUMNS)}"
        )


def _parse_flag(where: str, cells: Mapping[str | None, str | None]) -> FlaggedImage:
    values = [(cells.get(name) or "").strip() for name in REQUIRED_COLUMNS]
    if None in cells or not all(values):
        raise SettingError(f"{where}: not a {', '.join(REQUIRED_COLUMNS)}. Fix the line")
    source, robot, time = values
    if not _TIME_PATTERN.fullmatch(time):
        raise SettingError(f"{where}: {time[:40]!r} is not a time in nanoseconds. Fix the line")
    return source, robot, int(time)
