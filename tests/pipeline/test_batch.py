"""Commands on folders of recordings: equal output with any number of processes, and failures."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import DmrlError, RecordingError
from dmrl.images.codec import encode_png
from dmrl.messages import message_class
from dmrl.pipeline import process_pool
from dmrl.pipeline.batch import find_recordings, is_collection, run_over_folder
from dmrl.recording import Provenance, RecordingWriter, read_summary
from dmrl.stages import check, convert, trim
from dmrl.topics import ATTITUDE

from .test_pipeline import list_children

pytestmark = pytest.mark.heavy

KEPT = trim.Settings(to_s=1.5)


def write_recording(path: Path, messages: int = 20, roll_rad: float = 0.0) -> Path:
    """Write attitudes at 10 Hz, the k-th with a roll of ``roll_rad`` + k."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(messages):
            one = message_class("Attitude")(roll_rad=roll_rad + k)
            sink.write(1_000_000_000 + k * 100_000_000, ATTITUDE("cf1"), one)
    return path


@pytest.fixture
def flights(tmp_path: Path) -> Path:
    """Return a folder with four recordings, two of equal names in different folders."""
    folder = tmp_path / "flights"
    for k, name in enumerate(("a", "b", "monday/a", "monday/c")):
        write_recording(folder / f"{name}.mcap", roll_rad=k)
    (folder / "notes.txt").write_text("windy")
    (folder / ".hidden").mkdir()
    write_recording(folder / ".hidden" / "d.mcap")
    return folder


def read_files(folder: Path) -> dict[str, bytes]:
    """Return the bytes of every file below a folder, by relative path."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def trim_folder(source: Path, out: Path, workers: int = 2, how: trim.Settings = KEPT) -> None:
    """Trim every recording of a folder."""
    run_over_folder("trim", source, out, how, workers=workers)


def test_recordings_in_subfolders_are_found_but_not_other_or_hidden_files(flights: Path) -> None:
    names = ["a.mcap", "b.mcap", "monday/a.mcap", "monday/c.mcap"]
    assert [str(name) for name in find_recordings(flights)] == names
    assert [str(name) for name in find_recordings(flights / "*" / "*.mcap")] == names[2:]
    assert [str(name) for name in find_recordings(flights / "mon*")] == names[2:]
    assert list(find_recordings(flights / "a.mcap").values()) == [flights / "a.mcap"]
    outs = flights / "outs"
    write_recording(outs / "a.mcap")
    assert [str(name) for name in find_recordings(flights, but=outs)] == names


def test_special_characters_in_file_names_are_no_glob_pattern(tmp_path: Path) -> None:
    assert not is_collection(write_recording(tmp_path / "a[1].mcap"))
    assert is_collection(tmp_path / "b[1].mcap")


def test_batch_outputs_are_independent_of_worker_count(flights: Path, tmp_path: Path) -> None:
    trim_folder(flights, tmp_path / "one", workers=1)
    trim_folder(flights, tmp_path / "two", workers=2)
    made = read_files(tmp_path / "one")
    assert list(made) == ["a.mcap", "b.mcap", "monday/a.mcap", "monday/c.mcap"]
    assert made == read_files(tmp_path / "two")
    trim.run(flights / "monday" / "a.mcap", tmp_path / "alone.mcap", KEPT)
    assert (tmp_path / "alone.mcap").read_bytes() == made["monday/a.mcap"]


def test_failing_recording_does_not_stop_the_batch_and_is_reported(
    flights: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (flights / "aa.mcap").write_bytes((flights / "a.mcap").read_bytes()[:200])
    with pytest.raises(DmrlError, match=r"1 of 5 recordings failed"):
        trim_folder(flights, tmp_path / "out")
    assert len(read_files(tmp_path / "out")) == 4
    output = capfd.readouterr()
    assert [line for line in output.err.splitlines() if line.startswith("failed: ")] == [
        line for line in output.err.splitlines() if "aa.mcap" in line
    ]


def test_worker_process_is_reused_after_a_recording_fails(
    flights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = []
    start = process_pool.WorkerProcess.__init__
    monkeypatch.setattr(
        process_pool.WorkerProcess,
        "__init__",
        lambda self, *rest: (started.append(1), start(self, *rest))[1],
    )
    for name in ("b", "x", "y", "z"):
        (flights / f"{name}.mcap").write_bytes(b"no recording")
    with pytest.raises(DmrlError, match="4 of 7 recordings failed"):
        trim_folder(flights, tmp_path / "out", workers=1)
    assert len(started) == 1
    assert len(list((tmp_path / "out").rglob("*.mcap"))) == 3


def test_up_to_date_outputs_are_kept(
    flights: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    trim_folder(flights, out)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.mcap")}
    (out / "b.mcap").unlink()
    trim_folder(flights, out)
    output = capfd.readouterr().out.splitlines()
    assert [line.split()[1:3] for line in output if "/b.mcap" in line][-1] == ["made", "15"]
    assert sum("was there" in line for line in output) == 3
    after = {path: path.stat().st_mtime_ns for path in out.rglob("*.mcap")}
    assert {path: after[path] for path in before if path.name != "b.mcap"} == {
        path: when for path, when in before.items() if path.name != "b.mcap"
    }


@pytest.mark.parametrize("wrong", ["settings", "input", "torn"])
def test_existing_output_with_other_inputs_is_refused(
    wrong: str, flights: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    trim_folder(flights, out)
    how = trim.Settings(to_s=1.0) if wrong == "settings" else KEPT
    if wrong == "input":
        (flights / "a.mcap").unlink()
        write_recording(flights / "a.mcap", roll_rad=9.0)
    if wrong == "torn":
        (out / "a.mcap").write_bytes((out / "a.mcap").read_bytes()[:-30])
    before = read_files(out)
    with pytest.raises(DmrlError, match=f"{4 if wrong == 'settings' else 1} of 4"):
        trim_folder(flights, out, how=how)
    assert read_files(out) == before
    assert str(out / "a.mcap") in capfd.readouterr().err


def test_an_empty_folder_and_the_folder_itself_are_refused(flights: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match=r"no recording \(.mcap\) in"):
        trim_folder(tmp_path / "empty", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(DmrlError, match="is the folder that is read"):
        trim_folder(flights, flights)
    with pytest.raises(DmrlError, match="is a file"):
        trim_folder(flights, flights / "a.mcap")


def test_check_of_a_folder_is_a_line_each_and_one_for_all(
    flights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert check.command(flights) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sorted(line.split(":")[0] for line in lines[:-1]) == [
        str(flights / name) for name in ("a.mcap", "b.mcap", "monday/a.mcap", "monday/c.mcap")
    ]
    assert lines[-1].startswith("4 recordings: 4 without errors; 0 errors, ")


def test_check_of_a_folder_with_an_invalid_recording_fails_in_json_and_status(
    flights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (flights / "b.mcap").write_bytes(b"no recording")
    with pytest.raises(DmrlError, match="1 of 4 recordings failed"):
        check.command(flights, as_json=True, workers=2)
    told = json.loads(capsys.readouterr().out)
    assert told["sound"] == 3
    assert [("error" in one, one.get("messages")) for one in told["recordings"]] == [
        *((True, None), (False, 20), (False, 20), (False, 20))
    ]


def test_each_source_in_a_folder_becomes_a_recording_of_its_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("one", "two"):
        (tmp_path / "sources" / name).mkdir(parents=True)
        png = encode_png(np.zeros((16, 16, 3), np.uint8))
        (tmp_path / "sources" / name / "0.png").write_bytes(png)
    (tmp_path / "sources" / "README").write_text("not a source")
    convert.command(tmp_path / "sources", tmp_path / "out", workers=2)
    made = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in made] == ["one.mcap", "two.mcap"]
    assert all(read_summary(path).count == 1 for path in made)
    assert "README" in capsys.readouterr().err


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks at processes")
def test_ctrl_c_ends_the_workers_and_leaves_nothing_half_written(tmp_path: Path) -> None:
    png = encode_png(np.zeros((224, 320, 3), np.uint8))
    for name in ("one", "two", "three"):
        folder = tmp_path / "sources" / name
        folder.mkdir(parents=True)
        (folder / "0.png").write_bytes(png)
        for k in range(1, 6000):
            os.link(folder / "0.png", folder / f"{k}.png")
    words = ["-m", "dmrl.cli", "convert", "sources", "out", "--workers", "2"]
    running = subprocess.Popen(
        [sys.executable, *words], cwd=tmp_path, stderr=subprocess.PIPE, text=True
    )
    while len(list((tmp_path / "out").glob("*.partial"))) < 2:
        assert running.poll() is None
        time.sleep(0.01)
    workers = list_children(running.pid)
    assert len(workers) == 2
    running.send_signal(signal.SIGINT)
    _, output = running.communicate()
    assert running.returncode == 130
    assert "Traceback" not in output and "stopped" in output
    assert not [path for path in (tmp_path / "out").iterdir() if path.suffix == ".partial"]
    assert not any(Path(f"/proc/{number}").exists() for number in workers)
