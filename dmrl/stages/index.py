"""``dmrl index``: a folder of recordings as one table, which `dmrl find` asks."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dmrl.pipeline.batch import build_tasks, error_text, find_recordings, iter_results
from dmrl.pipeline.executor import open_executor
from dmrl.pipeline.job import has_failed
from dmrl.terminal.arguments import AsJson, On, Workers
from dmrl.terminal.progress import say
from dmrl.terminal.tables import count_things, print_json, print_line

if TYPE_CHECKING:
    from dmrl.catalogue import Row


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
    import pyarrow as pa

    from dmrl.catalogue import open_catalogue
    from dmrl.catalogue.table import file_stamp, to_table

    before = open_catalogue(folder, new=True)
    found = {name.as_posix(): path for name, path in find_recordings(folder).items()}
    for name in found:
        name.encode()  # what no table can hold is said before the work, not after
    stamps = {name: file_stamp(path) for name, path in found.items()}
    kept = before.find_unchanged(stamps)
    rows = [to_table([])]
    new = {path: name for name, path in found.items() if name not in kept}
    try:
        for row in _iter_rows(new, stamps, on, workers) if new else ():
            rows.append(to_table([row]))
    finally:
        fresh = pa.concat_tables(rows)
        after = before.replace_rows(kept, fresh)
        if not after.table.equals(before.table) or not before.file.exists():
            after.save()
    gone = sum(name not in found for name in before.table["recording"].to_pylist())
    bad = after.table.num_rows - after.table["error"].null_count
    return Result(after.table.num_rows, fresh.num_rows, len(kept), gone, bad)


def _iter_rows(
    new: Mapping[Path, str], stamps: Mapping[str, str], on: str | None, workers: int | None
) -> "Iterator[Row]":
    """Yield the rows of recordings, which are described side by side."""
    from dmrl.catalogue import unreadable_row

    tasks = build_tasks("index", "recording", {path: path for path in new}, None)
    with open_executor(on, workers) as crew:
        for task, answer in iter_results(tasks, crew, "Indexing"):
            bad, name = has_failed(answer), new[task.source]
            row = unreadable_row(error_text(task, answer)) if bad else answer["result"]
            size = int(stamps[name].split()[0])
            yield {**row, "recording": name, "bytes": size, "stamp": stamps[name]}


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
        f"{catalogue.file}: {count_things(result.recordings, 'recording')}; "
        f"{result.looked_at} looked at, {result.known} known, {result.gone} gone"
    )
    if result.unread:
        say(f"{result.unread} cannot be read: dmrl find 'error is not null' {folder}")
