"""Catalogues: their rows, updates after changes, and queries."""

import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from dmrl import boundary, topics
from dmrl.catalogue import FILE_NAME, open_catalogue
from dmrl.catalogue.query import find_rows
from dmrl.catalogue.table import COLUMNS, Catalogue, to_table
from dmrl.cli import app
from dmrl.errors import RecordingError, SettingError
from dmrl.guards import limits
from dmrl.html_report import build_report, collect_outputs
from dmrl.images.codec import encode_png
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter
from dmrl.recording.provenance import Input
from dmrl.stages import index

pytestmark = pytest.mark.heavy

STEP_NS = 100_000_000


def write_flight(path: Path, camera: str, images: int, statuses: tuple[int, ...]) -> Path:
    """Write a flight with a true label per image, and estimated labels of these statuses."""
    path.parent.mkdir(parents=True, exist_ok=True)
    made = Provenance("label", {"k": 1}, inputs=(Input("raw.mcap", "0" * 64),))
    with RecordingWriter(path, made) as sink:
        matrix = [90, 0, 32, 0, 90, 24, 0, 0, 1]
        calibration = message_class("CameraCalibration")(width=64, height=48, K=matrix)
        sink.write(0, topics.CALIBRATION(camera), calibration)
        for k in range(images):
            data = encode_png(np.full((48, 64, 3), 10 * k, np.uint8))
            sink.write(
                k * STEP_NS,
                topics.CAMERA_IMAGE(camera),
                message_class("CompressedImage")(data=data),
            )
            truth = {"peer": "cf9", "u_px": 20, "v_px": 20, "depth_m": 1.0, "source": "truth"}
            peers = [truth, *({**truth, "source": "estimate", "status": s} for s in statuses)]
            sink.write(k * STEP_NS, topics.LABELS(camera), message_class("PeerLabels")(peers=peers))
    return path


@pytest.fixture
def flights(tmp_path: Path) -> Path:
    """Return a folder with three flights and a truncated one."""
    folder = tmp_path / "flights"
    write_flight(folder / "a.mcap", "cf1", 4, (0, 1))
    write_flight(folder / "monday" / "a.mcap", "cf2", 6, (0,))
    write_flight(folder / "monday" / "b.mcap", "cf1", 2, ())
    (folder / "torn.mcap").write_bytes((folder / "a.mcap").read_bytes()[:300])
    return folder


def find_names(folder: Path, query: str) -> list[str]:
    """Return the names of the recordings that match a query."""
    found = find_rows(open_catalogue(folder), query)["recording"].to_pylist()
    return [str(name) for name in found]


def test_catalogue_row_describes_its_recording(flights: Path) -> None:
    made = index.update(flights, workers=1)
    assert made == index.Result(recordings=4, looked_at=4, known=0, gone=0, unread=1)
    table = pq.read_table(flights / FILE_NAME)
    rows = {row["recording"]: row for row in table.to_pylist()}
    assert list(rows) == ["a.mcap", "monday/a.mcap", "monday/b.mcap", "torn.mcap"]
    row = rows["a.mcap"]
    assert row["robots"] == ["cf1"] and row["messages"] == 9 and row["duration_s"] == 0.3
    assert row["bytes"] == (flights / "a.mcap").stat().st_size and len(row["sha256"]) == 64
    camera = {"camera": "cf1", "images": 4, "width_px": 64, "height_px": 48, "focal_px": 90.0}
    assert row["cameras"] == [camera]
    counts = {(one["source"], one["status"]): one["count"] for one in row["labels"]}
    assert counts == {("estimate", "OK"): 4, ("estimate", "UNCONVERGED"): 4, ("truth", "OK"): 4}
    assert row["stage"] == "label" and row["inputs"] == [{"name": "raw.mcap", "sha256": "0" * 64}]
    assert row["errors"] == 0 and row["warnings"] == len(row["findings"])
    assert "cut short" in rows["torn.mcap"]["error"] and rows["torn.mcap"]["messages"] is None


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="threads are not listed")
def test_a_catalogue_is_read_without_a_thread_that_could_outlive_python(flights: Path) -> None:
    index.update(flights)
    code = (
        "import os, sys, pathlib, pyarrow.parquet\n"
        "from dmrl.catalogue import open_catalogue\n"
        "count = lambda: len(os.listdir('/proc/self/task'))\n"
        "before = count(); open_catalogue(pathlib.Path(sys.argv[1])); print(count() - before)"
    )
    done = subprocess.run([sys.executable, "-c", code, flights], capture_output=True, check=True)
    assert done.stdout == b"0\n"


def test_queries_filter_by_recording_camera_and_labels(flights: Path) -> None:
    index.update(flights, workers=1)
    assert find_names(flights, 'camera = "cf1" and ok_labels > 3') == ["a.mcap"]
    assert find_names(flights, "camera = 'cf1' and images < 4") == ["monday/b.mcap"]
    assert find_names(flights, "source = 'estimate' and ok_labels = labels") == ["monday/a.mcap"]
    assert find_names(flights, "error is not null") == ["torn.mcap"]
    assert find_names(flights, "list_contains(topics, '/cf2/labels')") == ["monday/a.mcap"]
    assert find_names(flights, "\"recording\" like 'monday/%'") == [
        "monday/a.mcap",
        "monday/b.mcap",
    ]
    assert find_names(flights, "false") == []


HOSTILE_QUERIES = [
    "colour = 1",
    "messages >",
    "1); select 2 --",
    "recording in (select * from read_text('/etc/passwd'))",
    "recording in (select recording from table)",
    "recording in (select recording from held)",
    "recording in (select * from 'FOLDER/a.csv')",
    "(select count(*) from read_csv('FOLDER/a.csv')) > 0",
    "(select count(*) from glob('FOLDER/*')) > 0",
    "(select count(*) from sqlite_scan('FOLDER/a.db', 't')) > 0",
    "(select count(*) from duckdb_secrets()) > 0",
    "getenv('HOME') = ''",
    "true; COPY (select 1) TO 'FOLDER/b.csv'",
    "true; ATTACH 'FOLDER/b.db'",
    "true; INSTALL httpfs; LOAD httpfs",
    "true; SET enable_external_access = true",
    "true; drop table held",
    "true union all select '../../a'",
    "true limit 0",
    "not " * 20_000 + "true",
    "'",
    "/*",
    "",
]


@pytest.mark.parametrize(
    "query",
    [
        *HOSTILE_QUERIES[:3],
        *(pytest.param(q, marks=pytest.mark.heavy) for q in HOSTILE_QUERIES[3:]),
    ],
)
def test_invalid_query_gives_one_line_error_and_reads_no_other_file(
    query: str, tmp_path: Path
) -> None:
    (tmp_path / "a.csv").write_text("a\nprecious\n")
    with pytest.raises(SettingError, match="Columns: recording, bytes") as caught:
        find_rows(Catalogue(tmp_path, to_table([])), query.replace("FOLDER", str(tmp_path)))
    assert "\n" not in str(caught.value) and "precious" not in str(caught.value)
    assert "install" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


def test_misspelt_column_error_suggests_the_nearest_name(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"no column image\. Did you mean images\? Columns:"):
        find_rows(Catalogue(tmp_path, to_table([])), "image > 3")


def test_only_changed_recordings_are_indexed_again(flights: Path) -> None:
    index.update(flights, workers=1)
    before = (flights / FILE_NAME).stat().st_mtime_ns
    (flights / "torn.mcap").unlink()
    index.update(flights, workers=1)
    assert index.update(flights, workers=1) == index.Result(3, 0, 3, 0, 0)
    unchanged = (flights / FILE_NAME).stat().st_mtime_ns
    index.update(flights, workers=1)
    assert (flights / FILE_NAME).stat().st_mtime_ns == unchanged > before
    (flights / "a.mcap").unlink()
    write_flight(flights / "a.mcap", "cf7", 3, ())
    (flights / "monday" / "b.mcap").rename(flights / "monday" / "c.mcap")
    assert index.update(flights, workers=1) == index.Result(3, 2, 1, 1, 0)
    assert find_names(flights, "camera = 'cf7'") == ["a.mcap"]


def test_interrupted_index_keeps_finished_rows(
    flights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = index.iter_results

    def iter_two_rows(*given: object) -> object:
        for k, one in enumerate(real(*given)):  # type: ignore[arg-type]
            if k == 2:
                raise KeyboardInterrupt
            yield one

    monkeypatch.setattr(index, "iter_results", iter_two_rows)
    with pytest.raises(KeyboardInterrupt):
        index.update(flights, workers=1)
    monkeypatch.undo()
    again = index.update(flights, workers=1)
    assert (again.looked_at, again.known) == (3, 1)  # one of the two cannot be read


def test_non_utf_8_name_is_refused_before_indexing(
    flights: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    odd = flights / os.fsdecode(b"\xff.mcap")
    try:
        odd.write_bytes(b"")
    except (OSError, UnicodeError):
        return  # macOS refuses such names
    monkeypatch.setattr(index, "iter_results", None)
    assert boundary.run_to_status(lambda: app(["index", str(flights)])) == 1
    assert "Rename the file" in capsys.readouterr().err


def test_file_that_is_no_catalogue_is_not_overwritten(flights: Path) -> None:
    with pytest.raises(RecordingError, match=r"has no catalogue\. Make it: dmrl index"):
        open_catalogue(flights)
    (flights / FILE_NAME).write_text("my notes")
    with pytest.raises(RecordingError, match="is damaged"):
        index.update(flights, workers=1)
    pq.write_table(pq.read_table(index_flights(flights)).select(["recording"]), flights / FILE_NAME)
    with pytest.raises(RecordingError, match="is not a catalogue"):
        index.update(flights, workers=1)


def index_flights(flights: Path) -> Path:
    """Index the flights again and return the catalogue."""
    (flights / FILE_NAME).unlink()
    index.update(flights, workers=1)
    return flights / FILE_NAME


def test_the_commands_print_tables_paths_and_json(
    flights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def run_and_read(*words: str) -> str:
        assert boundary.run_to_status(lambda: app([*words], result_action="return_value")) == 0
        return capsys.readouterr().out

    assert "4 recordings; 4 looked at, 0 known" in run_and_read(
        "index", str(flights), "--workers", "1"
    )
    assert json.loads(run_and_read("index", str(flights), "--json"))["known"] == 3
    assert "estimate 4 of 8, truth 4 of 4" in run_and_read("find", "camera = 'cf1'", str(flights))
    paths = run_and_read("find", "camera = 'cf1'", str(flights), "--paths").splitlines()
    assert paths == [str(flights / "a.mcap"), str(flights / "monday" / "b.mcap")]
    found = json.loads(run_and_read("find", "error is not null", str(flights), "--json"))
    assert [one["recording"] for one in found["recordings"]] == ["torn.mcap"]


def test_dataset_is_made_of_query_results(
    flights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    index.update(flights, workers=1)
    out = tmp_path / "set"

    def make_dataset(query: str) -> int:
        words = ["dataset", str(flights), str(out), "--from-index", query, "--workers", "1"]
        return boundary.run_to_status(lambda: app(words, result_action="return_value"))

    assert make_dataset("camera = 'cf9'") == 1
    assert "is true of no recording" in capsys.readouterr().err
    os.utime(flights / "a.mcap")
    assert make_dataset("camera = 'cf1'") == 1
    assert "has changed since it was indexed. Run: dmrl index" in capsys.readouterr().err
    assert not out.exists()
    index.update(flights, workers=1)
    assert make_dataset("camera = 'cf1' and source = 'truth'") == 0
    made = json.loads((out / "provenance.json").read_text())
    assert [one["name"] for one in made["inputs"]] == ["a.mcap", "b.mcap"]


def test_report_shows_the_catalogue_without_opening_every_recording(
    flights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    index.update(flights, workers=1)
    shown = build_report(collect_outputs(flights))
    assert "<h2>Catalogue</h2>" in shown and "4 recordings, 0.0 h" in shown
    assert "estimate" in shown and "cut short" in shown and "<h2>Recordings</h2>" in shown
    module = import_module("dmrl.html_report.collect")
    monkeypatch.setattr(module, "MAX_OPENED_RECORDINGS", 3)
    monkeypatch.setattr(module, "read_summary", None)
    assert "<h2>Recordings</h2>" not in build_report(collect_outputs(flights))


def edit_first_row(folder: Path, **values: Any) -> None:
    """Put values into the first row, as another program could."""
    rows = pq.read_table(folder / FILE_NAME).to_pylist()
    rows[0].update(values)
    pq.write_table(pa.Table.from_pylist(rows, schema=COLUMNS), folder / FILE_NAME)


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({"recording": "../../etc/passwd"}, "leads out of the folder"),
        ({"recording": "/etc/passwd"}, "leads out of the folder"),
        ({"recording": ""}, "leads out of the folder"),
        ({"recording": None}, "recording lacks values"),
        ({"bytes": None}, "bytes lacks values"),
        ({"cameras": [None]}, "cameras lacks values"),
        ({"cameras": [{}]}, "cameras lacks values"),
        ({"labels": [{"source": "truth"}]}, "labels lacks values"),
        ({"duration_s": float("nan")}, "duration_s is no number"),
        ({"cameras": [{"camera": "x", "images": 1, "focal_px": float("inf")}]}, "focal_px"),
    ],
)
def test_invalid_catalogue_gives_one_line_error(
    tmp_path: Path, values: dict[str, Any], complaint: str
) -> None:
    table = to_table([{"recording": "a.mcap", "bytes": 1, "stamp": "1 2 3"}])
    Catalogue(tmp_path, table).save()
    assert open_catalogue(tmp_path).table.num_rows == 1
    edit_first_row(tmp_path, **values)
    with pytest.raises(RecordingError, match=complaint):
        open_catalogue(tmp_path)


def test_a_query_takes_no_disk_and_little_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By default, DuckDB would write temporary files to the working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(limits, "MEMORY_BYTES", 20_000_000)
    many = "(select count(distinct range) from range(5_000_000)) > 1"
    with pytest.raises(SettingError, match=r"Out of Memory|needs more than 20 MB"):
        find_rows(Catalogue(tmp_path, to_table([])), many)
    assert list(tmp_path.iterdir()) == []


def test_nan_focal_length_is_stored_as_null(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", Provenance("test")) as sink:
        said = message_class("CameraCalibration")(width=64, height=48, K=[float("nan")] * 9)
        sink.write(0, topics.CALIBRATION("cf1"), said)
        picture = encode_png(np.zeros((48, 64, 3), np.uint8))
        sink.write(0, topics.CAMERA_IMAGE("cf1"), message_class("CompressedImage")(data=picture))
    index.update(tmp_path, 1)
    (row,) = open_catalogue(tmp_path).table.to_pylist()
    assert row["cameras"][0]["images"] == 1
    assert row["cameras"][0]["focal_px"] is None
