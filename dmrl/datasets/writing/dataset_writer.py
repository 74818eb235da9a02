"""Write the shards of a dataset, one Arrow stream or Parquet file each, in bounded memory."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dmrl.datasets import layout
from dmrl.datasets.manifest import Manifest, Shard
from dmrl.datasets.writing.parquet_writer import ParquetWriter
from dmrl.errors import UnsafeName

JPEG_START = b"\xff\xd8\xff"
"""First bytes of a JPEG file."""
MAX_BATCH_IMAGES = 64
"""Rows per record batch: 14 MB of 320 x 224 pixels. A split keeps no more rows in memory."""
MAX_BATCH_PIXELS = 20_000_000
"""Pixels per record batch. Images larger than 640 x 480 make batches of fewer rows."""


@dataclass(frozen=True, slots=True)
class Row:
    """One labelled image.

    Parameters
    ----------
    rgb
        (H, W, 3) pixels, RGB.
    peers
        Dictionaries with the fields of ``layout.PEER_TYPE``.
    grid
        (2, H/8, W/8): confidence, and depth in metres, from ``geometry.grid_label``.
    robot
        Robot whose camera took the image.
    source
        File name of the recording.
    time_ns
        Log time of the image.
    encoded
        The image as PNG or JPEG, for a dataset of packed images. Empty in others.
    mask
        (H, W) index of the peer that each pixel shows, from 1 in ``peers``; 0 for the background.
        None: the dataset has no masks.
    """

    rgb: NDArray[np.uint8]
    peers: list[dict[str, Any]]
    grid: NDArray[np.float32]
    robot: str
    source: str
    time_ns: int
    encoded: bytes = b""
    mask: NDArray[np.uint8] | None = None

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the image, pixels."""
        return self.rgb.shape[1], self.rgb.shape[0]


@dataclass(slots=True)
class SplitWriter:
    """Write the shards of one split.

    Parameters
    ----------
    folder
        Folder of the dataset, which exists.
    name
        Name of the split.
    schema
        From ``layout.build_schema``.
    parquet
        Parquet files in place of Arrow streams.
    shard_images
        Images per shard, at most.
    first
        Number of the first shard.
    """

    folder: Path
    name: str
    schema: pa.Schema
    parquet: bool
    shard_images: int
    first: int = 0
    _rows: list[Row] = field(default_factory=list)
    _lengths: list[int] = field(default_factory=list)
    _files: list[Path] = field(default_factory=list)
    _sink: Any = None

    def add(self, row: Row) -> None:
        """Add one row; every ``MAX_BATCH_IMAGES`` rows, or ``MAX_BATCH_PIXELS``, go to disk."""
        self._rows.append(row)
        room = self.shard_images - (self._lengths[-1] if self._sink else 0)
        most = min(MAX_BATCH_IMAGES, room, max(1, 3 * MAX_BATCH_PIXELS // row.rgb.size))
        if len(self._rows) >= most:
            self._flush()
            if self._lengths[-1] >= self.shard_images:
                self._close_shard()

    def close(self) -> list[Shard]:
        """Close the last shard, name all shards, and return them in the order of the rows."""
        if self._rows:
            self._flush()
        self._close_shard()
        count = self.first + len(self._files)
        names = [self._shard_path(self.first + k, count) for k in range(len(self._files))]
        for file, name in zip(self._files, names, strict=True):
            file.rename(name)
        sizes = [name.stat().st_size for name in names]
        shards = zip(names, self._lengths, sizes, strict=True)
        return [Shard(name.name, *found) for name, *found in shards]

    def _shard_path(self, index: int, count: int) -> Path:
        return layout.shard_path(self.folder, self.name, index, count, parquet=self.parquet)

    def _flush(self) -> None:
        if self._sink is None:
            self._open_shard()
        self._sink.write_batch(_build_record_batch(self._rows, self.schema, self.name))
        self._lengths[-1] += len(self._rows)
        self._rows.clear()

    def _open_shard(self) -> None:
        # The number of shards is open until close(); until then the name contains 0.
        path = self._shard_path(self.first + len(self._files), 0)
        path.parent.mkdir(exist_ok=True)
        if self.parquet:
            plain = {"compression": "zstd", "use_dictionary": False, "write_statistics": False}
            self._sink = ParquetWriter(path, self.schema, **plain)
        else:
            self._sink = pa.ipc.new_stream(str(path), self.schema)
        self._files.append(path)
        self._lengths.append(0)

    def _close_shard(self) -> None:
        if self._sink is not None:
            self._sink.close()
            self._sink = None


def write_shards(
    folder: Path,
    rows: Iterable[tuple[str, Row]],
    *,
    packed: bool,
    shard_images: int,
    before: Manifest,
) -> dict[str, list[Shard]]:
    """Write the rows of all splits, and return the shards written, by split.

    Parameters
    ----------
    folder
        Folder of the dataset, which exists.
    rows
        Name of the split and row; all images have one size.
    packed
        The encoded images of the rows in place of raw pixels.
    shard_images
        See `SplitWriter`.
    before
        Manifest of the existing dataset; the numbers of its shards are continued.

    Raises
    ------
    UnsafeName
        If the names of two splits differ only in case.
    """
    writers: dict[str, SplitWriter] = {}
    for split, row in rows:
        if split not in writers:
            _reject_case_conflict(split, (*writers, *before.splits))
            shape, masks = row.rgb.shape[:2], row.mask is not None
            schema = layout.build_schema(*shape, packed=packed, masks=masks)
            first = len(before.splits.get(split, ()))
            writers[split] = SplitWriter(folder, split, schema, before.parquet, shard_images, first)
        writers[split].add(row)
    return {name: writer.close() for name, writer in writers.items()}


def _reject_case_conflict(split: str, others: Iterable[str]) -> None:
    """Raise UnsafeName if two names differ only in case: macOS and Windows merge them."""
    for other in others:
        if other != split and other.casefold() == split.casefold():
            raise UnsafeName(
                f"the splits {other} and {split} differ only in case, and many disks store both "
                "in one folder. Rename one in its recording"
            )


def _build_record_batch(rows: list[Row], schema: pa.Schema, split: str) -> pa.RecordBatch:
    grid = np.stack([row.grid for row in rows]).astype(np.float32, copy=False)
    columns = {
        "peers": pa.array([row.peers for row in rows], schema.field("peers").type),
        layout.CONFIDENCE: _build_grid_column(grid[:, 0]),
        layout.DEPTH: _build_grid_column(grid[:, 1]),
        "robot": pa.array([row.robot for row in rows]),
        "source": pa.array([row.source for row in rows]),
        "log_time": pa.array([row.time_ns for row in rows], pa.int64()),
        "split": pa.array([split] * len(rows)),
    }
    if layout.PIXELS in schema.names:
        columns[layout.PIXELS] = _build_bytes_column(np.stack([row.rgb for row in rows]))
    else:
        columns[layout.IMAGE] = pa.array(map(_pack_image, rows), layout.IMAGE_TYPE)
    if masks := [row.mask for row in rows if row.mask is not None]:
        columns[layout.MASKS] = _build_bytes_column(np.stack(masks))
    return pa.record_batch([columns[name] for name in schema.names], schema=schema)


def _pack_image(row: Row) -> dict[str, Any]:
    suffix = "jpg" if row.encoded.startswith(JPEG_START) else "png"
    return {"bytes": row.encoded, "path": f"{row.robot}_{row.time_ns}.{suffix}"}


def _build_bytes_column(values: NDArray[np.uint8]) -> pa.Array:
    kind = pa.binary(values[0].size)
    return pa.Array.from_buffers(kind, len(values), [None, pa.py_buffer(values)])


def _build_grid_column(grid: NDArray[np.float32]) -> pa.Array:
    _, rows, cols = grid.shape
    flat = pa.array(np.ascontiguousarray(grid).ravel())
    row = pa.FixedSizeListArray.from_arrays(flat, cols)
    return pa.FixedSizeListArray.from_arrays(row, rows)
