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

from .conftest import HEIGHT_PX, WIDTH_PX, Record, build_peer, make_recorder

SHARD = "train/data-00000-of-00001.arrow"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a dataset of four images; tests must not change it."""
    folder = tmp_path_factory.mktemp("shards")
    flight = make_recorder(folder)(peers=[[build_peer()] * k for k in (1, 2, 3, 1)])
    run([flight], folder / "set", Settings())
    return folder / "set"


@pytest.fixture
def shard(dataset: Path, tmp_path: Path) -> Path:
    """Return a shard in a copy of the dataset that the test may change."""
    return shutil.copytree(dataset, tmp_path / "set") / SHARD


def rewrite_shard(
    path: Path, table: pa.Table, compression: str | None = None, times: int = 1
) -> None:
    """Overwrite a shard with a table, written ``times`` times."""
    options = pa.ipc.IpcWriteOptions(compression=compression)
    with pa.ipc.new_stream(str(path), table.schema, options=options) as sink:
        for _ in range(times):
            sink.write_table(table)


def read_shard(path: Path) -> pa.Table:
    """Return the table of a shard."""
    with path.open("rb") as stream:
        return pa.ipc.open_stream(stream.read()).read_all()


@pytest.mark.parametrize("column", ["peers", "robot", "source", "split"])
@pytest.mark.parametrize("offset", [2_000_000_000, -2_000_000_000])
@pytest.mark.heavy
def test_an_offset_beyond_its_buffer_is_refused(shard: Path, column: str, offset: int) -> None:
    data = bytearray(shard.read_bytes())
    offsets = read_shard(shard)[column].chunk(0).buffers()[1].to_pybytes()[:20]
    at = data.rfind(offsets)
    data[at + 4 : at + 20] = struct.pack("<i", offset) * 4
    shard.write_bytes(data)
    with pytest.raises(DatasetError, match="is cut short or damaged"):
        open_shard(shard, None)


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.heavy
def test_a_compressed_shard_is_read(shard: Path, compression: str) -> None:
    sound = read_shard(shard)
    rewrite_shard(shard, sound, compression)
    assert open_shard(shard, 4).equals(sound)


@pytest.mark.heavy
def test_a_shard_that_unpacks_to_much_is_refused(shard: Path) -> None:
    many = pa.concat_tables([read_shard(shard).slice(0, 1)] * 5_000).combine_chunks()
    rewrite_shard(shard, many, "zstd", times=20)
    assert shard.stat().st_size < 5_000_000
    with pytest.raises(DatasetError, match="decompresses to much more than its size explains"):
        open_shard(shard, None)


@pytest.mark.heavy
def test_parquet_file_of_one_row_repeated_many_times_is_refused(
    shard: Path, tmp_path: Path
) -> None:
    rows = pa.concat_tables([read_shard(shard).slice(0, 1)] * 20_000).combine_chunks()
    path = tmp_path / "train.parquet"
    with pq.ParquetWriter(path, rows.schema, compression="zstd") as sink:
        for _ in range(10):
            sink.write_table(rows)
    assert path.stat().st_size < 5_000_000
    with pytest.raises(DatasetError, match="decompresses to much more than its size explains"):
        open_shard(path, None)


def replace_column(name: str, of: Callable[[pa.Table], Any]) -> Callable[[pa.Table], pa.Table]:
    """Return a function that replaces a column of a table by what ``of`` makes of the table."""

    def change(table: pa.Table) -> pa.Table:
        return table.set_column(table.schema.get_field_index(name), name, of(table))

    return change


def remove_a_peer(table: pa.Table) -> pa.Array:
    peers = table["peers"].to_pylist()
    peers[1][0] = None
    return pa.array(peers, table["peers"].type)


def add_many_peers(table: pa.Table) -> pa.Array:
    return pa.array([table["peers"][0].as_py() * 1001] * 4, table["peers"].type)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda t: t.drop_columns("peers"), "no column peers"),
        (lambda t: t.drop_columns("pixels"), "no column pixels"),
        (lambda t: t.append_column("depth", t["depth"]), "a column twice"),
        (replace_column("depth", lambda t: pa.array([1.0] * 4)), "depth of another type"),
        (replace_column("confidence", lambda t: pa.array(["x"] * 4)), "no grid"),
        (replace_column("source", lambda t: pa.array([1] * 4)), "source of another type"),
        (replace_column("pixels", lambda t: pa.array([b"x"] * 4)), "pixels of another type"),
        (replace_column("source", lambda t: pa.array([None] * 4, pa.string())), "values missing"),
        (replace_column("peers", remove_a_peer), "peers with values missing"),
        (replace_column("peers", add_many_peers), "an image with 1001 peers"),
        (replace_column("source", lambda t: pa.array(["x" * 2000] * 4)), "a very long name"),
        (
            replace_column(
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
    rewrite_shard(shard, change(read_shard(shard)))
    with pytest.raises(DatasetError, match=complaint):
        open_shard(shard, None)


def test_unknown_columns_are_kept(shard: Path) -> None:
    table = read_shard(shard)
    nested: Any = pa.array([[[["x"]]]] * 4)
    rewrite_shard(shard, table.append_column("mine", nested))
    assert open_shard(shard, 4).equals(table)


def test_a_split_without_images_and_a_shard_named_twice_are_refused(shard: Path) -> None:
    rewrite_shard(shard, build_schema(HEIGHT_PX, WIDTH_PX).empty_table())
    state, folder = shard.parent / "state.json", shard.parents[1]
    (shard.parent / "dataset_info.json").write_text("{}")
    (folder / MANIFEST_FILE).unlink()  # as in a dataset of another program
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
    table = read_shard(path)
    wide = build_schema(HEIGHT_PX, 2 * WIDTH_PX, packed=True)
    grid = [[[0.0] * (2 * WIDTH_PX // 8)] * (HEIGHT_PX // 8)] * 6
    for name in ("confidence", "depth"):
        column = pa.array(grid, wide.field(name).type)
        table = table.set_column(table.schema.get_field_index(name), name, column)
    rewrite_shard(path, table)
    with pytest.raises(DatasetError, match="another size than its labels"):
        _ = open_dataset(tmp_path / "set").split("train").pixels[0][0]


def read_map_flags(path: Path) -> list[str]:
    """Return the kernel's flags of a mapped file; "rr" means random access, no read-ahead."""
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

    def record_flags(table: pa.Table) -> str:
        seen.append(read_map_flags(shard))
        return whole(table)

    monkeypatch.setattr(shards, "_find_layout_error", record_flags)
    table = open_shard(shard, None)
    assert len(seen) == 1 and "rr" in seen[0]
    assert table.num_rows and "rr" not in read_map_flags(shard)
