"""`dmrl convert`: outputs, settings and errors."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cyclopts import UnusedCliTokensError

from dmrl.cli import format_usage_error
from dmrl.errors import DmrlError, OutputError, SettingError, SourceError, UnsafeName
from dmrl.geometry.frames import AIDECK
from dmrl.images.codec import decode, encode_png
from dmrl.ingest.foreign_source import find_sources
from dmrl.recording import SPLIT_METADATA, RecordingWriter, check, read, read_summary, read_table
from dmrl.stages import fly, label, merge
from dmrl.stages.convert import Settings, run

from ..formats import plain_usd


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """Return a folder of two images; the first has a labelled peer, the second none."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    for k in range(2):
        rgb = np.full((48, 64, 3), 40 * k, np.uint8)
        (folder / f"{k}.png").write_bytes(encode_png(rgb))
    rows = ["file,peer,u_px,v_px,depth_m,split", "0.png,cf2,10,20,0.5,train", "1.png,,,,,test"]
    (folder / "labels.csv").write_text("\n".join(rows) + "\n")
    return folder


@pytest.mark.heavy
def test_pictures_become_a_recording(pictures: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    counts = run(pictures, out, Settings())
    assert counts == {"/cf1/camera/image": 2, "/cf1/labels": 2}
    images = list(read(out, "/cf1/camera/image"))
    assert [i.time_ns for i in images] == [0, 100_000_000]
    assert images[1].message.data == (pictures / "1.png").read_bytes()
    assert images[1].message.timestamp.nanos == 100_000_000
    first, second = (s.message.peers for s in read(out, "/cf1/labels"))
    assert (first[0].peer, first[0].source, len(second)) == ("cf2", "hand", 0)
    (split,) = read_summary(out).metadata[SPLIT_METADATA]
    assert {k: json.loads(v) for k, v in split.items()} == {
        "train": [[0, 0]],
        "test": [[100_000_000, 100_000_000]],
    }


def test_same_source_same_bytes(pictures: Path, tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        run(pictures, tmp_path / name, Settings())
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_size_and_camera_follow_the_settings(pictures: Path, tmp_path: Path) -> None:
    camera = tmp_path / "mine.toml"
    camera.write_text(
        "width_px = 64\nheight_px = 48\nfx_px = 50\nfy_px = 50\ncx_px = 32\ncy_px = 24\n"
    )
    out = tmp_path / "out.mcap"
    run(pictures, out, Settings(camera=camera, width_px=320, height_px=224, robot="a-2"))
    (calibration,) = read(out, "/a-2/camera/calibration")
    assert calibration.message.K[0] == pytest.approx(250)
    assert (calibration.message.K[2], calibration.message.K[5]) == pytest.approx((160, 112))
    assert decode(next(read(out, "/a-2/camera/image")).message.data).shape == (224, 320, 3)
    made = read_summary(out).provenance
    assert made is not None
    assert [i.name for i in made.inputs] == ["pictures", "mine.toml"]


@pytest.mark.heavy
def test_the_published_set_becomes_a_recording(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "multi.mcap"
    counts = run(data / "locanet-multi", out, Settings())
    assert counts["/cf1/camera/image"] == counts["/cf1/labels"] == counts["/cf1/attitude"] == 50
    assert [counts[f"/cf1/peer/cf{k}/truth"] for k in (2, 3, 4, 5)] == [50, 34, 20, 10]
    image = next(read(out, "/cf1/camera/image")).message
    jpeg = data / "locanet-multi" / "synImgsMulti" / "0000.jpg"
    assert (image.format, image.data) == ("jpeg", jpeg.read_bytes())
    (calibration,) = read(out, "/cf1/camera/calibration")
    assert list(calibration.message.K) == [120, 0, 160, 0, 120, 112, 0, 0, 1]
    labels = next(read(out, "/cf1/labels")).message
    assert [(p.peer, p.source) for p in labels.peers] == [(f"cf{k}", "truth") for k in (2, 3, 4, 5)]
    assert labels.peers[0].u_px == pytest.approx(160 + 120 * 0.33636 / 0.45940, abs=0.01)
    assert list(labels.peers[0].box_px) == [217, 0, 286, 31]
    truth = next(read(out, "/cf1/peer/cf2/truth")).message
    assert truth.frame_id == "cf1/horizontal"
    assert list(truth.covariance) == [0.0] * 9
    assert SPLIT_METADATA not in read_summary(out).metadata


def test_real_frames_take_the_camera_by_name(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "frames.mcap"
    counts = run(data / "aideck-frames", out, Settings(camera=Path("aideck")))
    # Two of the four images have maps of the chip.
    assert counts == {
        "/cf1/camera/calibration": 1,
        "/cf1/camera/image": 4,
        "/cf1/detections/grid": 2,
    }
    (calibration,) = read(out, "/cf1/camera/calibration")
    assert list(calibration.message.D) == list(AIDECK.distortion)
    assert calibration.message.distortion_model == "plumb_bob"


def test_findings_are_reported_after_conversion(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "logs").mkdir()
    events = {1: ("state", [("stateEstimate.z", "f")])}
    for robot, boot_s in (("cf1", 10), ("cf2", 60)):
        rows = [(1, (boot_s + k) * 1_000_000, (1.0,)) for k in range(5)]
        (tmp_path / "logs" / robot).write_bytes(plain_usd.encode(events, rows))
    run(tmp_path / "logs", tmp_path / "out.mcap", Settings())
    err = capsys.readouterr().err
    assert "warning: /cf1: shares no time with /cf2: 46 s between" in err
    for robot in ("cf1", "cf2"):
        run(tmp_path / "logs" / robot, tmp_path / f"{robot}.mcap", Settings(robot=robot))
    capsys.readouterr()
    merge.run([tmp_path / "cf1.mcap", tmp_path / "cf2.mcap"], tmp_path / "merged.mcap")
    assert "shares no time with /cf2: 46 s" in capsys.readouterr().err


def test_a_folder_of_pictures_is_not_a_source_each(pictures: Path) -> None:
    with pytest.raises(SettingError, match=r"pictures is a folder of pictures.*OUT\.mcap"):
        find_sources(pictures, None)


def test_several_sources_are_a_usage_error() -> None:
    error = UnusedCliTokensError(unused_tokens=["b.jpg", "out.mcap"], command_chain=("convert",))
    words = "dmrl: b.jpg is one argument too many. Try: dmrl convert --help"
    assert str(format_usage_error(error)) == words


def test_an_empty_folder_is_called_empty(tmp_path: Path) -> None:
    (tmp_path / "new").mkdir()
    with pytest.raises(SourceError, match=r"new is an empty folder\. Pass one with files"):
        run(tmp_path / "new", tmp_path / "out.mcap", Settings())


@pytest.mark.parametrize(
    ("settings", "kind", "message"),
    [
        (
            Settings(source_kind="image"),
            SourceError,
            "Did you mean images.* Formats: locanet, csv, .*, images",
        ),
        (
            Settings(source_kind="floppy"),
            SourceError,
            "no such format. Formats: locanet, csv, .*, images",
        ),
        (Settings(source_kind="locanet"), SourceError, r"no posLabel\.txt"),
        (Settings(width_px=320), SettingError, "--width-px and --height-px go together"),
        (Settings(width_px=0, height_px=5), SettingError, "must be over 0"),
        (Settings(rate_hz=0.0), SettingError, "must be over 0"),
        (Settings(rate_hz=float("inf")), SettingError, "must be over 0, from 1e-6 to 1e6"),
        (Settings(width_px=100_000, height_px=100_000), SettingError, "8192 at most"),
        (Settings(source_kind="rosbag2"), SourceError, "cannot be read as a ROS bag"),
        (Settings(robot="a/b"), SettingError, "'a/b' cannot stand in a topic"),
        (Settings(camera=Path("aidek")), SourceError, "no calibration aidek. Use a TOML file"),
        (Settings(camera=Path("aideck")), SettingError, "is 64x48 px, its camera 320x224"),
        (Settings(names="cf2"), SettingError, "--names 'cf2' is not OLD=NEW. Try: 0=cf2,1=cf3"),
        (Settings(names="0=a/b"), SettingError, "is not OLD=NEW"),
        (Settings(labels=Path("no.csv")), SourceError, "no label file no.csv"),
    ],
)
def test_invalid_settings_give_one_line_error_and_no_output(
    pictures: Path, tmp_path: Path, settings: Settings, kind: type[DmrlError], message: str
) -> None:
    with pytest.raises(kind, match=message) as e:
        run(pictures, tmp_path / "out.mcap", settings)
    assert "\n" not in str(e.value)
    assert list(tmp_path.glob("out*")) == []


def test_pictures_that_all_break_half_way_leave_nothing(pictures: Path, tmp_path: Path) -> None:
    for path in pictures.glob("*.png"):
        path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(SourceError, match=r"pictures: nothing in it can be used"):
        run(pictures, tmp_path / "out.mcap", Settings())
    assert list(tmp_path.glob("out*")) == []


def test_unknown_source_error_lists_formats(tmp_path: Path) -> None:
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("hello")
    with pytest.raises(
        SourceError, match=r"matches no known format.* Pass --from: locanet, csv, .*, images"
    ):
        run(tmp_path / "notes", tmp_path / "out.mcap", Settings())
    with pytest.raises(SourceError, match="no file or folder"):
        run(tmp_path / "none", tmp_path / "out.mcap", Settings())
    with pytest.raises(UnsafeName, match="is a pipe or a device, not a file"):
        run(Path("/dev/null"), tmp_path / "out.mcap", Settings())


def test_recordings_are_never_overwritten(pictures: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    out.write_text("mine")
    with pytest.raises(OutputError, match="never overwritten"):
        run(pictures, out, Settings())
    assert out.read_text() == "mine"


@pytest.mark.heavy
def test_the_command_prints_counts_and_exits_by_kind_of_error(
    pictures: Path, tmp_path: Path
) -> None:
    def run_dmrl(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "dmrl.cli", "convert", *words], capture_output=True, text=True
        )

    out = tmp_path / "out.mcap"
    done = run_dmrl(str(pictures), str(out), "--from", "images", "--json")
    assert done.returncode == 0
    assert json.loads(done.stdout)["messages"]["/cf1/camera/image"] == 2
    again = run_dmrl(str(pictures), str(out))
    assert (again.returncode, again.stdout) == (1, "")
    assert again.stderr.startswith("dmrl: ") and again.stderr.count("\n") == 1
    assert run_dmrl(str(pictures), str(out), "--rate-hz", "0").returncode == 2


def test_empty_file_gives_one_line_error(tmp_path: Path) -> None:
    (tmp_path / "log00").write_bytes(b"")
    with pytest.raises(SourceError, match=r"log00 is empty, 0 bytes\. Pass another file"):
        run(tmp_path / "log00", tmp_path / "out.mcap", Settings())
    assert list(tmp_path.glob("out*")) == []


@pytest.mark.heavy
def test_flights_logged_on_micro_sd_can_be_labelled(tmp_path: Path) -> None:
    """The firmware logs in the take-off frame and in degrees."""
    flight = tmp_path / "flight.mcap"
    fly.run(flight, fly.Settings(duration_s=30.0, noise="calibrated"))
    logs = tmp_path / "logs"
    logs.mkdir()
    for robot, number in (("cf1", 2), ("cf2", 1)):
        (logs / robot).write_bytes(_pack_firmware_log(flight, robot, number))
    made, labelled = tmp_path / "made.mcap", tmp_path / "labelled.mcap"
    run(logs, made, Settings())
    # The conversion restores units and frames of the simulated flight.
    for topic, fields in (
        ("/cf1/attitude", ("roll_rad", "pitch_rad")),
        ("/cf2/velocity", ("vx_mps", "vy_mps")),
    ):
        told, known = read_table(made, topic), read_table(flight, topic)
        for field in fields:
            np.testing.assert_allclose(told[field], known[field], atol=2e-6)
    result = label.run(made, labelled, label.Settings())
    assert {(pair.robot, pair.peer) for pair in result.pairs} == {("cf1", "cf2"), ("cf2", "cf1")}
    assert all(pair.positions > 500 for pair in result.pairs)
    assert result.warnings == []
    assert check(made) == []


def _pack_firmware_log(flight: Path, robot: str, peer: int) -> bytes:
    """Return the micro-SD log that the firmware would write during a simulated flight."""
    attitude, velocity = (read_table(flight, f"/{robot}/{t}") for t in ("attitude", "velocity"))
    height = read_table(flight, f"/{robot}/height")
    ranges = read_table(flight, f"/{robot}/range/cf{peer}")
    yaw = attitude["yaw_rad"].to_numpy()
    vx, vy = velocity["vx_mps"].to_numpy(), velocity["vy_mps"].to_numpy()
    names = ("roll", "pitch", "yaw", "vx", "vy", "z")
    events = {
        1: ("fixedFrequency", [*((f"stateEstimate.{n}", "f") for n in names), ("gyro.z", "f")]),
        2: ("estDistance", [("id", "B"), ("distance", "f")]),
    }
    columns = (
        np.degrees(attitude["roll_rad"]),
        -np.degrees(attitude["pitch_rad"]),
        np.degrees(yaw),
        np.cos(yaw) * vx - np.sin(yaw) * vy,
        np.sin(yaw) * vx + np.cos(yaw) * vy,
        height["height_m"],
        np.degrees(attitude["yaw_rate_radps"]),
    )
    rows = zip(*(np.asarray(column).tolist() for column in columns), strict=True)
    records = [
        (1, time // 1000, row)
        for time, row in zip(attitude["log_time"].to_pylist(), rows, strict=True)
    ]
    records += [
        (2, time // 1000, (peer, value))
        for time, value in zip(
            ranges["log_time"].to_pylist(), ranges["range_m"].to_pylist(), strict=True
        )
    ]
    return plain_usd.encode(events, sorted(records, key=lambda r: r[1]))


def test_a_recording_is_not_a_source(pictures: Path, tmp_path: Path) -> None:
    run(pictures, tmp_path / "a.mcap", Settings())
    with pytest.raises(
        SourceError, match=r"is a recording already\. Pass --to: csv, parquet, ros2"
    ):
        run(tmp_path / "a.mcap", tmp_path / "b.mcap", Settings())


def test_logs_are_written_as_columns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Writing a single message costs about 20 us. Only the transforms, 20 a second, are written so.
    variables = [(f"stateEstimate.{name}", "f") for name in ("x", "y", "z", "roll", "pitch", "yaw")]
    rows = [(1, 2000 * k, (0.1, 0.2, 1.0, 1.0, 2.0, 0.1 * k)) for k in range(500)]
    log = tmp_path / "log00"
    log.write_bytes(plain_usd.encode({1: ("state", variables)}, rows))
    singly: list[str] = []
    write = RecordingWriter.write

    def write_counted(
        sink: RecordingWriter, time_ns: int, topic: str, made: object, **rest: int
    ) -> None:
        singly.append(topic)
        write(sink, time_ns, topic, made, **rest)

    monkeypatch.setattr(RecordingWriter, "write", write_counted)
    counts = run(log, tmp_path / "out.mcap", Settings())
    assert set(singly) == {"/tf"}
    assert counts["/cf1/log/state"] == counts["/cf1/attitude"] == counts["/cf1/pose"] == 500
    assert read_summary(tmp_path / "out.mcap").topics["/cf1/attitude"].count == 500
    found = read_table(tmp_path / "out.mcap", "/cf1/attitude")
    assert found["pitch_rad"].to_numpy() == pytest.approx(-np.radians(2.0))
