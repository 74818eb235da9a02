"""Opening a dataset with dmrl and with the library datasets, and errors of damaged ones."""

import re
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from dmrl.datasets import open_dataset
from dmrl.datasets.layout import build_schema
from dmrl.datasets.training_examples import build_examples
from dmrl.errors import DatasetError, SettingError
from dmrl.images.codec import decode, encode_jpeg
from dmrl.stages.dataset import Settings, run

from .conftest import HEIGHT_PX, WIDTH_PX, Record, draw_noise

pytestmark = pytest.mark.heavy

datasets = pytest.importorskip("datasets", reason="datasets is not installed")

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc/self/maps")
SHARD = re.compile(r"/train/data-\d{5}-of-00002\.arrow$")


@pytest.fixture
def dataset(record: Record, tmp_path: Path) -> Path:
    """Build a dataset of two recordings in two shards."""
    flights = [record(), record("other.mcap", seed=1)]
    run(flights, tmp_path / "out", Settings(shard_images=4))
    return tmp_path / "out"


def find_mapped_file(address: int) -> str:
    """Return the file that is mapped at an address, or an empty string."""
    for line in Path("/proc/self/maps").read_text().splitlines():
        start, end = (int(x, 16) for x in line.split()[0].split("-"))
        if start <= address < end:
            return line.split(maxsplit=5)[5] if len(line.split()) > 5 else ""
    return ""


def test_datasets_opens_it_with_the_features_of_the_contract(dataset: Path) -> None:
    opened = datasets.load_from_disk(str(dataset))
    assert {name: len(split) for name, split in opened.items()} == {"train": 6, "test": 6}
    arrow = build_schema(HEIGHT_PX, WIDTH_PX)
    features = opened["train"].features
    assert features == datasets.Features.from_arrow_schema(arrow)
    assert features.arrow_schema.types == arrow.types
    assert str(features["pixels"].dtype) == f"fixed_size_binary[{HEIGHT_PX * WIDTH_PX * 3}]"
    assert features["confidence"].length == 6
    assert features["confidence"].feature.length == 8
    assert opened["train"].info.splits["train"].num_examples == 6


def test_datasets_reads_the_same_rows(dataset: Path) -> None:
    row = datasets.load_from_disk(str(dataset))["train"][5]
    split = open_dataset(dataset).split("train")
    rgb = np.frombuffer(row["pixels"], np.uint8).reshape(HEIGHT_PX, WIDTH_PX, 3)
    assert np.array_equal(rgb, np.concatenate(split.pixels)[5])
    assert np.array_equal(row["confidence"], split.confidence[5])
    assert row["peers"] == split.table["peers"][5].as_py()


def test_images_of_rows_come_from_every_shard_in_the_order_asked(dataset: Path) -> None:
    split = open_dataset(dataset).split("train")
    rows = [5, 0, 3]
    asked = np.stack(list(split.images(rows)))
    assert len(split.pixels) > 1
    assert np.array_equal(asked, np.concatenate(split.pixels)[rows])


@LINUX
def test_datasets_library_maps_pixels_without_copying(dataset: Path) -> None:
    table = datasets.load_from_disk(str(dataset), keep_in_memory=False)["train"].data
    for chunk in table["pixels"].chunks:
        assert SHARD.search(find_mapped_file(chunk.buffers()[1].address))


def test_memory_mapped_shard_contains_every_buffer(dataset: Path) -> None:
    for shard in sorted(dataset.rglob("*.arrow")):
        whole = pa.memory_map(str(shard)).read_buffer()
        table = pa.ipc.open_stream(whole).read_all()
        for column in ("pixels", "log_time"):
            for chunk in table[column].chunks:
                buffer = chunk.buffers()[1]
                assert whole.address <= buffer.address
                assert buffer.address + buffer.size <= whole.address + whole.size
                assert buffer.address % 8 == 0


@LINUX
def test_pixels_are_read_only_views_of_the_mapped_file(dataset: Path) -> None:
    for block in open_dataset(dataset).split("train").pixels:
        assert SHARD.search(find_mapped_file(block.ctypes.data))
        assert not block.flags.writeable


def test_a_sliced_table_gives_the_right_pixels(dataset: Path) -> None:
    split = open_dataset(dataset).split("train")
    part = type(split)("part", split.table.slice(1, 4))
    assert np.array_equal(np.concatenate(part.pixels), np.concatenate(split.pixels)[1:5])
    assert np.array_equal(part.depth, split.depth[1:5])


@pytest.mark.parametrize("parquet", [False, True])
@pytest.mark.parametrize("png", [False, True])
def test_every_format_opens_with_the_same_rows(
    record: Record, tmp_path: Path, png: bool, parquet: bool
) -> None:
    settings = Settings(split="none", png=png, parquet=parquet, shard_images=4)
    run([record()], tmp_path / "out", settings)
    split = open_dataset(tmp_path / "out").split("train")
    wanted = np.stack([draw_noise(k) for k in range(6)])
    assert np.array_equal(np.concatenate(split.pixels), wanted)
    assert split.confidence.sum() == 6
    assert split.image_shape == (HEIGHT_PX, WIDTH_PX)


@pytest.mark.parametrize("parquet", [False, True])
def test_recorded_jpegs_are_kept(record: Record, tmp_path: Path, parquet: bool) -> None:
    flights = [record(jpeg=True), record("other.mcap", seed=1)]
    run(flights, tmp_path / "out", Settings(split="none", pixels="jpeg", parquet=parquet))
    split = open_dataset(tmp_path / "out").split("train")
    stored = split.table["image"].to_pylist()
    camera = [encode_jpeg(draw_noise(k), 80) for k in range(6)]
    assert [image["bytes"] for image in stored[:6]] == camera
    assert [image["path"][-3:] for image in stored] == ["jpg"] * 6 + ["png"] * 6
    shown = np.concatenate(split.pixels)
    assert np.array_equal(shown[:6], [decode(data) for data in camera])
    assert np.array_equal(shown[6:], [draw_noise(1000 + k) for k in range(6)])
    part = build_examples(split).select(np.arange(12) % 4 == 1)
    assert np.array_equal(part.get_image(2), draw_noise(1003))


def test_png_and_jpeg_options_exclude_each_other(record: Record, tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="--png and --pixels jpeg"):
        run([record()], tmp_path / "out", Settings(png=True, pixels="jpeg"))


def test_datasets_shows_png_as_images(record: Record, tmp_path: Path) -> None:
    run([record()], tmp_path / "out", Settings(split="none", png=True))
    opened = datasets.load_from_disk(str(tmp_path / "out"))["train"]
    assert isinstance(opened.features["image"], datasets.Image)
    assert np.array_equal(np.asarray(opened[3]["image"]), draw_noise(3))


def test_datasets_reads_features_from_parquet(record: Record, tmp_path: Path) -> None:
    flights = [record(), record("other.mcap", seed=1)]
    run(flights, tmp_path / "out", Settings(parquet=True))
    opened = datasets.load_dataset(str(tmp_path / "out"), cache_dir=str(tmp_path / "cache"))
    assert set(opened) == {"train", "test"}
    wanted = datasets.Features.from_arrow_schema(build_schema(HEIGHT_PX, WIDTH_PX, packed=True))
    assert opened["train"].features == wanted
    assert isinstance(opened["train"].features["image"], datasets.Image)
    shown = opened["train"][3]
    assert np.array_equal(
        np.asarray(shown["image"]), draw_noise(3 + 1000 * (shown["source"] != "flight.mcap"))
    )


def test_missing_split_error_lists_existing_ones(dataset: Path) -> None:
    with pytest.raises(DatasetError, match=r"no split val in .*out. It has: train, test"):
        open_dataset(dataset).split("val")


@pytest.mark.parametrize("name", ["nothing", "empty"])
def test_a_folder_that_is_no_dataset_is_refused_with_the_way_out(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match=r"Make one with: dmrl dataset RECORDING.mcap"):
        open_dataset(tmp_path / name)


def test_error_of_a_missing_shard_names_it(dataset: Path) -> None:
    shard = dataset / "train" / "data-00001-of-00002.arrow"
    shard.unlink()
    with pytest.raises(DatasetError, match=f"{shard.name} is missing"):
        open_dataset(dataset).split("train")


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9])
def test_error_of_a_truncated_shard_names_it(dataset: Path, share: float) -> None:
    shard = dataset / "train" / "data-00000-of-00002.arrow"
    data = shard.read_bytes()
    shard.write_bytes(data[: int(share * len(data))])
    with pytest.raises(DatasetError, match=f"{shard.name} is cut short or damaged"):
        open_dataset(dataset).split("train")


def test_error_of_a_shard_truncated_between_batches_names_it(dataset: Path) -> None:
    shard = dataset / "train" / "data-00000-of-00002.arrow"
    with pa.OSFile(str(shard), "wb") as sink:
        pa.ipc.new_stream(sink, build_schema(HEIGHT_PX, WIDTH_PX)).close()
    with pytest.raises(DatasetError, match=f"{shard.name} is cut short: 0 of 4 rows"):
        open_dataset(dataset).split("train")


def test_error_of_a_missing_parquet_shard_names_it(record: Record, tmp_path: Path) -> None:
    run([record()], tmp_path / "out", Settings(split="none", parquet=True, shard_images=4))
    (tmp_path / "out/data/train-00000-of-00002.parquet").unlink()
    with pytest.raises(DatasetError, match=r"train-00000-of-00002.parquet is missing"):
        open_dataset(tmp_path / "out").split("train")


def test_broken_json_gives_one_line_error(dataset: Path) -> None:
    (dataset / "manifest.json").unlink()  # as in a dataset saved by the library datasets
    (dataset / "train" / "state.json").write_text("{")
    with pytest.raises(DatasetError, match=r"state.json is not JSON"):
        open_dataset(dataset).split("train")
