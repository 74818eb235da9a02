"""Untrusted shards: invalid layouts are refused before their data are read."""

import shutil
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from dmrl.datasets import open_dataset, shards
from dmrl.datasets.layout import MANIFEST_FILE, build_schema
from dmrl.datasets.shards import open_shard
from dmrl.errors import DatasetError
from dmrl.stages.dataset import Settings, run

from .conftest import HEIGHT_PX, WIDTH_PX, Record, peer, recorder

SHARD = "train/data-00000-of-00001.arrow"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of four images. To be read only."""
    folder = tmp_path_factory.mktemp("shards")
    flight = recorder(folder)(peers=[[peer()] * k for k in (1, 2, 3, 1)])
    run([flight], folder / "set", Settings())
    return folder / "set"


@pytest.fixture
def shard(made: Path, tmp_path: Path) -> Path:
    """A shard of it, to be changed."""
    return shutil.copytree(made, tmp_path / "set") / SHARD


def rewritten(path: Path, table: pa.Table, compression: str | None = None, times: int = 1) -> None:
    """The shard with another table in it, ``times`` over."""
    options = pa.ipc.IpcWriteOptions(compression=compression)
    with pa.ipc.new_stream(str(path), table.schema, options=options) as sink:
        for _ in range(times):
            sink.write_table(table)


def table_of(path: Path) -> pa.Table:
    with path.open("rb") as stream:
        return pa.ipc.open_stream(stream.read()).read_all()


@pytest.mark.parametrize("column", ["peers", "robot", "source", "split"])
@pytest.mark.parametrize("offset", [2_000_000_000, -2_000_000_000])
@pytest.mark.heavy
def test_an_offset_beyond_its_buffer_is_refused(shard: Path, column: str, offset: int) -> None:
    data = bytearray(shard.read_bytes())
    offsets = table_of(shard)[column].chunk(0).buffers()[1].to_pybytes()[:20]
    at = data.rfind(offsets)
    data[at + 4 : at + 20] = struct.pack("<i", offset) * 4
    shard.write_bytes(data)
    with pytest.raises(DatasetError, match="is cut short or damaged"):
        open_shard(shard, None)


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.heavy
def test_a_compressed_shard_is_read(shard: Path, compression: str) -> None:
    sound = table_of(shard)
    rewritten(shard, sound, compression)
    assert open_shard(shard, 4).equals(sound)


@pytest.mark.heavy
def test_a_shard_that_unpacks_to_much_is_refused(shard: Path) -> None:
    many = pa.concat_tables([table_of(shard).slice(0, 1)] * 5_000).combine_chunks()
    rewritten(shard, many, "zstd", times=20)
    assert shard.stat().st_size < 5_000_000
    with pytest.raises(DatasetError, match="decompresses to much more than its size explains"):
        open_shard(shard, None)


@pytest.mark.heavy
def test_a_parquet_file_that_repeats_one_row_without_end_is_refused(
    shard: Path, tmp_path: Path
) -> None:
    rows = pa.concat_tables([table_of(shard).slice(0, 1)] * 20_000).combine_chunks()
    path = tmp_path / "train.parquet"
    with pq.ParquetWriter(path, rows.schema, compression="zstd") as sink:
        for _ in range(10):
            sink.write_table(rows)
    assert path.stat().st_size < 5_000_000
    with pytest.raises(DatasetError, match="decompresses to much more than its size explains"):
        open_shard(path, None)


def _replaced(name: str, of: Callable[[pa.Table], Any]) -> Callable[[pa.Table], pa.Table]:
    def change(table: pa.Table) -> pa.Table:
        return table.set_column(table.schema.get_field_index(name), name, of(table))

    return change


def _a_peer_missing(table: pa.Table) -> pa.Array:
    peers = table["peers"].to_pylist()
    peers[1][0] = None
    return pa.array(peers, table["peers"].type)


def _many_peers(table: pa.Table) -> pa.Array:
    return pa.array([table["peers"][0].as_py() * 1001] * 4, table["peers"].type)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda t: t.drop_columns("peers"), "no column peers"),
        (lambda t: t.drop_columns("pixels"), "no column pixels"),
        (lambda t: t.append_column("depth", t["depth"]), "a column twice"),
        (_replaced("depth", lambda t: pa.array([1.0] * 4)), "depth of another type"),
        (_replaced("confidence", lambda t: pa.array(["x"] * 4)), "no grid"),
        (_replaced("source", lambda t: pa.array([1] * 4)), "source of another type"),
        (_replaced("pixels", lambda t: pa.array([b"x"] * 4)), "pixels of another type"),
        (_replaced("source", lambda t: pa.array([None] * 4, pa.string())), "values missing"),
        (_replaced("peers", _a_peer_missing), "peers with values missing"),
        (_replaced("peers", _many_peers), "an image with 1001 peers"),
        (_replaced("source", lambda t: pa.array(["x" * 2000] * 4)), "a very long name"),
        (
            _replaced(
                "confidence",
                lambda t: pa.array([[[]]] * 4, pa.list_(pa.list_(pa.float32(), 0), 1)),
            ),
            "grids of 0 x 1",
        ),
    ],
)
def test_invalid_dataset_layout_is_refused(
    shard: Path, change: Callable[[pa.Table], pa.Table], complaint: str
) -> None:
    rewritten(shard, change(table_of(shard)))
    with pytest.raises(DatasetError, match=complaint):
        open_shard(shard, None)


def test_unknown_columns_are_kept(shard: Path) -> None:
    table = table_of(shard)
    nested: Any = pa.array([[[["x"]]]] * 4)
    rewritten(shard, table.append_column("mine", nested))
    assert open_shard(shard, 4).equals(table)


def test_a_split_without_images_and_a_shard_named_twice_are_refused(shard: Path) -> None:
    rewritten(shard, build_schema(HEIGHT_PX, WIDTH_PX).empty_table())
    state, folder = shard.parent / "state.json", shard.parents[1]
    (shard.parent / "dataset_info.json").write_text("{}")
    (folder / MANIFEST_FILE).unlink()  # as another program leaves it
    with pytest.raises(DatasetError, match="has no images"):
        open_dataset(folder).split("train")
    name = f'{{"filename": "{shard.name}"}}'
    state.write_text(f'{{"_data_files": [{name}, {name}]}}')
    with pytest.raises(DatasetError, match="named twice"):
        open_dataset(folder).split("train")
    state.write_text('{"_data_files": []}')
    with pytest.raises(DatasetError, match="has no images"):
        open_dataset(folder).split("train")


@pytest.mark.heavy
def test_images_whose_size_differs_from_their_labels_are_refused(
    record: Record, tmp_path: Path
) -> None:
    run([record()], tmp_path / "set", Settings(split="none", png=True))
    path = tmp_path / "set" / SHARD
    table = table_of(path)
    wide = build_schema(HEIGHT_PX, 2 * WIDTH_PX, packed=True)
    grid = [[[0.0] * (2 * WIDTH_PX // 8)] * (HEIGHT_PX // 8)] * 6
    for name in ("confidence", "depth"):
        column = pa.array(grid, wide.field(name).type)
        table = table.set_column(table.schema.get_field_index(name), name, column)
    rewritten(path, table)
    with pytest.raises(DatasetError, match="another size than its labels"):
        _ = open_dataset(tmp_path / "set").split("train").pixels[0][0]


def flags_of(path: Path) -> list[str]:
    """The kernel's flags of the map of a file: rr is read from disk as it is used, alone."""
    lines = iter(Path("/proc/self/smaps").read_text(encoding="utf-8").splitlines())
    assert any(line.endswith(str(path)) for line in lines)
    return next(line for line in lines if line.startswith("VmFlags")).split()[1:]


@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux how files are mapped")
@pytest.mark.heavy
def test_opening_a_shard_reads_no_images_ahead_but_training_does(
    shard: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[list[str]] = []
    whole = shards._find_layout_error

    def watch(table: pa.Table) -> str:
        seen.append(flags_of(shard))
        return whole(table)

    monkeypatch.setattr(shards, "_find_layout_error", watch)
    table = open_shard(shard, None)
    assert len(seen) == 1 and "rr" in seen[0]
    assert table.num_rows and "rr" not in flags_of(shard)
