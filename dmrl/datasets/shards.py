"""Open the shards of a dataset and validate them before any value is read.

Arrow's own reader trusts a file: it follows an offset beyond a buffer. Every shard is therefore
validated, and a shard that does not follow `dmrl.datasets.layout` is rejected.
"""

import mmap
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from dmrl.datasets import layout
from dmrl.errors import DatasetError
from dmrl.geometry.frames import STRIDE_PX
from dmrl.guards import limits
from dmrl.guards.memory import MemoryLimit

REBUILD_HINT = "Make the dataset again, or copy it whole"
"""Way out at the end of every error about a shard."""


def open_shard(path: Path, rows: int | None) -> pa.Table:
    """Open the layout's columns of a shard; memory-mapped for Arrow.

    Parameters
    ----------
    path
        An Arrow stream, or a ``.parquet`` file.
    rows
        Expected number of rows. None: not checked.

    Raises
    ------
    DatasetError
        If the shard is missing, damaged, decompresses to far more memory than its size explains,
        or does not follow the layout.
    """
    if path.exists() and not path.is_file():
        raise DatasetError(f"shard {path} is not a file. {REBUILD_HINT}")
    with _named_in_errors(path), MemoryLimit(path.stat().st_size), _open_table(path) as table:
        table.validate(full=True)
        wrong = _find_layout_error(table)
    # A stream that ends between two batches reads without an error.
    if rows is not None and table.num_rows != rows:
        found = f"{table.num_rows} of {rows} rows"
        raise DatasetError(f"shard {path} is cut short: {found}. {REBUILD_HINT}")
    if wrong:
        raise DatasetError(f"shard {path} {wrong}. Make it with: dmrl dataset")
    return table.select([name for name in table.schema.names if name in layout.COLUMN_NAMES])


def load_schema(path: Path) -> pa.Schema:
    """Read the columns of a shard from its header alone.

    Raises
    ------
    DatasetError
        If the shard is missing or damaged.
    """
    with _named_in_errors(path), path.open("rb") as stream:
        if path.suffix == ".parquet":
            return pq.read_schema(stream)
        return pa.ipc.open_stream(stream).schema


@contextmanager
def _named_in_errors(path: Path) -> Iterator[None]:
    """Name a shard in the error if it cannot be read."""
    try:
        yield
    except FileNotFoundError:
        raise DatasetError(f"shard {path} is missing. {REBUILD_HINT}") from None
    except MemoryError:
        raise DatasetError(
            f"shard {path} decompresses to much more than its size explains. {REBUILD_HINT}"
        ) from None
    except (pa.ArrowException, OSError, ValueError) as e:
        why = " ".join(str(e).split())
        raise DatasetError(f"shard {path} is cut short or damaged: {why}. {REBUILD_HINT}") from None


@contextmanager
def _open_table(path: Path) -> Iterator[pa.Table]:
    """Open a shard. In the block, only the pages in use are read from disk.

    Arrow's own maps, and the system's readahead, would read most images from disk: as much as a
    pass of training, and more than memory holds.
    """
    if path.suffix == ".parquet":
        yield pq.ParquetFile(os.fspath(path), memory_map=True).read()
        return
    with path.open("rb") as stream:
        try:
            number = stream.fileno()
        except OSError:  # in a bucket
            yield pa.ipc.open_stream(stream).read_all()
            return
        data = mmap.mmap(number, 0, access=mmap.ACCESS_READ)
    can_advise = hasattr(mmap, "MADV_RANDOM")  # not on Windows
    if can_advise:
        data.madvise(mmap.MADV_RANDOM)
    yield pa.ipc.open_stream(pa.BufferReader(pa.py_buffer(data))).read_all()
    if can_advise:
        data.madvise(mmap.MADV_NORMAL)


def _find_layout_error(table: pa.Table) -> str:
    """Return the first difference between a table and the layout; empty if there is none."""
    names = table.schema.names
    if len(set(names)) < len(names):
        return "has a column twice"
    for name in (layout.CONFIDENCE, layout.DEPTH, "peers", "source"):
        if name not in names:
            return f"has no column {name}"
    if not {layout.PIXELS, layout.IMAGE} & set(names):
        return f"has no column {layout.PIXELS}"
    grid = table.schema.field(layout.CONFIDENCE).type
    if not (pa.types.is_fixed_size_list(grid) and pa.types.is_fixed_size_list(grid.value_type)):
        return f"has no grid in its column {layout.CONFIDENCE}"
    rows, cols = grid.list_size, grid.value_type.list_size
    if not 0 < rows * cols <= limits.PIXELS // STRIDE_PX**2:
        return f"has grids of {cols} x {rows}"
    if wrong := _find_column_error(table, rows * STRIDE_PX, cols * STRIDE_PX):
        return wrong
    if (pc.max(pc.utf8_length(table["source"])).as_py() or 0) > limits.NAME_CHARACTERS:
        return "has a source with a very long name"
    most = pc.max(pc.list_value_length(table["peers"])).as_py() or 0
    return f"has an image with {most} peers" if most > limits.PEERS else ""


def _find_column_error(table: pa.Table, height_px: int, width_px: int) -> str:
    """Return an error if a column has the wrong type or nulls; empty if all are right."""
    names = table.schema.names
    known = layout.build_schema(height_px, width_px, masks=layout.MASKS in names)
    packed = layout.build_schema(height_px, width_px, packed=True).field(layout.IMAGE)
    for wanted in (*known, packed):
        if wanted.name not in names:
            continue
        if table.schema.field(wanted.name).type != wanted.type:
            return f"has a column {wanted.name} of another type"
        if any(map(_has_nulls, table[wanted.name].chunks)):
            return f"has a column {wanted.name} with values missing"
    return ""


def _has_nulls(values: pa.Array) -> bool:
    """Return whether a value, or a value nested in it, is null. An image needs no path."""
    if values.null_count:
        return True
    if pa.types.is_struct(values.type):
        return any(_has_nulls(values.field(f.name)) for f in values.type if f.name != "path")
    nested = pa.types.is_list(values.type) or pa.types.is_fixed_size_list(values.type)
    return nested and _has_nulls(values.flatten())
