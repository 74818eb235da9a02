"""Table of a folder's recordings, in ``catalogue.parquet`` beside them.

A row is identified by its recording's path below the folder. It stays valid while the file's size
and times are unchanged, so indexing a folder again only reads the metadata of unchanged files.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from dmrl.atomic_output import replace_file
from dmrl.catalogue.describe import Row
from dmrl.errors import RecordingError
from dmrl.guards.memory import MemoryLimit

FILE_NAME = "catalogue.parquet"
FORMAT_MARK = {b"dmrl.catalogue": b"1"}
"""Metadata of the file that identifies a catalogue and its version."""
TEXT, COUNT, NUMBER = pa.string(), pa.int64(), pa.float64()


def _list_of(**fields: pa.DataType) -> pa.DataType:
    return pa.list_(pa.struct(fields))


COLUMNS = pa.schema(
    {
        "recording": TEXT,
        "bytes": COUNT,
        "stamp": TEXT,
        "sha256": TEXT,
        "error": TEXT,
        "start_ns": COUNT,
        "duration_s": NUMBER,
        "messages": COUNT,
        "robots": pa.list_(TEXT),
        "topics": _list_of(topic=TEXT, message=TEXT, count=COUNT),
        "cameras": _list_of(
            camera=TEXT, images=COUNT, width_px=COUNT, height_px=COUNT, focal_px=NUMBER
        ),
        "labels": _list_of(camera=TEXT, source=TEXT, status=TEXT, count=COUNT),
        "stage": TEXT,
        "dmrl_version": TEXT,
        "settings": TEXT,
        "inputs": _list_of(name=TEXT, sha256=TEXT),
        "errors": COUNT,
        "warnings": COUNT,
        "findings": _list_of(level=TEXT, topic=TEXT, text=TEXT),
    },
    metadata=FORMAT_MARK,
)
"""One row per recording, with lists of structs for repeated items."""

REQUIRED_COLUMNS = ("recording", "bytes", "stamp")
"""Columns without nulls."""
OPTIONAL_FIELDS = ("width_px", "height_px", "focal_px")
"""Fields of a camera that may be null."""


@dataclass(frozen=True, slots=True)
class Catalogue:
    """Catalogue of a folder.

    Parameters
    ----------
    folder
        Folder of the recordings.
    table
        Rows with `COLUMNS`, sorted by recording.
    """

    folder: Path
    table: pa.Table

    @property
    def file(self) -> Path:
        """Path of the Parquet file."""
        return self.folder / FILE_NAME

    def find_unchanged(self, stamps: Mapping[str, str]) -> set[str]:
        """Return the recordings with valid rows. Unreadable ones are never valid.

        Parameters
        ----------
        stamps
            `file_stamp` of each present file, by name below the folder.
        """
        columns = (self.table[name].to_pylist() for name in ("recording", "stamp", "error"))
        rows = zip(*columns, strict=True)
        return {name for name, stamp, e in rows if e is None and stamps.get(name) == stamp}

    def replace_rows(self, kept: Iterable[str], fresh: pa.Table) -> "Catalogue":
        """Return a catalogue with the kept rows and fresh rows."""
        kept_names = set(kept)
        mask = pa.array([name in kept_names for name in self.table["recording"].to_pylist()])
        old = self.table.filter(mask.cast(pa.bool_()))
        return Catalogue(self.folder, pa.concat_tables([old, fresh]).sort_by("recording"))

    def save(self) -> None:
        """Write the file atomically.

        Raises
        ------
        OutputError
            If the file system rejects it.
        """
        # In memory first: Arrow's writer prints a traceback when a file cannot be closed.
        packed = pa.BufferOutputStream()
        pq.write_table(self.table.combine_chunks(), packed, compression="zstd")
        with replace_file(self.file) as partial:
            partial.write_bytes(packed.getvalue())


def file_stamp(path: Path) -> str:
    """Return size and times of a file, which change with its content."""
    found = path.stat()
    return f"{found.st_size} {found.st_mtime_ns} {found.st_ctime_ns}"


def to_table(rows: Iterable[Row]) -> pa.Table:
    """Convert rows to a table. Missing values are null."""
    return pa.Table.from_pylist(list(rows), schema=COLUMNS)


def open_catalogue(folder: Path, *, new: bool = False) -> Catalogue:
    """Open the catalogue of a folder.

    Parameters
    ----------
    folder
        Folder of recordings.
    new
        Whether to return an empty catalogue if there is none.

    Raises
    ------
    RecordingError
        If the folder or its catalogue does not exist, or the file is damaged or of another version.
    """
    file = folder / FILE_NAME
    if not folder.is_dir():
        raise RecordingError(f"no folder {folder}. Check the name")
    if not file.is_file():
        if new and not file.exists():
            return Catalogue(folder, to_table([]))
        raise RecordingError(f"{folder} has no catalogue. Make it: dmrl index {folder}")
    try:
        # By a stream: Arrow cannot open a path that is no text. In this thread: a thread of Arrow
        # that frees bytes of Python while the process ends would abort it.
        with MemoryLimit(file.stat().st_size), file.open("rb") as stream:
            table = pq.ParquetFile(stream, pre_buffer=False).read(use_threads=False)
            table.validate(full=True)
        _check_table(table)
    except (pa.ArrowException, OSError, ValueError, MemoryError) as e:
        why = " ".join(str(e).split())
        raise RecordingError(
            f"{file} is damaged ({why}). Remove it, then: dmrl index {folder}"
        ) from None
    if (
        not table.schema.equals(COLUMNS)
        or (table.schema.metadata or {}).items() < FORMAT_MARK.items()
    ):
        raise RecordingError(
            f"{file} is not a catalogue of this version of dmrl. Move it away, then: "
            f"dmrl index {folder}"
        )
    return Catalogue(folder, table)


def _has_inner_nulls(column: pa.Array) -> bool:
    """Return whether a list of the column, or a required field of its structs, has a null."""
    if not pa.types.is_list(column.type):
        return False
    inner = column.flatten()
    structs = pa.types.is_struct(inner.type)
    fields = [f.name for f in inner.type if f.name not in OPTIONAL_FIELDS] if structs else []
    return bool(inner.null_count or any(inner.field(name).null_count for name in fields))


def _check_table(table: pa.Table) -> None:
    """Raise ValueError unless required values exist and names stay inside the folder.

    Raises
    ------
    ValueError
        If the table is not as `Catalogue.save` writes it.
    """
    if not table.schema.equals(COLUMNS):
        return  # written by another version
    for name in table.column_names:
        column = table[name].combine_chunks()
        if (name in REQUIRED_COLUMNS and column.null_count) or _has_inner_nulls(column):
            raise ValueError(f"{name} lacks values")
    focal_px = table["cameras"].combine_chunks().flatten().field("focal_px")
    for name, numbers in (("duration_s", table["duration_s"]), ("focal_px", focal_px)):
        if not pc.all(pc.is_finite(numbers), min_count=0).as_py():
            raise ValueError(f"{name} is no number")
    for recording in table["recording"].to_pylist():
        steps = PurePosixPath(recording).parts
        if not steps or ".." in steps or recording.startswith("/"):
            raise ValueError(f"the name {recording!r} leads out of the folder")
