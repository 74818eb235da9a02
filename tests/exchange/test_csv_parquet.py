"""Export of recordings to CSV and Parquet tables."""

import base64
import csv
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from dmrl.errors import OutputError, UnsafeName
from dmrl.exchange import csv_parquet
from dmrl.exchange.csv_parquet import flatten_table, write_tables
from dmrl.images.codec import encode_png
from dmrl.messages import message_class
from dmrl.recording import Channel, RawMessage, RecordingWriter, build_provenance
from dmrl.recording.writer import build_topic_channel

PNG = encode_png(np.full((4, 4, 3), 7, np.uint8))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Write an image, labels with two, one and no peers, a pose and a grid map."""
    path = tmp_path / "in.mcap"
    peers = [{"peer": "cf2", "u_px": 1.5, "box_px": [1, 2, 3, 4]}, {"peer": "cf3", "u_px": 2.5}]
    with RecordingWriter(path, build_provenance("test")) as sink:
        for k in range(3):
            labels = message_class("PeerLabels")(peers=peers[: 2 - k])
            sink.write(10 * k, "/cf1/labels", labels, publish_ns=10 * k + 1)
        picture = message_class("CompressedImage")(data=PNG, format="png")
        sink.write(5, "/cf1/camera/image", picture)
        pose = message_class("PoseInFrame")(frame_id="world", pose={"position": {"x": 0.1}})
        sink.write(7, "/cf1/pose", pose)
        sink.write(9, "/cf1/detections/grid", message_class("GridMap")(rows=1, data=b"\0\1"))
    return path


@pytest.mark.parametrize("kind", ["csv", "parquet"])
@pytest.mark.heavy
def test_exported_tables_equal_the_recording(recording: Path, tmp_path: Path, kind: str) -> None:
    out = tmp_path / "out"
    counts = write_tables(recording, out, kind)  # type: ignore[arg-type]
    assert counts == {
        "/cf1/camera/image": 1,
        "/cf1/detections/grid": 1,
        "/cf1/labels": 4,
        "/cf1/pose": 1,
    }

    def table(name: str) -> pd.DataFrame:
        path = out / f"{name}.{kind}"
        return pd.read_csv(path) if kind == "csv" else pd.read_parquet(path)

    labels = table("cf1.labels")
    assert labels["log_time"].tolist() == [0, 0, 10, 20]
    assert labels["publish_time"].tolist() == [1, 1, 11, 21]
    assert labels["peers.peer"].tolist()[:3] == ["cf2", "cf3", "cf2"]
    assert pd.isna(labels["peers.peer"][3])  # the labels without peers
    assert labels["peers.u_px"].tolist()[:3] == [1.5, 2.5, 1.5]
    box = labels["peers.box_px"][0]
    assert (json.loads(box) if kind == "csv" else box.tolist()) == [1, 2, 3, 4]
    pose = table("cf1.pose")
    assert (pose["frame_id"][0], pose["pose.position.x"][0]) == ("world", 0.1)
    (name,) = table("cf1.camera.image")["data"]
    assert (out / name).read_bytes() == PNG
    data = table("cf1.detections.grid")["data"][0]
    assert (base64.b64decode(data) if kind == "csv" else data) == b"\0\1"


def test_items_of_two_lists_of_a_message_are_paired() -> None:
    """The rows are the pairs and not all combinations, also if an item holds a list itself."""
    table = pa.table(
        {
            "log_time": [1, 2, 3],
            "a": [[{"x": k, "within": [{"z": 7}, {"z": 8}]} for k in range(3)], [], None],
            "b": [[{"y": k} for k in range(3)], [{"y": 9}], None],
        }
    )
    flat = flatten_table(table).to_pydict()
    assert flat["log_time"] == [1] * 6 + [2, 3]
    assert flat["a.x"] == [0, 0, 1, 1, 2, 2, None, None]
    assert flat["a.within.z"] == [7, 8] * 3 + [None, None]
    assert flat["b.y"] == [0, 0, 1, 1, 2, 2, 9, None]
    assert flatten_table(table.slice(1)).to_pydict() == {n: v[6:] for n, v in flat.items()}


def test_unreadable_image_topic_makes_no_folder(recording: Path, tmp_path: Path) -> None:
    path, out = tmp_path / "json.mcap", tmp_path / "out"
    channel = Channel("/x", "foxglove.CompressedImage", b"{}", "jsonschema", "json")
    with RecordingWriter(path, build_provenance("test")) as sink:
        sink.write_raw(RawMessage(0, 0, channel, b"{}"))
        sink.write(0, "/cf1/height", message_class("Height")())
    write_tables(path, out, "parquet")
    assert [one.name for one in out.iterdir()] == ["cf1.height.parquet"]


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_similar_topics_have_separate_tables(tmp_path: Path, kind: str) -> None:
    path, out = tmp_path / "in.mcap", tmp_path / "out"
    like = build_topic_channel("/cf1/height", message_class("Height").DESCRIPTOR)
    rows = {"/cf1/height": 2, "/cf1.height": 3, "cf1/height": 4}
    with RecordingWriter(path, build_provenance("test")) as sink:
        for topic, count in rows.items():
            channel = Channel(topic, like.schema_name, like.schema_data)
            for k in range(count):
                sink.write_raw(
                    RawMessage(k, k, channel, message_class("Height")().SerializeToString())
                )
    assert write_tables(path, out, kind) == rows  # type: ignore[arg-type]
    read = pd.read_csv if kind == "csv" else pd.read_parquet
    assert sorted(len(read(file)) for file in out.iterdir()) == [2, 3, 4]


def test_topics_with_colliding_file_names_are_refused(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """File systems that ignore case have one file for A and a."""
    monkeypatch.setattr(csv_parquet, "to_topic_file_name", lambda topic: topic[:4].strip("/"))
    with pytest.raises(UnsafeName, match=r"/cf1/.* and another topic would both become"):
        write_tables(recording, tmp_path / "out", "csv")
    assert list(tmp_path.iterdir()) == [recording]


@pytest.mark.parametrize("kind", ["csv", "parquet"])
@pytest.mark.parametrize(
    "text",
    [
        "=1+1",
        "+1",
        "-1",
        "@A1",
        "\t=1",
        "\r=1",
        "\n=1",
        "\uff1d1+1",
        "'=1",
        "cf1",
        "",
        "a=1",
        "a\r=1",
    ],
)
def test_no_text_in_a_csv_is_a_formula(tmp_path: Path, kind: str, text: str) -> None:
    path = tmp_path / "in.mcap"
    with RecordingWriter(path, build_provenance("test")) as sink:
        labels = message_class("PeerLabels")(peers=[{"peer": text, "u_px": -1.5, "source": "hand"}])
        sink.write(0, "/cf1/labels", labels)
    write_tables(path, tmp_path / "out", kind)  # type: ignore[arg-type]
    file = tmp_path / "out" / f"cf1.labels.{kind}"
    as_it_is = kind == "parquet" or text in ("cf1", "", "a=1", "a\r=1")
    if kind == "csv":
        with file.open(newline="") as stream:
            (row,) = csv.DictReader(stream)
    else:
        (row,) = pd.read_parquet(file).to_dict("records")
    assert row["peers.peer"] == (text if as_it_is else f"'{text}")
    assert float(row["peers.u_px"]) == -1.5  # negative numbers stay numbers


def test_two_images_of_one_time_become_two_files(tmp_path: Path) -> None:
    path, pictures = tmp_path / "in.mcap", [PNG, encode_png(np.zeros((4, 4, 3), np.uint8))]
    with RecordingWriter(path, build_provenance("test")) as sink:
        for data in pictures:
            sink.write(
                5, "/cf1/camera/image", message_class("CompressedImage")(data=data, format="png")
            )
    write_tables(path, tmp_path / "out", "csv")
    names = pd.read_csv(tmp_path / "out" / "cf1.camera.image.csv")["data"]
    assert [(tmp_path / "out" / name).read_bytes() for name in names] == pictures


def test_exported_numbers_round_trip_exactly(tmp_path: Path) -> None:
    path, values = tmp_path / "in.mcap", np.random.default_rng(0).normal(size=50)
    with RecordingWriter(path, build_provenance("test")) as sink:
        for k, value in enumerate(values.tolist()):
            sink.write(2**60 + k, "/cf1/height", message_class("Height")(height_m=value))
    write_tables(path, tmp_path / "out", "csv")
    table = pd.read_csv(tmp_path / "out" / "cf1.height.csv")
    assert (table["height_m"] == values).all()
    assert table["log_time"][49] == 2**60 + 49


def test_a_folder_is_never_overwritten(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with pytest.raises(OutputError, match="never overwritten"):
        write_tables(recording, tmp_path / "out", "csv")
