"""Recordings written from Python: round trips and checks."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dmrl
from dmrl.errors import DmrlError, OutputError, RecordingError, SettingError, UnsafeName
from dmrl.geometry.frames import Camera
from dmrl.plugins import build_provenance


def test_written_fields_columns_images_and_camera_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    rgb = rng.integers(0, 255, (16, 24, 3), np.uint8)
    grey = rng.integers(0, 255, (16, 24), np.uint8)
    times = np.arange(5) / 10
    with dmrl.writer(tmp_path / "own.mcap", sensor="tags") as out:
        out.write("/a/range/b", 0.25, {"range_m": 1.5})
        out.write_columns("/a/height", times, {"height_m": times * 2})
        out.image("a", 0.1, rgb)
        out.image("a", 0.2, grey)
        out.camera("a", Camera(24, 16, 20.0, 20.0, 12.0, 8.0))
    rec = out.open()
    assert rec["/a/range/b"].to_numpy()["log_time"].tolist() == [250_000_000]
    assert rec["/a/height"].to_numpy()["height_m"].tolist() == (times * 2).tolist()
    assert np.array_equal(rec.images("a")[0], rgb)
    assert np.array_equal(rec.images("a")[1][..., 2], grey)
    assert rec["/a/camera/calibration"].to_arrow()["K"][0].as_py()[0] == 20.0
    assert rec.provenance is not None
    assert (rec.provenance.stage, rec.provenance.settings) == ("python", {"sensor": "tags"})


def test_an_error_in_the_block_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), dmrl.writer(tmp_path / "own.mcap") as out:
        out.write("/a/height", 0.0, {"height_m": 1 / 0})
    assert list(tmp_path.iterdir()) == []


def test_wrong_topics_fields_and_lengths_are_reported(tmp_path: Path) -> None:
    with dmrl.writer(tmp_path / "own.mcap") as out:
        with pytest.raises(RecordingError, match="no topic /a/smell"):
            out.write("/a/smell", 0.0, {})
        with pytest.raises(RecordingError, match="altitude"):
            out.write("/a/height", 0.0, {"altitude": 1.0})
        with pytest.raises(SettingError, match="3 values of height_m at 2 times"):
            out.write_columns("/a/height", [0.0, 0.1], {"height_m": [1.0, 2.0, 3.0]})
        with pytest.raises(RecordingError, match="no field altitude"):
            out.write_columns("/a/height", [0.0, 0.1], {"altitude": [1.0, 2.0]})
        with pytest.raises(
            RecordingError, match=r"Height: must be real number, not str\. Fix its fields"
        ):
            out.write_columns("/a/height", [0.0, 0.1], {"height_m": ["low", "high"]})
        with pytest.raises(SettingError, match=r"Give \(H, W, 3\)"):
            out.image("a", 0.0, np.zeros((4, 4, 4), np.uint8))
        with pytest.raises(SettingError, match=r"Give \(H, W, 3\)"):
            out.image("a", 0.0, np.zeros((0, 4, 3), np.uint8))
    with pytest.raises(OutputError, match="exists"):
        dmrl.writer(tmp_path / "own.mcap")


@pytest.mark.parametrize("time_s", [math.nan, math.inf, -0.1, 1e10])
def test_time_out_of_range_is_reported(tmp_path: Path, time_s: float) -> None:
    with dmrl.writer(tmp_path / "own.mcap") as out:
        out.write("/a/height", 0.0, {"height_m": 1.0})
        with pytest.raises(RecordingError, match=r"/a/height at .* s\. Give seconds from 0"):
            out.write("/a/height", time_s, {"height_m": 1.0})
        with pytest.raises(RecordingError, match=r"/a/height at .* s\. Give seconds from 0"):
            out.write_columns("/a/height", [0.0, time_s], {"height_m": [1.0, 2.0]})
        with pytest.raises(RecordingError, match=r"camera/image at .* s\. Give seconds from 0"):
            out.image("a", time_s, np.zeros((4, 4, 3), np.uint8))
    assert len(out.open()["/a/height"]) == 1


def test_writing_after_close_is_refused(tmp_path: Path) -> None:
    with dmrl.writer(tmp_path / "own.mcap") as out:
        out.write("/a/height", 0.0, {"height_m": 1.0})
    with pytest.raises(SettingError, match=r"own\.mcap is written"):
        out.write("/a/height", 1.0, {"height_m": 1.0})


def test_message_of_another_recording_is_written_unchanged(tmp_path: Path) -> None:
    with dmrl.writer(tmp_path / "a.mcap") as out:
        peers = [{"peer": "cf2", "u_px": 3.5, "source": "truth"}]
        out.write("/cf1/labels", 0.5, {"peers": peers})
    (first,) = dmrl.open(tmp_path / "a.mcap").messages("/cf1/labels")
    with dmrl.writer(tmp_path / "b.mcap") as out:
        out.write("/cf1/labels", 0.5, first.message)
        with pytest.raises(RecordingError, match=r"not a dmrl\.v1\.PeerLabels"):
            out.write("/cf1/height", 0.5, first.message)
    (again,) = dmrl.open(tmp_path / "b.mcap").messages("/cf1/labels")
    assert again.message.SerializeToString() == first.message.SerializeToString()


@pytest.mark.parametrize("name", ["a\nb", "\0", "\udcff", "x" * 5000, "\u202ecf2"])
def test_unreadable_name_is_refused_on_writing(name: str, tmp_path: Path) -> None:
    with dmrl.writer(tmp_path / "a.mcap") as out:
        for write in (
            lambda: out.write(f"/{name}/height", 1.0, {"height_m": 1.0}),
            lambda: out.write_columns(f"/cf1/range/{name}", [1.0], {"range_m": [1.0]}),
            lambda: out.image(name, 1.0, np.zeros((8, 8, 3), np.uint8)),
        ):
            with pytest.raises(UnsafeName, match="is called"):
                write()
        out.write("/cf1/height", 1.0, {"height_m": 1.0})
    assert list(dmrl.open(tmp_path / "a.mcap").topics) == ["/cf1/height"]


@pytest.mark.parametrize("shape", [(9_000, 9_000, 3), (1, 70_000, 3), (70_000, 70_000)])
def test_image_over_the_size_limit_is_refused_on_writing(
    shape: tuple[int, ...], tmp_path: Path
) -> None:
    with (
        dmrl.writer(tmp_path / "a.mcap") as out,
        pytest.raises(SettingError, match="more than a recording may hold"),
    ):
        out.image("cf1", 0.0, np.broadcast_to(np.uint8(0), shape))


def test_writing_outside_of_the_block_is_refused(tmp_path: Path) -> None:
    out = dmrl.writer(tmp_path / "own.mcap")
    with pytest.raises(SettingError, match=r"is not open\. Use: with"):
        out.write("/a/height", 0.0, {"height_m": 1.0})
    with out:
        out.write("/a/height", 0.0, {"height_m": 1.0})
    assert len(out.open()["/a/height"]) == 1


def test_threads_share_a_writer(tmp_path: Path) -> None:
    with dmrl.writer(tmp_path / "own.mcap") as out, ThreadPoolExecutor(4) as pool:

        def write(k: int) -> None:
            for i in range(400):
                out.write(f"/cf{k}/height", i / 100, {"height_m": i})

        list(pool.map(write, range(4)))
    for k in range(4):
        found = out.open()[f"/cf{k}/height"].to_numpy()["height_m"]
        assert found.tolist() == list(range(400))


PIXELS = np.zeros((8, 8, 3), np.uint8)
MASKED = np.ma.array([999.0, 2.0], mask=[1, 0])
GRID = "/a/detections/grid"


@pytest.mark.parametrize(
    ("write", "error"),
    [
        (lambda out: out.write("/a/height", fields={}), "has no time, or two"),
        (lambda out: out.write("/a/height", 0, {}, time_ns=0), "has no time, or two"),
        (lambda out: out.write("/a/height", time_ns=0), "without fields"),
        (lambda out: out.write_columns("/a/height", [0]), "without fields"),
        (lambda out: out.write("/a/height", time_ns=0.5, fields={}), "Give nanoseconds as int"),
        (lambda out: out.write("/a/height", time_ns=-1, fields={}), "-1 ns. Give nanoseconds from"),
        (lambda out: out.write_columns("/a/height", MASKED, {"height_m": [1, 2]}), "as numbers"),
        (lambda out: out.write_columns("/a/height", [0, 1], {"height_m": MASKED}), "masked values"),
        (lambda out: out.write("/a/height", 0, {"height_m": MASKED[0]}), "height_m has no value"),
        (lambda out: out.write("/a/labels", 0, {"sources": "truth"}), r"list: \['truth'\]"),
        (lambda out: out.write_columns("/a/labels", [0], {"sources": ["hand"]}), "sources is a"),
        (lambda out: out.write_columns(GRID, [0], {"data": np.array([b"a"])}), "list of bytes"),
        (lambda out: out.write_columns("/a/height", [0, 1], {"height_m": [10**400, 1]}), "Fix"),
        (lambda out: out.write("/smell", 0, {}), r"table|docs/formats\.md"),
        (lambda out: out.write("/a/height", 0.0, {"height_m": None}), "height_m has no value"),
        (lambda out: out.write("/a/height", "now", {}), "Give seconds as numbers"),
        (lambda out: out.write("/a/height", np.datetime64("2026-01-01"), {}), "Give seconds as"),
        (lambda out: out.write_columns("/a/height", 0.0, {"height_m": [1.0]}), "Give seconds as"),
        (lambda out: out.write_columns("/a/height", [0.0], {"height_m": 1.0}), "Give one for each"),
        (lambda out: out.image("a", 0.0, None), r"Give \(H, W, 3\)"),
        (lambda out: out.image("a", 0.0, PIXELS, quality=0), "Give 1 to 100"),
        (lambda out: out.write("/a/labels", 0, {"peers": [{"u_px": None}]}), "u_px has no value"),
    ],
)
def test_invalid_values_are_reported_on_writing(
    tmp_path: Path, write: Callable[[Any], None], error: str
) -> None:
    with dmrl.writer(tmp_path / "own.mcap") as out, pytest.raises(DmrlError, match=error):
        write(out)


def test_lists_of_different_lengths_and_named_cameras_are_written(tmp_path: Path) -> None:
    with dmrl.writer(tmp_path / "own.mcap") as out:
        out.write_columns("/a/labels", [0.0, 0.1], {"sources": [["truth"], ["truth", "hand"]]})
        out.camera("a", "aideck")
    rec = out.open()
    assert rec["/a/labels"].to_arrow()["sources"].to_pylist() == [["truth"], ["truth", "hand"]]
    assert rec["/a/camera/calibration"].to_arrow()["width"].to_pylist() == [320]


def test_texts_and_bytes_of_columns_keep_trailing_zeros(tmp_path: Path) -> None:
    data = [b"a\0\0", b"\0\0\0\0"]
    with dmrl.writer(tmp_path / "own.mcap") as out:
        for channels in ([["x"], ["y\0"]], [["x"], ["y", "z\0"]]):
            out.write_columns(GRID, [0.0, 0.1], {"data": data, "channels": channels})
        out.write_columns("/a/peer/b/position", [0, 1], {"frame_id": ["a\0", "b"]})
        statuses = {"status": ["OK", "UNCONVERGED"], "x": [1, 2]}
        out.write_columns("/a/peer/b/position", [2, 3], statuses)
    rec = out.open()
    table = rec[GRID].to_arrow().to_pydict()
    assert table["data"] == [data[0], data[0], data[1], data[1]]
    assert table["channels"] == [["x"], ["x"], ["y\0"], ["y", "z\0"]]
    position = rec["/a/peer/b/position"].to_arrow().to_pydict()
    assert position["frame_id"][:2] == ["a\0", "b"]
    assert position["status"][2:] == [0, 1]


def test_nanoseconds_are_written_exactly(tmp_path: Path) -> None:
    ns = 1_764_493_834_123_456_789
    with dmrl.writer(tmp_path / "own.mcap") as out:
        out.write("/a/height", time_ns=ns, fields={"height_m": 1.0})
        out.write_columns("/a/range/b", time_ns=[ns, ns + 1], fields={"range_m": [1.0, 2.0]})
        out.image("a", rgb=PIXELS, time_ns=ns + 3)
        out.camera("a", "aideck", time_ns=ns + 5)
    rec = out.open()
    times = {name: rec[name].to_numpy()["log_time"].tolist() for name in rec}
    assert times == {
        "/a/height": [ns],
        "/a/range/b": [ns, ns + 1],
        "/a/camera/image": [ns + 3],
        "/a/camera/calibration": [ns + 5],
    }


def test_columns_with_one_wrong_row_write_nothing(tmp_path: Path) -> None:
    with dmrl.writer(tmp_path / "own.mcap") as out:
        with pytest.raises(RecordingError, match="height_m has no value"):
            out.write_columns("/a/height", [0.0, 0.1], {"height_m": [1.0, None]})
        out.write("/a/height", 0.2, {"height_m": 2.0})
    assert len(out.open()["/a/height"]) == 1


def test_a_writer_takes_a_provenance_or_settings(tmp_path: Path) -> None:
    made = build_provenance("smooth", {"window": 2})
    with dmrl.writer(tmp_path / "own.mcap", made) as out:
        out.write("/a/height", 0.0, {"height_m": 1.0})
    assert out.open().provenance == made
    with pytest.raises(SettingError, match="give settings to build_provenance"):
        dmrl.writer(tmp_path / "b.mcap", made, sensor="tags")
