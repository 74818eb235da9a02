"""MCAP files of other programs, of which dmrl cannot decode every topic."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.writer import Writer

from dmrl import boundary
from dmrl.cli import app
from dmrl.errors import RecordingError
from dmrl.exchange.csv_parquet import write_tables
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, merge, read_summary, read_table, trim
from dmrl.stages import check, info
from dmrl.terminal.left_out import count_left_out
from dmrl.terminal.tables import format_size

SITE = {"name": "lab", "floor": "3", "camera": "fx = 1\nfy = 2\n"}


Run = Callable[..., tuple[int, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Return a function that runs a command and returns exit status and standard output."""

    def command(*words: object) -> tuple[int, str]:
        status = boundary.run_to_status(lambda: app([str(word) for word in words]))
        return status, capsys.readouterr().out

    return command


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    """Return a file with ROS 2 messages on dmrl's topics, JSON, attachments and metadata."""
    path = tmp_path / "ros2.mcap"
    with path.open("wb") as stream:
        sink = Writer(stream)
        sink.start(profile="ros2", library="robot 1.0")
        for topic, kind in {
            "/cf1/pose": "geometry_msgs/msg/PoseStamped",
            "/cf1/camera/calibration": "sensor_msgs/msg/CameraInfo",
        }.items():
            schema = sink.register_schema(kind, "ros2msg", b"float64 x")
            channel = sink.register_channel(topic, "cdr", schema)
            for k in range(5):
                sink.add_message(channel, 10 + k, bytes(12), 10 + k)
        sink.add_message(sink.register_channel("/state", "json", 0), 12, b"{}", 12)
        for text in (b"hello", b"again"):
            sink.add_attachment(0, 0, "notes.txt", "text/plain", text)
        sink.add_metadata("site", SITE)
        sink.finish()
    return path


def test_info_shows_topics_that_dmrl_cannot_read_and_how_to_convert_them(
    foreign: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    info.run(foreign).print()
    out = capsys.readouterr().out
    lines = [" ".join(line.split()) for line in out.splitlines()]
    size = foreign.stat().st_size
    assert lines[0] == f"{foreign}: {size / 1000:.1f} kB, 11 messages over 0.000 s"
    assert lines[1] == "chunks: zstd; profile ros2; written by robot 1.0"
    assert any(line.startswith("/cf1/pose geometry_msgs/msg/PoseStamped cdr 5") for line in lines)
    assert "/state no schema json 1" in lines
    assert lines.count("attachment: notes.txt, text/plain, 5 bytes") == 2
    assert "metadata: site: name=lab, floor=3, camera (2 lines)" in lines
    warnings = [line for line in lines if line.startswith("warning")]
    assert [line.split()[1] for line in warnings] == ["/cf1/camera/calibration", "/cf1/pose"]
    assert all(line.endswith(f"dmrl convert {foreign} OUT.mcap") for line in warnings)


def test_info_as_json_names_encodings_and_the_container(foreign: Path) -> None:
    shown = json.loads(json.dumps(info.run(foreign).to_document()))
    assert shown["topics"]["/state"] == {"message": "", "encoding": "json", "count": 1}
    assert shown["compression"] == ["zstd"]
    assert (shown["profile"], shown["library"]) == ("ros2", "robot 1.0")
    assert shown["metadata"] == {"site": [SITE]}
    assert len(shown["warnings"]) == 2


def test_trim_and_merge_copy_topics_of_other_types(foreign: Path, tmp_path: Path) -> None:
    part = tmp_path / "part.mcap"
    assert trim(foreign, part, topics=["/cf1/pose", "/cf1/camera/*"], start_ns=12) == 6
    assert info.run(part).to_document()["profile"] == "ros2"
    assert merge([foreign, part], tmp_path / "both.mcap") == 17
    assert read_summary(tmp_path / "both.mcap").topics["/cf1/pose"].count == 8


def test_tables_leave_out_topics_of_another_type(foreign: Path, tmp_path: Path) -> None:
    with_height = tmp_path / "height.mcap"
    with RecordingWriter(with_height, Provenance("test")) as sink:
        sink.write(0, "/cf1/height", message_class("Height")())
    both = tmp_path / "both.mcap"
    merge([foreign, with_height], both)
    with count_left_out() as left_out:
        assert write_tables(both, tmp_path / "tables", "parquet") == {"/cf1/height": 1}
    assert left_out.counts.total() == 11
    assert any("/cf1/pose, which carries geometry_msgs" in reason for reason in left_out.counts)
    with pytest.raises(RecordingError, match="no topic that can be read"):
        write_tables(foreign, tmp_path / "none", "parquet")


def test_check_counts_topics_that_it_did_not_decode(
    foreign: Path, tmp_path: Path, run: Run
) -> None:
    rc, told = run("check", foreign)
    size = "11 messages on 3 topics (3 topics not decoded: cdr, json)"
    assert (rc, told.splitlines()[-1]) == (1, f"{foreign}: {size}, 2 errors, 0 warnings")
    trim(foreign, tmp_path / "state.mcap", topics=["/state"])
    _, told = run("check", tmp_path / "state.mcap")
    assert "1 message on 1 topic (1 topic not decoded: json), 0 errors" in told
    assert set(check.run(tmp_path / "state.mcap").undecoded) == {"/state"}


def test_merge_and_trim_print_json(foreign: Path, tmp_path: Path, run: Run) -> None:
    part, both = tmp_path / "part.mcap", tmp_path / "both.mcap"
    _, told = run("trim", foreign, part, "--json")
    assert json.loads(told) == {"recording": str(part), "messages": 11}
    _, told = run("merge", foreign, part, both, "--json")
    assert json.loads(told) == {"recording": str(both), "messages": 22, "recordings": 2}


def test_the_refusal_of_a_type_names_the_command_that_converts_it(foreign: Path) -> None:
    with pytest.raises(RecordingError, match=rf"dmrl convert {foreign} OUT\.mcap"):
        read_table(foreign, "/cf1/pose")


@pytest.mark.parametrize(
    ("size", "text"), [(1, "1 byte"), (7_000, "7.0 kB"), (99_949, "99.9 kB"), (100_000, "0.1 MB")]
)
def test_small_sizes_are_not_rounded_to_zero(size: int, text: str) -> None:
    assert format_size(size) == text
