"""The rows of a folder, in ``catalogue.parquet`` beside its recordings.

A row is known by its recording's place below the folder, and stays as it is while the file's size
and times are the same. So to index a folder again costs a look at each file's name.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from dmrl.atomic_output import rewritten_file
from dmrl.catalogue.describe import Row
from dmrl.errors import RecordingError
from dmrl.guards.memory import Bounded

NAME = "catalogue.parquet"
MARK = {b"dmrl.catalogue": b"1"}
"""Says in the file's metadata that it is one, and of which form."""
SHA256 = ("sha256", pa.string())
COLUMNS = pa.schema(
    [
        ("recording", pa.string()),
        ("bytes", pa.int64()),
        ("stamp", pa.string()),
        SHA256,
        ("error", pa.string()),
        ("start_ns", pa.int64()),
        ("duration_s", pa.float64()),
        ("messages", pa.int64()),
        ("robots", pa.list_(pa.string())),
        (
            "topics",
            pa.list_(
                pa.struct([("topic", pa.string()), ("message", pa.string()), ("count", pa.int64())])
            ),
        ),
        (
            "cameras",
            pa.list_(
                pa.struct(
                    [
                        ("camera", pa.string()),
                        ("images", pa.int64()),
                        ("width_px", pa.int64()),
                        ("height_px", pa.int64()),
                        ("focal_px", pa.float64()),
                    ]
                )
            ),
        ),
        (
            "labels",
            pa.list_(
                pa.struct(
                    [
                        ("camera", pa.string()),
                        ("source", pa.string()),
                        ("status", pa.string()),
                        ("count", pa.int64()),
                    ]
                )
            ),
        ),
        ("stage", pa.string()),
        ("dmrl_version", pa.string()),
        ("settings", pa.string()),
        ("inputs", pa.list_(pa.struct([("name", pa.string()), SHA256]))),
        ("errors", pa.int64()),
        ("warnings", pa.int64()),
        (
            "findings",
            pa.list_(
                pa.struct([("level", pa.string()), ("topic", pa.string()), ("text", pa.string())])
            ),
        ),
    ],
    metadata=MARK,
)
"""A row for each recording; lists of structs for what it has several of."""

ALWAYS = ("recording", "bytes", "stamp")
"""Columns that every row has a value in."""
PERHAPS = ("width_px", "height_px", "focal_px")
"""Of a camera, where they are known."""


@dataclass(frozen=True, slots=True)
class Catalogue:
    """The rows of a folder.

    Parameters
    ----------
    folder
        Of the recordings.
    table
        With `COLUMNS`, sorted by recording.
    """

    folder: Path
    table: pa.Table

    @property
    def file(self) -> Path:
        """Where it is kept."""
        return self.folder / NAME

    def unchanged(self, stamps: Mapping[str, str]) -> set[str]:
        """Recordings whose row still holds; those that could not be read are looked at again.

        Parameters
        ----------
        stamps
            `stamp` of each file that is there now, by name below the folder.
        """
        columns = (self.table[name].to_pylist() for name in ("recording", "stamp", "error"))
        rows = zip(*columns, strict=True)
        return {name for name, stamp, e in rows if e is None and stamps.get(name) == stamp}

    def with_rows(self, kept: Iterable[str], fresh: pa.Table) -> "Catalogue":
        """The same with fresh rows beside those that are kept."""
        kept_names = set(kept)
        mask = pa.array([name in kept_names for name in self.table["recording"].to_pylist()])
        old = self.table.filter(mask.cast(pa.bool_()))
        return Catalogue(self.folder, pa.concat_tables([old, fresh]).sort_by("recording"))

    def save(self) -> None:
        """Write it, whole or not at all.

        Raises
        ------
        OutputError
            If the system refuses.
        """
        with rewritten_file(self.file) as partial:
            pq.write_table(self.table.combine_chunks(), partial, compression="zstd")


def stamp(path: Path) -> str:
    """Size and times of a file: another file of that name has another."""
    found = path.stat()
    return f"{found.st_size} {found.st_mtime_ns} {found.st_ctime_ns}"


def rows_table(rows: Iterable[Row]) -> pa.Table:
    """Rows as a table; what they lack is null."""
    return pa.Table.from_pylist(list(rows), schema=COLUMNS)


def open_catalogue(folder: Path, *, new: bool = False) -> Catalogue:
    """The catalogue of a folder.

    Parameters
    ----------
    folder
        Of recordings.
    new
        Without a catalogue, an empty one.

    Raises
    ------
    RecordingError
        If there is no such folder or no catalogue in it, or the file is another's or damaged.
    """
    file = folder / NAME
    if not folder.is_dir():
        raise RecordingError(f"no folder {folder}. Check the name")
    if not file.is_file():
        if new and not file.exists():
            return Catalogue(folder, rows_table([]))
        raise RecordingError(f"{folder} has no catalogue. Make it: dmrl index {folder}")
    try:
        with Bounded(file.stat().st_size):
            table = pq.read_table(file)
            table.validate(full=True)
        _refuse_odd(table)
    except (pa.ArrowException, OSError, ValueError, MemoryError) as e:
        why = " ".join(str(e).split())
        raise RecordingError(
            f"{file} is damaged ({why}). Remove it, then: dmrl index {folder}"
        ) from None
    if not table.schema.equals(COLUMNS) or (table.schema.metadata or {}).items() < MARK.items():
        raise RecordingError(
            f"{file} is no catalogue of this version of dmrl. Move it away, then: "
            f"dmrl index {folder}"
        )
    return Catalogue(folder, table)


def _lacks_inner(column: pa.Array) -> bool:
    """Whether a list of the column lacks a value, or a field that each of its values has."""
    if not pa.types.is_list(column.type):
        return False
    inner = column.flatten()
    structs = pa.types.is_struct(inner.type)
    fields = [f.name for f in inner.type if f.name not in PERHAPS] if structs else []
    return bool(inner.null_count or any(inner.field(name).null_count for name in fields))


def _refuse_odd(table: pa.Table) -> None:
    """Nothing, if what every row has is there, and names lead to files of the folder.

    Raises
    ------
    ValueError
        If it is not as `Catalogue.save` writes it.
    """
    if not table.schema.equals(COLUMNS):
        return  # another version's
    for name in table.column_names:
        column = table[name].combine_chunks()
        if (name in ALWAYS and column.null_count) or _lacks_inner(column):
            raise ValueError(f"{name} lacks values")
    focal_px = table["cameras"].combine_chunks().flatten().field("focal_px")
    for name, numbers in (("duration_s", table["duration_s"]), ("focal_px", focal_px)):
        if not pc.all(pc.is_finite(numbers), min_count=0).as_py():
            raise ValueError(f"{name} is no number")
    for recording in table["recording"].to_pylist():
        steps = PurePosixPath(recording).parts
        if not steps or ".." in steps or recording.startswith("/"):
            raise ValueError(f"the name {recording!r} leads out of the folder")
