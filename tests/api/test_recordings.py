"""The Python interface to recordings: topics, tables, images, labels and errors."""

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

import dmrl
from dmrl.api.topic import to_data_frame
from dmrl.errors import MissingTopic, RecordingError, SettingError
from dmrl.images.codec import decode
from dmrl.recording import read, read_table


@pytest.mark.heavy
def test_recording_lists_topics_robots_and_time(flight: Path) -> None:
    rec = dmrl.open(flight)
    assert rec.robots == ["cf1", "cf2"]
    assert "/cf1/attitude" in rec and rec.topics["/cf1/attitude"].schema == "dmrl.v1.Attitude"
    assert len(rec["/cf1/attitude"]) == rec.topics["/cf1/attitude"].count > 300
    assert rec.duration_s == pytest.approx(6.0, abs=0.1)
    assert rec.provenance is not None and rec.provenance.stage == "fly"


@pytest.mark.heavy
def test_a_topic_as_arrow_pandas_and_numpy_is_the_same(flight: Path) -> None:
    topic = dmrl.open(flight)["/cf1/attitude"]
    table = topic.to_arrow()
    assert table.equals(read_table(flight, "/cf1/attitude"))
    frame, array = topic.to_pandas(), topic.to_numpy()
    for name in ("log_time", "roll_rad", "yaw_rate_radps"):
        assert np.array_equal(frame[name], table[name].to_numpy())
        assert np.array_equal(array[name], table[name].to_numpy())
    assert frame.index[0] == pytest.approx(
        (table["log_time"][0].as_py() - dmrl.open(flight).start_ns) / 1e9
    )


def test_topic_is_read_by_time_span_and_fields(flight: Path) -> None:
    rec = dmrl.open(flight)
    frame = rec["/cf1/height"].to_pandas(fields=["height_m"], start_s=1.0, end_s=2.0)
    assert list(frame.columns) == ["log_time", "publish_time", "height_m"]
    assert frame.index.min() >= 1.0 and frame.index.max() < 2.0
    assert 90 <= len(frame) <= 110


def test_nested_messages_become_dotted_columns(flight: Path) -> None:
    frame = dmrl.open(flight)["/tf"].to_pandas()
    assert "transforms.translation.x" in frame.columns


def test_labels_have_a_row_per_peer_and_a_status_by_name(flight: Path) -> None:
    labels = dmrl.open(flight).labels()
    said = [
        (m.time_ns, peer.peer, peer.u_px)
        for m in read(flight, "/*/labels")
        for peer in m.message.peers
    ]
    known = labels.dropna(subset=["u_px"])
    found = zip(known["log_time"], known["peer"], known["u_px"], strict=True)
    assert sorted(found) == sorted(said) and said
    assert set(known["status"]) == {"OK"}
    assert set(labels["robot"]) == {"cf1", "cf2"}


def test_images_are_decoded_one_by_one_sliced_and_near_a_time(flight: Path) -> None:
    images = dmrl.open(flight).images("cf1")
    every = [decode(m.message.data) for m in read(flight, "/cf1/camera/image")]
    assert len(images) == len(every) == 12
    assert all(np.array_equal(a, b) for a, b in zip(images, every, strict=True))
    assert np.array_equal(images[-1], every[-1]) and np.array_equal(images[2], every[2])
    assert np.array_equal(images[2:4].to_numpy(), np.stack(every[2:4]))
    late = images.between(1.9)
    assert len(late) == 8 and np.array_equal(late[0], every[4])
    assert np.array_equal(images.nearest(float(images.time_s[3]) + 0.1), every[3])
    with pytest.raises(IndexError):
        images[12]


def test_images_of_several_robots_need_a_robot_name(flight: Path) -> None:
    with pytest.raises(SettingError, match="Name one"):
        dmrl.open(flight).images()
    with pytest.raises(MissingTopic):
        dmrl.open(flight).images("cf9")


def test_missing_topic_or_recording_is_reported(flight: Path, tmp_path: Path) -> None:
    with pytest.raises(MissingTopic, match="Did you mean /cf1/attitude"):
        dmrl.open(flight)["/cf1/atitude"]
    with pytest.raises(RecordingError, match="no recording"):
        dmrl.open(tmp_path / "none.mcap")


def test_names_are_escaped_in_html(tmp_path: Path) -> None:
    with dmrl.writer(tmp_path / "odd.mcap") as out:
        out.write("/<b>/height", 0.0, {"height_m": 1.0})
    html = dmrl.open(tmp_path / "odd.mcap")._repr_html_()
    assert "<b>/height" not in html and "&lt;b&gt;" in html


def test_images_have_html_and_an_empty_span_is_allowed(flight: Path) -> None:
    images = dmrl.open(flight).images("cf1")
    assert images._repr_html_().count("<img") == 6 and images[:2]._repr_html_().count("<img") == 2
    none = images.between(90.0, 91.0)
    assert none._repr_html_().count("<img") == 0 and none.to_numpy().shape == (0, 0, 0, 3)
    with pytest.raises(IndexError, match="no image here"):
        none.nearest(1.0)


def test_images_keep_the_order_of_a_slice(tmp_path: Path) -> None:
    pictures = [np.full((8, 8, 3), 10 * k, np.uint8) for k in range(6)]
    with dmrl.writer(tmp_path / "a.mcap") as out:
        for rgb, time_s in zip(pictures, (0.0, 0.1, 0.1, 0.1, 0.2, 0.3), strict=True):
            out.image("cf1", time_s, rgb)
    images = out.open().images("cf1")
    assert [int(image[0, 0, 0]) for image in images] == [0, 10, 20, 30, 40, 50]
    for chosen in (slice(None, None, -1), slice(2, 4), slice(5, 1, -2), slice(1, None, 3)):
        want = [10 * k for k in range(6)[chosen]]
        assert [int(image[0, 0, 0]) for image in images[chosen]] == want
        assert [int(images[chosen][k][0, 0, 0]) for k in range(len(want))] == want
    assert len(images.between(0.1, 0.2)) == 3 == len(images[::-1].between(0.1, 0.2))


def test_unknown_field_or_time_is_reported(tmp_path: Path) -> None:
    with dmrl.writer(tmp_path / "a.mcap") as out:
        out.write_columns("/cf1/height", [1.0, 2.0], {"height_m": [0.5, 0.6]})
    topic = out.open()["/cf1/height"]
    with pytest.raises(RecordingError, match=r"no field heigth_m\. Did you mean height_m\?"):
        topic.to_numpy(fields=["heigth_m"])
    for wrong in (float("nan"), "a"):
        with pytest.raises(SettingError, match=r"(nan|'a') is no time"):
            topic.to_arrow(start_s=wrong)  # type: ignore[arg-type]
    assert len(topic.to_arrow(start_s=-float("inf"), end_s=float("inf"))) == 2
    assert topic.to_arrow(fields="height_m").column_names[2:] == ["height_m"]


def test_integers_stay_exact_beside_absent_ones(tmp_path: Path) -> None:
    """As floats, which can be NaN, large integers would be rounded."""
    with dmrl.writer(tmp_path / "a.mcap") as out:
        out.write("/cf1/tracks", 0.0, {"tracks": [{"id": 7}]})
        out.write("/cf1/tracks", 0.1, {"tracks": []})
    topic = out.open()["/cf1/tracks"]
    numbers = topic.to_pandas()["tracks.id"]
    assert str(numbers.dtype) == "UInt32" and numbers[0.0] == 7 and numbers.isna()[0.1]
    assert topic.to_numpy()["tracks.id"].tolist() == [7, None]
    table = pa.table({"log_time": [0, 1], "count": [2**60 + 1, None]})
    assert to_data_frame(table, 0)["count"].tolist() == [2**60 + 1, pd.NA]


def test_a_status_has_its_name_in_every_data_frame(tmp_path: Path) -> None:
    with dmrl.writer(tmp_path / "a.mcap") as out:
        out.write("/cf1/labels", 0.0, {"peers": [{"status": "UNCONVERGED"}]})
        out.write("/cf1/labels", 0.1, {})
    rec = out.open()
    assert rec.labels()["status"][0.0] == "UNCONVERGED"
    assert rec["/cf1/labels"].to_pandas()["peers.status"][0.0] == "UNCONVERGED"
