"""Robots of text tables and their columns: a file, some columns or some rows for each robot."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from dmrl.errors import SourceError
from dmrl.formats.files.column_map import ANY_PEER, Column, ColumnMap
from dmrl.formats.files.text_cells import is_number
from dmrl.formats.files.text_table import TextTable, read_table
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import say


@dataclass(frozen=True, slots=True)
class RobotLog:
    """Rows of one robot, and the column of each quantity and of the range to each peer.

    ``missing`` holds the columns of the table that the file lacks. ``peer_column`` names the peer
    of each row's range; empty: every row has a range to every peer.
    """

    robot: str
    text: TextTable
    columns: Mapping[str, Column]
    ranges: Mapping[str, Column]
    missing: frozenset[str]
    peer_column: str = ""


def read_robot_logs(files: Mapping[str, Path], table: ColumnMap) -> list[RobotLog]:
    """Read the logs of all robots. Of several files, those without the columns are left out.

    Parameters
    ----------
    files
        Files by the robot of each, for files that name no robot.
    table
        Columns of the files.

    Raises
    ------
    SourceError
        If no file can be used, or a column is in none of them.
    """
    logs: list[RobotLog] = []
    errors = []
    for name, path in files.items():
        try:
            logs += _iter_robots(name, path, table)
        except SourceError as e:
            errors.append(e)
    usable = [log for log in logs if "time" in log.columns]
    if errors and not usable:
        raise errors[0]
    odd = [log.text.path for log in logs if log not in usable] if usable else []
    reason = "files without the columns of the table"
    leave_out(reason, next(iter([*errors, *odd]), ""), len(errors) + len(odd))
    _check_missing(usable or logs)
    return usable or logs


def _iter_robots(name: str, path: Path, table: ColumnMap) -> Iterator[RobotLog]:
    """Yield the log of each robot of a file; its names are in columns, in rows, or in none."""
    plain = [column for column in table.names if "{" not in column]
    text = read_table(path, plain, table.dialect)
    if table.robot_column:
        if table.robot_column not in text.columns:
            raise SourceError(
                f"{name_missing(path, [table.robot_column], text.columns)}. Fix [robot]"
            )
        cells = [cell.strip() for cell in text.columns[table.robot_column]]
        if nameless := [k for k, cell in enumerate(cells) if not cell]:
            leave_out("rows without a robot", text.name_row(nameless[0]), len(nameless))
        for robot in sorted({*cells} - {""}):
            yield _resolve(robot, text.select(np.flatnonzero(np.array(cells) == robot)), table)
        return
    found = _find_robots(text, table)
    if not found:
        _doubt_robots_in_turns(text, table)
    for robot in found or [name]:
        yield _resolve(robot, text, table)


def _doubt_robots_in_turns(text: TextTable, table: ColumnMap) -> None:
    """Report a column that the table does not name, and whose few values take turns."""
    for name in text.columns.keys() - table.names:
        cells = [cell.strip() for cell in text.columns[name]]
        values = sorted({*cells})
        turns = sum(map(str.__ne__, cells, cells[1:]))
        few = 1 < len(values) <= ROBOTS_MAX and turns > TURNS_SHARE * len(cells)
        if few and (ROBOT_NAME.fullmatch(name) or not any(map(is_number, values))):
            say(
                f"{text.path}: {name!r} is {', '.join(values[:3])} in turns. If these are robots, "
                f'their rows are mixed here; write [robot] name = "{name}" in the table'
            )


def resolve_robots(name: str, text: TextTable, table: ColumnMap) -> list[RobotLog]:
    """Return the columns of each robot; ``name`` is the robot if the columns tell none.

    Raises
    ------
    SourceError
        If no robot has a column of the table.
    """
    logs = [_resolve(robot, text, table) for robot in _find_robots(text, table) or [name]]
    _check_missing(logs)
    return logs


def _find_robots(text: TextTable, table: ColumnMap) -> list[str]:
    """Return the robots that the names of columns tell: those that most columns are of."""
    counts: dict[str, int] = {}
    for column in table.columns.values():
        for found in _match(column.name, text, "{robot}") if "{robot}" in column.name else ():
            counts[found] = counts.get(found, 0) + 1
    return sorted(robot for robot, n in counts.items() if 2 * n >= max(counts.values()))


def _match(name: str, text: TextTable, placeholder: str) -> dict[str, str]:
    """Return the columns whose name has this form, by the text in place of the placeholder."""
    form = re.escape(name).replace(re.escape(placeholder), "(.+)", 1)
    form = form.replace(re.escape(placeholder), r"\1")
    return {m[1]: column for column in text.columns if (m := re.fullmatch(form, column))}


def _resolve(robot: str, text: TextTable, table: ColumnMap) -> RobotLog:
    """Return the columns of a robot, by the names that the file has for them."""

    def named(column: Column) -> Column:
        return replace(column, name=column.name.replace("{robot}", robot))

    columns = {key: named(column) for key, column in table.columns.items()}
    ranges = {peer: named(column) for peer, column in table.ranges.items() if peer != robot}
    if (any_peer := ranges.pop(ANY_PEER, None)) is not None and table.peer_column:
        peers = {cell.strip() for cell in text.columns.get(table.peer_column, ())} - {"", robot}
        ranges = dict.fromkeys(sorted(peers), any_peer)
    elif any_peer is not None:
        taken = {column.name for column in columns.values()}
        for peer, name in _match(any_peer.name, text, "{peer}").items():
            if peer != robot and name not in taken:
                ranges.setdefault(peer, replace(any_peer, name=name))
    every = [*columns.values(), *ranges.values()]
    wanted = {c.name for c in every} | {any_peer.name if table.peer_column and any_peer else ""}
    missing = (wanted | {table.peer_column}) - {"", *text.columns}
    return RobotLog(
        robot,
        text,
        {key: column for key, column in columns.items() if column.name not in missing},
        {peer: column for peer, column in ranges.items() if column.name not in missing},
        frozenset(missing),
        table.peer_column,
    )


ROBOT_NAME = re.compile(r"(robot|drone|uav|agent|vehicle|cf)?[ _-]*(id|name|no|nr)?", re.IGNORECASE)
"""Columns whose numbers may be those of robots."""
ROBOTS_MAX, TURNS_SHARE = 30, 0.2
"""Most values of a column of robots, and share of rows with another value than the row before."""
MOST_NAMES = 20
"""Columns of a file that an error lists, at most."""


def _check_missing(logs: Sequence[RobotLog]) -> None:
    """Raise SourceError if no robot has a column of the table.

    A robot that has fewer columns than the others is reported.
    """
    nowhere = frozenset.intersection(*(log.missing for log in logs))
    for log in logs:
        if nowhere:
            words = name_missing(log.text.path, nowhere, log.text.columns)
            there = ", ".join([*log.text.columns][:MOST_NAMES])
            raise SourceError(f"{words}. Fix the table of columns; the file has {there}")
        if log.missing:
            absent = ", ".join(sorted(log.missing))
            say(f"{log.text.path}: no column {absent}, which other robots have")


def name_missing(path: Path, missing: Collection[str], names: Collection[str]) -> str:
    """Return the words for columns that a file does not have, with similar ones."""
    near = {m: get_close_matches(m, names, n=1) for m in sorted(missing)}
    hints = [f"did you mean {found[0]} for {m}?" for m, found in near.items() if found]
    return f"{path}: no column {', '.join(sorted(missing))}" + "".join(f"; {h}" for h in hints)
