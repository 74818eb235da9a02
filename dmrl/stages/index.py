"""``dmrl index``: a folder of recordings as one table, which `dmrl find` asks."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dmrl.pipeline.batch import build_tasks, error_text, find_recordings, iter_results
from dmrl.pipeline.executor import Executor, open_executor
from dmrl.pipeline.job import has_failed
from dmrl.terminal.arguments import AsJson, On, Workers
from dmrl.terminal.progress import say
from dmrl.terminal.tables import print_json, print_line

if TYPE_CHECKING:
    from dmrl.catalogue import Row
    from dmrl.catalogue.row_buffer import RowBuffer


@dataclass(frozen=True, slots=True)
class Result:
    """Number of recordings, and of those that were read, known before, gone and unreadable."""

    recordings: int
    looked_at: int
    known: int
    gone: int
    unread: int


def run(recording: Path) -> "Row":
    """Return the row of a recording; see `dmrl.catalogue.describe`."""
    from dmrl.catalogue import describe

    return describe(recording)


def update(folder: Path, workers: int | None = None, on: str | None = None) -> Result:
    """Update the catalogue of a folder; if it is stopped, rows made so far are kept.

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
    from dmrl.catalogue import open_catalogue
    from dmrl.catalogue.row_buffer import RowBuffer
    from dmrl.catalogue.table import file_stamp

    before = open_catalogue(folder, new=True)
    found = {name.as_posix(): path for name, path in find_recordings(folder).items()}
    for name in found:
        name.encode()  # what no table can hold is said before the work, not after
    stamps = {name: file_stamp(path) for name, path in found.items()}
    kept = before.find_unchanged(stamps)
    rows = RowBuffer()
    new = {name: path for name, path in found.items() if name not in kept}
    try:
        if new:
            _describe_all(new, stamps, rows, open_executor(on, workers))
    finally:
        fresh = rows.to_table()
        after = before.replace_rows(kept, fresh)
        if not after.table.equals(before.table) or not before.file.exists():
            after.save()
    gone = sum(name not in found for name in before.table["recording"].to_pylist())
    bad = after.table.num_rows - after.table["error"].null_count
    return Result(after.table.num_rows, fresh.num_rows, len(kept), gone, bad)


def _describe_all(
    new: Mapping[str, Path], stamps: Mapping[str, str], rows: "RowBuffer", crew: Executor
) -> None:
    """Describe recordings side by side."""
    from dmrl.catalogue import unreadable_row

    names = {path: name for name, path in new.items()}
    tasks = build_tasks("index", "recording", {path: path for path in names}, None)
    with crew:
        for task, answer in iter_results(tasks, crew, "Indexing"):
            row = (
                unreadable_row(error_text(task, answer)) if has_failed(answer) else answer["result"]
            )
            name = names[task.source]
            size = int(stamps[name].split()[0])
            rows.add({**row, "recording": name, "bytes": size, "stamp": stamps[name]})


def command(
    folder: Path, /, *, workers: Workers = None, on: On = None, as_json: AsJson = False
) -> None:
    """List the recordings of a folder in catalogue.parquet, for dmrl find.

    Run it again when recordings came, went or changed: only those are looked at.

    Parameters
    ----------
    folder
        Folder of recordings, searched recursively. The table is written into it.
    workers
        Recordings at a time, at most. Without it, as many as there are cores.
    """
    from dmrl.catalogue import open_catalogue

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
