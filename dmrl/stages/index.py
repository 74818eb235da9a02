"""``dmrl index``: a folder of recordings as one table, which `dmrl find` asks."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import pyarrow as pa

from dmrl.catalogue import Row, describe, open_catalogue, unread
from dmrl.catalogue.table import rows_table, stamp
from dmrl.pipeline.batch import outcomes, recordings_in, tasks_of, words_of
from dmrl.pipeline.executor import Executor, executor
from dmrl.pipeline.job import failed
from dmrl.terminal.arguments import AsJson, On, Workers
from dmrl.terminal.progress import say
from dmrl.terminal.tables import print_json, print_line

AT_ONCE = 500
"""Rows that are held as Python's values."""


@dataclass(frozen=True, slots=True)
class Result:
    """How many recordings there are, and how many of them were looked at, known, unreadable."""

    recordings: int
    looked_at: int
    known: int
    gone: int
    unread: int


@dataclass(slots=True)
class _Rows:
    """Rows as they come, most of them as Arrow."""

    parts: list[pa.Table] = field(default_factory=lambda: [rows_table([])])
    held: list[Row] = field(default_factory=list)

    def add(self, row: Row) -> None:
        self.held.append(row)
        if len(self.held) >= AT_ONCE:
            self._settle()

    def table(self) -> pa.Table:
        self._settle()
        return pa.concat_tables(self.parts)

    def _settle(self) -> None:
        self.parts.append(rows_table(self.held))
        self.held.clear()


def run(recording: Path) -> Row:
    """The row of a recording; see `dmrl.catalogue.describe`."""
    return describe(recording)


def update(folder: Path, workers: int | None = None, on: str | None = None) -> Result:
    """Bring the catalogue of a folder up to date; if it is stopped, what was seen is kept.

    Parameters
    ----------
    folder
        Of recordings.
    workers
        Recordings at a time, at most. None: as many as there are cores.
    on
        A cluster that looks at them in place of this machine.

    Raises
    ------
    RecordingError
        If there is no such folder or no recording in it, or its catalogue is damaged or
        another's.
    OutputError
        If the catalogue cannot be written.
    UnicodeEncodeError
        If a file's name is no text.
    """
    before = open_catalogue(folder, new=True)
    found = {name.as_posix(): path for name, path in recordings_in(folder).items()}
    for name in found:
        name.encode()  # what no table can hold is said before the work, not after
    stamps = {name: stamp(path) for name, path in found.items()}
    kept = before.unchanged(stamps)
    rows = _Rows()
    new = {name: path for name, path in found.items() if name not in kept}
    try:
        if new:
            _look_at(new, stamps, rows, executor(on, workers))
    finally:
        fresh = rows.table()
        after = before.with_rows(kept, fresh)
        if not after.table.equals(before.table) or not before.file.exists():
            after.save()
    gone = sum(name not in found for name in before.table["recording"].to_pylist())
    bad = after.table.num_rows - after.table["error"].null_count
    return Result(after.table.num_rows, fresh.num_rows, len(kept), gone, bad)


def _look_at(
    new: Mapping[str, Path], stamps: Mapping[str, str], rows: _Rows, crew: Executor
) -> None:
    """Describe recordings side by side."""
    names = {path: name for name, path in new.items()}
    tasks = tasks_of("index", "recording", {path: path for path in names}, None)
    with crew:
        for task, answer in outcomes(tasks, crew, "Indexing"):
            row = unread(words_of(task, answer)) if failed(answer) else answer["result"]
            name = names[task.source]
            size = int(stamps[name].split()[0])
            rows.add({**row, "recording": name, "bytes": size, "stamp": stamps[name]})


def command(
    folder: Path, /, *, workers: Workers = None, on: On = None, as_json: AsJson = False
) -> None:
    """List what a folder's recordings hold in one table, catalogue.parquet, for dmrl find.

    Run it again when recordings came, went or changed: only those are looked at.

    Parameters
    ----------
    folder
        Folder of recordings, searched to its depths. The table is written into it.
    workers
        Recordings at a time, at most. Without it, as many as there are cores.
    as_json
        Print one JSON document in place of the line.
    """
    result = update(folder, workers, on)
    catalogue = open_catalogue(folder)
    if as_json:
        print_json({"catalogue": str(catalogue.file), **asdict(result)})
        return
    print_line(
        f"{catalogue.file}: {result.recordings} recordings; {result.looked_at} looked at, "
        f"{result.known} known, {result.gone} gone"
    )
    if result.unread:
        say(f"{result.unread} cannot be read: dmrl find 'error is not null' {folder}")
