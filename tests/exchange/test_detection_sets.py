"""Datasets exported to other formats: their own libraries read them, and they convert back."""

import gc
import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl.datasets import open_dataset
from dmrl.errors import DatasetError, SettingError, SourceError
from dmrl.images.codec import encode_png
from dmrl.messages import message_class
from dmrl.recording import (
    SPLIT_METADATA,
    Provenance,
    RecordingWriter,
    read,
    read_splits,
    read_summary,
)
from dmrl.stages import convert, dataset
from dmrl.terminal.left_out import count_left_out
from dmrl.topics import CAMERA_IMAGE, LABELS

pytestmark = pytest.mark.heavy

WIDTH, HEIGHT, COUNT, STEP_NS = 64, 48, 9, 50_000_000
SPLITS = {"train": f"[[0, {5 * STEP_NS}]]", "val": f"[[{6 * STEP_NS}, {8 * STEP_NS}]]"}
INFINITE = float("inf")


def build_peers(k: int) -> list[dict[str, Any]]:
    """Build the labels of image k: none, one robot with a depth, or also one without."""
    rng = np.random.default_rng(k)
    found: list[dict[str, Any]] = []
    for n in range(k % 3):
        left, top = rng.uniform(0, 40), rng.uniform(0, 30)
        right, bottom = left + rng.uniform(3, 20), top + rng.uniform(3, 15)
        known = n == 0
        found.append(
            {
                "peer": ("drone", "drone-2")[n],
                "u_px": (left + right) / 2 + 0.25,
                "v_px": (top + bottom) / 2,
                "depth_m": rng.uniform(0.5, 3) if known else 0.0,
                "sigma_depth_m": 0.125 if known else INFINITE,
                "sigma_u_px": 0.5,
                "box_px": [left, top, right, bottom],
                "source": "hand",
            }
        )
    return found


def draw_noise(k: int) -> np.ndarray:
    """Draw the noise image k, (HEIGHT, WIDTH, 3)."""
    return np.random.default_rng(100 + k).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def write_recording(path: Path, without_box: int | None = None) -> Path:
    """Write a recording with nine labelled images, and a split."""
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.add_metadata(SPLIT_METADATA, SPLITS)
        for k in range(COUNT):
            image = message_class("CompressedImage")(data=encode_png(draw_noise(k)), format="png")
            peers = build_peers(k)
            if k == without_box:
                peers = [{**peers[0], "box_px": []}, *peers[1:]]
            labels = message_class("PeerLabels")(peers=peers, sources=["hand"])
            sink.write(k * STEP_NS, CAMERA_IMAGE("cf1"), image)
            sink.write(k * STEP_NS, LABELS("cf1"), labels)
    return path


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Build a dataset of one recording, with the splits train and val."""
    dataset.run([write_recording(tmp_path / "flight.mcap")], tmp_path / "set", dataset.Settings())
    return tmp_path / "set"


def export_set(source: Path, to: str, **flags: Any) -> Path:
    """Convert a dataset to a format and return the output folder."""
    out = source.parent / f"out-{to}"
    counts = convert.run(source, out, convert.Settings(to=to, **flags))  # type: ignore[arg-type]
    assert counts == {"train": 6, "val": 3}
    return out


def iter_labels(recording: Path) -> Iterator[list[Any]]:
    """Yield the list of labels of each image."""
    for stamped in read(recording, LABELS("cf1")):
        yield list(stamped.message.peers)


def get_boxes(k: int) -> np.ndarray:
    """Return the boxes of image k, (N, 4) pixels."""
    return np.array([peer["box_px"] for peer in build_peers(k)]).reshape(-1, 4)


def test_supervision_reads_yolo(source: Path) -> None:
    sv = pytest.importorskip("supervision")
    out = export_set(source, "yolo")
    for split, first in (("train", 0), ("val", 6)):
        found = sv.DetectionDataset.from_yolo(
            str(out / "images" / split), str(out / "labels" / split), str(out / "data.yaml")
        )
        assert found.classes == ["drone"]
        for k, path in enumerate(sorted(found.image_paths), first):
            np.testing.assert_allclose(found.annotations[path].xyxy, get_boxes(k), atol=0.01)
            assert set(found.annotations[path].class_id) <= {0}
    assert found[0][1].shape == (HEIGHT, WIDTH, 3)


def test_pycocotools_reads_coco(source: Path) -> None:
    coco = pytest.importorskip("pycocotools.coco")
    out = export_set(source, "coco", names="drone=robot")
    for split, first in (("train", 0), ("val", 6)):
        found = coco.COCO(str(out / "annotations" / f"instances_{split}.json"))
        assert [c["name"] for c in found.loadCats(found.getCatIds())] == ["robot"]
        for k, number in enumerate(found.getImgIds(), first):
            (image,) = found.loadImgs(number)
            assert (image["width"], image["height"]) == (WIDTH, HEIGHT)
            assert image["log_time"] == k * STEP_NS
            assert (out / split / image["file_name"]).read_bytes() == encode_png(draw_noise(k))
            own = found.loadAnns(found.getAnnIds(imgIds=number))
            boxes = np.array([a["bbox"] for a in own]).reshape(-1, 4)
            boxes[:, 2:] += boxes[:, :2]
            np.testing.assert_allclose(boxes, get_boxes(k), atol=1e-9)
            for annotation, peer in zip(own, build_peers(k), strict=True):
                assert annotation["attributes"].get("depth_m", 0) == pytest.approx(peer["depth_m"])


@pytest.mark.parametrize("to", ["yolo", "coco"])
def test_boxes_round_trip_within_a_hundredth_of_a_pixel(to: str, source: Path) -> None:
    out = export_set(source, to)
    again = source.parent / "again.mcap"
    with count_left_out() as counted:
        convert.run(out, again, convert.Settings())
    assert not counted.counts
    found = list(iter_labels(again))
    assert len(found) == COUNT
    for k, peers in enumerate(found):
        assert [peer.peer for peer in peers] == [peer["peer"] for peer in build_peers(k)]
        boxes = np.array([peer.box_px for peer in peers]).reshape(-1, 4)
        np.testing.assert_allclose(boxes, get_boxes(k), atol=0.01)
        for peer, want in zip(peers, build_peers(k), strict=True) if to == "coco" else ():
            assert (peer.u_px, peer.depth_m) == pytest.approx((want["u_px"], want["depth_m"]))
            assert (peer.sigma_u_px, peer.sigma_depth_m) == (0.5, want["sigma_depth_m"])
    images = [s.message.data for s in read(again, CAMERA_IMAGE("cf1"))]
    assert images == [encode_png(draw_noise(k)) for k in range(COUNT)]
    splits = read_splits(again, read_summary(again))
    spans = {name: [tuple(span) for span in own] for name, own in splits.items()}
    assert spans == {"train": [(0, 500_000_000)], "val": [(600_000_000, 800_000_000)]}


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_webdataset_reads_its_shards(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wds = pytest.importorskip("webdataset")
    monkeypatch.setattr("dmrl.exchange.detection_sets.SHARD_IMAGES", 4)
    out = export_set(source, "webdataset")
    names = ["train-000000.tar", "train-000001.tar", "val-000000.tar"]
    assert sorted(path.name for path in out.glob("*.tar")) == names
    urls = [str(out / name) for name in names]
    rows = list(wds.WebDataset(urls, shardshuffle=False).decode("rgb8"))
    gc.collect()  # closes files that webdataset leaves open
    assert len(rows) == COUNT
    for k, row in enumerate(rows):
        np.testing.assert_array_equal(row["png"], draw_noise(k))
        told = row["json"]
        assert (told["log_time"], told["robot"]) == (k * STEP_NS, "cf1")
        assert told["split"] == ("train" if k < 6 else "val")
        assert told["recording"] == "flight.mcap"
        for peer, want in zip(told["peers"], build_peers(k), strict=True):
            assert peer["box_px"] == want["box_px"]
            assert peer["class"] == "drone"
            assert peer.get("depth_m") == (want["depth_m"] or None)


def build_features(info: dict[str, Any]) -> Any:
    """Build the features of a LeRobot dataset as lerobot.datasets.utils does."""
    hf = pytest.importorskip("datasets")
    types = {}
    for key, feature in info["features"].items():
        value = hf.Value(feature["dtype"]) if feature["dtype"] != "image" else hf.Image()
        if feature["dtype"] != "image" and feature["shape"] != [1]:
            value = hf.Sequence(value, length=feature["shape"][0])
        types[key] = value
    return hf.Features(types)


def test_lerobot_export_matches_its_schema(source: Path) -> None:
    hf = pytest.importorskip("datasets")
    pandas = pytest.importorskip("pandas")
    out = export_set(source, "lerobot")
    info = json.loads((out / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"]) == ("v3.0", 20)
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (2, 9, 1)
    assert info["splits"] == {"train": "0:1", "val": "1:2"}
    tasks = pandas.read_parquet(out / "meta/tasks.parquet")
    assert tasks.loc["Detect the peers in the image."].task_index == 0
    episodes = pandas.read_parquet(out / "meta/episodes/chunk-000/file-000.parquet")
    assert episodes["length"].tolist() == [6, 3]
    assert episodes["dataset_from_index"].tolist() == [0, 6]
    files = [
        info["data_path"].format(chunk_index=c, file_index=f)
        for c, f in zip(episodes["data/chunk_index"], episodes["data/file_index"], strict=True)
    ]
    paths = [str(out / file) for file in files]
    cache = str(source.parent / "cache")
    rows = hf.Dataset.from_parquet(paths, features=build_features(info), cache_dir=cache)
    assert rows["index"][:] == list(range(COUNT))
    assert rows["episode_index"][:] == [0] * 6 + [1] * 3
    for k, row in enumerate(rows):
        np.testing.assert_array_equal(np.asarray(row["observation.images.camera"]), draw_noise(k))
        frame = k if k < 6 else k - 6
        assert row["timestamp"] == pytest.approx(frame / 20)
        assert row["log_time"] == k * STEP_NS
        peers = build_peers(k)
        for name in ("u_px", "v_px", "depth_m"):
            want = [peer[name] if peer[name] else np.nan for peer in peers]
            want += [np.nan] * (2 - len(want))
            np.testing.assert_allclose(row[f"labels.{name}"], want, atol=0.001)
        edges = [row[f"labels.{name}_px"][: len(peers)] for name in ("left", "top")]
        np.testing.assert_allclose(np.array(edges).T, get_boxes(k)[:, :2], atol=0.001)


READ_BY_LEROBOT = """
import sys

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("dmrl/test", root=sys.argv[1])
assert (dataset.num_frames, dataset.num_episodes, dataset.fps) == (9, 2, 20)
rows = [dataset[k] for k in range(len(dataset))]
names = [n for n in rows[0] if n.startswith("labels.") or n in ("log_time", "episode_index")]
columns = {n: np.stack([row[n].numpy() for row in rows]) for n in names}
images = np.stack([row["observation.images.camera"].numpy() for row in rows])
np.savez(sys.argv[2], images=images, **columns)
"""


def test_lerobot_reads_it(source: Path, tmp_path: Path) -> None:
    python = os.environ.get("DMRL_LEROBOT_PYTHON")
    if not python:
        pytest.skip("lerobot needs an environment of its own: make test-lerobot")
    read_by_lerobot = [
        python,
        "-c",
        READ_BY_LEROBOT,
        export_set(source, "lerobot"),
        tmp_path / "rows",
    ]
    subprocess.run(read_by_lerobot, check=True, env={**os.environ, "HF_HUB_OFFLINE": "1"})
    rows = np.load(tmp_path / "rows.npz")
    assert rows["episode_index"].tolist() == [0] * 6 + [1] * 3
    assert rows["log_time"].tolist() == [k * STEP_NS for k in range(COUNT)]
    for k, image in enumerate(rows["images"]):
        np.testing.assert_allclose(image.transpose(1, 2, 0) * 255, draw_noise(k), atol=0.001)
        count = len(build_peers(k))
        box = [rows[f"labels.{name}_px"][k] for name in ("left", "top", "right", "bottom")]
        np.testing.assert_allclose(np.array(box).T[:count], get_boxes(k), atol=0.01)
        assert np.isnan(np.array(box).T[count:]).all()
        depths = [peer["depth_m"] or np.nan for peer in build_peers(k)]
        np.testing.assert_allclose(rows["labels.depth_m"][k][:count], depths, atol=1e-5)


@pytest.mark.parametrize("to", ["yolo", "coco", "lerobot", "webdataset"])
def test_the_same_dataset_gives_the_same_bytes(to: str, source: Path) -> None:
    first = export_set(source, to)
    kept = {p.relative_to(first): p.read_bytes() for p in first.rglob("*") if p.is_file()}
    first.rename(first.with_name("first"))
    again = export_set(source, to)
    assert kept == {p.relative_to(again): p.read_bytes() for p in again.rglob("*") if p.is_file()}


@pytest.mark.parametrize("to", ["yolo", "coco"])
def test_a_label_without_a_box_needs_the_width_of_the_robot(to: str, tmp_path: Path) -> None:
    recording = write_recording(tmp_path / "flight.mcap", without_box=1)
    dataset.run([recording], tmp_path / "set", dataset.Settings())
    with count_left_out() as counted:
        counts = convert.run(tmp_path / "set", tmp_path / "out", convert.Settings(to=to))
    assert counts == {"train": 5, "val": 3}
    assert counted.counts == {
        "images with a label without a box (--robot-width-m and --camera give one)": 1
    }
    (tmp_path / "camera.toml").write_text(
        f"width_px = {WIDTH}\nheight_px = {HEIGHT}\nfx_px = 40.0\nfy_px = 40.0\n"
        "cx_px = 32.0\ncy_px = 24.0\n"
    )
    flags = {"robot_width_m": 0.1, "camera": tmp_path / "camera.toml"}
    convert.run(tmp_path / "set", tmp_path / "more", convert.Settings(to=to, **flags))
    convert.run(tmp_path / "more", tmp_path / "back.mcap", convert.Settings())
    (peer,) = list(iter_labels(tmp_path / "back.mcap"))[1]
    left, _, right, _ = peer.box_px
    assert right - left == pytest.approx(40 * 0.1 / build_peers(1)[0]["depth_m"], abs=0.01)


def test_invalid_export_gives_one_line_error(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(DatasetError, match="is not a dataset"):
        convert.run(tmp_path / "flight.mcap", out, convert.Settings(to="yolo"))
    with pytest.raises(SettingError, match="--rate-hz has no effect with --to coco"):
        convert.run(source, out, convert.Settings(to="coco", rate_hz=3))
    with pytest.raises(SettingError, match="--robot-width-m has no effect with --to lerobot"):
        convert.run(source, out, convert.Settings(to="lerobot", robot_width_m=3))
    assert not out.exists()


def test_export_without_boxes_gives_one_line_error(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "flight.mcap", Provenance("test")) as sink:
        image = message_class("CompressedImage")(data=encode_png(draw_noise(0)), format="png")
        peer = {"peer": "cf2", "u_px": 9, "v_px": 9, "depth_m": 1, "source": "hand"}
        sink.write(0, CAMERA_IMAGE("cf1"), image)
        sink.write(0, LABELS("cf1"), message_class("PeerLabels")(peers=[peer]))
    dataset.run([tmp_path / "flight.mcap"], tmp_path / "set", dataset.Settings())
    with pytest.raises(SourceError, match="no image that --to yolo can hold"), count_left_out():
        convert.run(tmp_path / "set", tmp_path / "out", convert.Settings(to="yolo"))
    assert not (tmp_path / "out").exists()
    assert open_dataset(tmp_path / "set").splits == ("train",)
