"""Open datasets. Shards are mapped into memory; no split is read as a whole."""

import re
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dmrl.datasets import layout
from dmrl.datasets.manifest import Manifest, load_manifest
from dmrl.datasets.packed_images import PackedImages
from dmrl.datasets.shards import open_shard
from dmrl.errors import DatasetError, MissingSplit
from dmrl.geometry.frames import STRIDE_PX
from dmrl.guards.bounded_parsing import parse_json
from dmrl.guards.mapped_files import MappedFile, require_whole
from dmrl.guards.paths import refuse_pipes, require_text_path
from dmrl.guards.safe_names import check_split_name, safe_join

PARQUET_NAME_PATTERN = re.compile(r"(?P<split>.+)-(?P<index>\d{5})-of-(?P<count>\d{5})\.parquet")


@dataclass(frozen=True)
class Split:
    """The rows of one split.

    Parameters
    ----------
    name
        ``train`` or ``test``.
    table
        All columns, with the types of ``layout.build_schema``. Memory-mapped for Arrow shards.
    files
        The mapped shards.
    """

    name: str
    table: pa.Table
    files: tuple[MappedFile, ...] = ()

    def require_whole(self) -> None:
        """Raise DatasetError if a shard was cut short after it was mapped."""
        require_whole(self.files)

    def __len__(self) -> int:
        return int(self.table.num_rows)

    @property
    def grid_shape(self) -> tuple[int, int]:
        """Rows and columns of the grid labels."""
        kind = self.table.schema.field(layout.CONFIDENCE).type
        return kind.list_size, kind.value_type.list_size

    @property
    def image_shape(self) -> tuple[int, int]:
        """Height and width of the images, pixels."""
        rows, cols = self.grid_shape
        return rows * STRIDE_PX, cols * STRIDE_PX

    @cached_property
    def pixels(self) -> list[NDArray[np.uint8]]:
        """Images, one (n_i, H, W, 3) RGB array per record batch, in the order of ``table``.

        For raw pixels these are read-only views of the mapped files, which load on use. PNG and
        JPEG images are `PackedImages`, which act like arrays and decode on use, each time.
        """
        if layout.PIXELS in self.table.schema.names:
            return [self._view_bytes(chunk) for chunk in self.table[layout.PIXELS].chunks]
        shape = (*self.image_shape, 3)
        chunks = self.table[layout.IMAGE].chunks
        packed = [PackedImages(chunk.field("bytes"), shape, self.name) for chunk in chunks]
        return cast("list[NDArray[np.uint8]]", packed)

    def images(self, rows: Iterable[int]) -> Iterator[NDArray[np.uint8]]:
        """Yield the images of these rows, (H, W, 3) each; images of other rows are not decoded."""
        self.require_whole()
        for chunk, place in map(self._locate_row, rows):
            yield self.pixels[chunk][place]

    def grids(self, name: str, rows: Sequence[int]) -> NDArray[np.float32]:
        """Return the grid labels of these rows alone, (n, rows, cols)."""
        self.require_whole()
        out = np.empty((len(rows), *self.grid_shape), np.float32)
        for grid, (chunk, place) in zip(out, map(self._locate_row, rows), strict=True):
            grid[:] = self._grids[name][chunk][place]
        return out

    def _locate_row(self, row: int) -> tuple[int, int]:
        """Return the batch of a row, and the index of the row in that batch."""
        chunk = bisect_right(self._batch_ends, row)
        return chunk, row - (self._batch_ends[chunk - 1] if chunk else 0)

    @cached_property
    def _batch_ends(self) -> list[int]:
        return list(accumulate(len(chunk) for chunk in self.table["source"].chunks))

    @cached_property
    def _grids(self) -> dict[str, list[NDArray[np.float32]]]:
        """Views of the mapped grids, (n_i, rows, cols), one per batch."""
        return {
            name: [
                chunk.flatten()
                .flatten()
                .to_numpy(zero_copy_only=True)
                .reshape(-1, *self.grid_shape)
                for chunk in self.table[name].chunks
            ]
            for name in (layout.CONFIDENCE, layout.DEPTH)
        }

    @cached_property
    def masks(self) -> list[NDArray[np.uint8]]:
        """Masks of ``pixels``, (n_i, H, W): 0 for the background or the index of a peer, from 1.

        Empty if the dataset has no masks.
        """
        if layout.MASKS not in self.table.schema.names:
            return []
        return [self._view_bytes(chunk)[..., 0] for chunk in self.table[layout.MASKS].chunks]

    @cached_property
    def confidence(self) -> NDArray[np.float32]:
        """(N, rows, cols): 1 in the cell of a peer's centre, else 0."""
        return self._concatenate_grid(layout.CONFIDENCE)

    @cached_property
    def depth(self) -> NDArray[np.float32]:
        """(N, rows, cols): depth in metres where the confidence is 1, else 0."""
        return self._concatenate_grid(layout.DEPTH)

    def _view_bytes(self, chunk: pa.Array) -> NDArray[np.uint8]:
        every = np.frombuffer(chunk.buffers()[1], np.uint8)
        width = chunk.type.byte_width
        mine = every[chunk.offset * width : (chunk.offset + len(chunk)) * width]
        return mine.reshape(len(chunk), *self.image_shape, -1)

    def _concatenate_grid(self, name: str) -> NDArray[np.float32]:
        parts = self._grids[name]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)


@dataclass(frozen=True)
class Dataset:
    """A dataset folder.

    Parameters
    ----------
    path
        The folder.
    splits
        Names of its splits.
    parquet
        Parquet files in place of Arrow shards.
    manifest
        Its manifest. None if another program, or an older dmrl, wrote the dataset.
    """

    path: Path
    splits: tuple[str, ...]
    parquet: bool = False
    manifest: Manifest | None = None

    @property
    def focal_px(self) -> Sequence[float]:
        """Focal lengths of its cameras, pixels, the main one first. Empty: unknown."""
        return self.manifest.focal_px if self.manifest else ()

    def split(self, name: str) -> Split:
        """Open one split, mapped into memory.

        Raises
        ------
        DatasetError
            If the split does not exist, or a shard is missing or truncated.
        """
        if name not in self.splits:
            raise MissingSplit(name, self.splits, self.path)
        shards = self._locate_shards(name)
        tables = [open_shard(path, rows) for path, rows in shards]
        for (path, _), table in zip(shards, tables, strict=True):
            if table.schema != tables[0].schema:
                raise DatasetError(f"{path} has other columns than {shards[0][0]}. Make it again")
        if not sum(table.num_rows for table in tables):
            raise DatasetError(f"split {name} of {self.path} has no images. Make it again")
        files = () if self.parquet else tuple(MappedFile(path) for path, _ in shards)
        return Split(name, pa.concat_tables(tables), files)

    def list_shards(self, name: str) -> list[Path]:
        """Return the shards of a split, in the order of its rows."""
        return [path for path, _ in self._locate_shards(name)]

    def _locate_shards(self, name: str) -> list[tuple[Path, int | None]]:
        """Return the shards of a split and their numbers of rows, None where not stored."""
        if self.manifest is not None:
            own = self.manifest.splits[name]
            return [(self.manifest.shard_path(self.path, name, shard), shard.rows) for shard in own]
        return self._find_parquet_shards(name) if self.parquet else self._find_arrow_shards(name)

    def _find_arrow_shards(self, name: str) -> list[tuple[Path, int | None]]:
        folder = safe_join(self.path, name, f"{self.path}: a split")
        state, about = folder / "state.json", folder / "dataset_info.json"
        try:
            files = [str(item["filename"]) for item in _load_json(state)["_data_files"]]
            info = (_load_json(about).get("splits") or {}).get(name, {})
            rows = info.get("shard_lengths") or [None] * len(files)
            named = list(zip(files, rows, strict=True))
            if len(set(files)) < len(files):
                raise ValueError("a shard is named twice")
        except (KeyError, TypeError, AttributeError, ValueError) as e:
            raise DatasetError(
                f"{state} or {about} is damaged ({e}). Make the dataset again"
            ) from None
        return [(safe_join(folder, file, f"{folder}: a shard"), count) for file, count in named]

    def _find_parquet_shards(self, name: str) -> list[tuple[Path, int | None]]:
        found = {
            index: count for split, index, count in _parse_parquet_names(self.path) if split == name
        }
        count = max(found.values(), default=0)
        paths = [layout.shard_path(self.path, name, k, count, parquet=True) for k in range(count)]
        return [(path, None) for path in paths]


def is_dataset(path: Path) -> bool:
    """Return whether a folder has the files of a dataset; it may still be damaged."""
    return (path / "dataset_dict.json").is_file() or bool(_parse_parquet_names(path))


def open_dataset(path: Path) -> Dataset:
    """Open a dataset that ``dmrl dataset`` wrote, or ``datasets`` saved with the same columns.

    Parameters
    ----------
    path
        The folder.

    Raises
    ------
    DatasetError
        If it is not a dataset.
    UnsafeName
        If the name of a split is not a valid folder name, or the path is not valid text.
    """
    require_text_path(path)
    refuse_pipes(path)
    manifest = load_manifest(path)
    if manifest is not None and manifest.splits:
        return Dataset(path, tuple(manifest.splits), manifest.parquet, manifest)
    parquet = not (path / "dataset_dict.json").is_file()
    if not parquet:
        splits = _load_split_names(path / "dataset_dict.json")
    else:
        splits = tuple(sorted({split for split, _, _ in _parse_parquet_names(path)}, reverse=True))
    if not splits:
        what, out, other = "does not exist", path, ""
        if path.exists():
            other = f"; or a recording of its files: dmrl convert {path} OUT.mcap"
            what, out = "is not a dataset", Path("OUT")
        words = f"Make one with: dmrl dataset RECORDING.mcap {out}{other}"
        raise DatasetError(f"{path} {what}. {words}")
    return Dataset(
        path, tuple(check_split_name(name, f"{path}: a split") for name in splits), parquet
    )


def _load_split_names(file: Path) -> tuple[str, ...]:
    said = _load_json(file)
    found = said.get("splits") if isinstance(said, dict) else None
    if not isinstance(found, list) or not all(isinstance(name, str) for name in found):
        raise DatasetError(f"{file} has no list of splits. Make the dataset again")
    return tuple(found)


def _parse_parquet_names(folder: Path) -> list[tuple[str, int, int]]:
    paths = (folder / "data").glob("*.parquet")
    matches = (PARQUET_NAME_PATTERN.fullmatch(path.name) for path in paths)
    return [(m["split"], int(m["index"]), int(m["count"])) for m in matches if m]


def _load_json(path: Path) -> Any:
    try:
        return parse_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DatasetError(f"{path} is missing. Make the dataset again, or copy it whole") from None
    except ValueError as e:
        raise DatasetError(f"{path} is not JSON: {e}. Make the dataset again") from None
