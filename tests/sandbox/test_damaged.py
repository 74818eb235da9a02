"""Damaged inputs give a one-line error from every command, and no partial output."""

import os
from typing import Any

import pytest

from dmrl import boundary
from dmrl.cli import COMMANDS, app

from .box import Box, run_command, write_junk_messages

pytestmark = pytest.mark.heavy


# doctor reads no input; index writes into the folder and lists unreadable files as rows.
@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in ("doctor", "index")])
def test_every_command_takes_damaged_inputs_as_errors(
    name: str, box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    deep = {
        "deep.json": "[" * 50_000,
        "deep.toml": f"kind = {'[' * 50_000}",
        "text.mcap": "not a recording",
        "table.toml": 'kind = "pipeline"\n[[step]]\nstage = "fly"\nout = "x"\nsettings = 3\n',
    }
    for file, text in deep.items():
        (box.root / "in" / file).write_text(text)
    pattern = {
        "run": ("run", "IN", "--out", "OUT"),
        "score": ("score", "OUT", "--detected", "IN"),
        "render": ("render", "IN", "OUT"),
        "fly": ("fly", "IN", "OUT"),
        "sketch": ("sketch", "IN", "--images", "1"),
        "demo": ("demo", "--out", "IN"),
        "convert": ("convert", "IN", "OUT", "--from", "images", "--camera", "IN"),
        "calibrate": ("calibrate", "IN", "OUT.toml"),
        "record": ("record", "OUT.mcap", "--robot", "../../x=udp://127.0.0.1:1"),
        "fake-drone": ("fake-drone", "--flight", "IN", "--uri", "udp://127.0.0.1:0x"),
        "train": ("train", "IN", "OUT"),
        "predict": ("predict", "IN", "IN", "OUT.mcap"),
        "quantize": ("quantize", "IN", "IN", "OUT"),
        "view": ("view", "IN", "--save", "OUT.rrd"),
        "report": ("report", "IN", "OUT.html"),
        "evaluate": ("evaluate", "IN"),
        "info": ("info", "IN"),
        "check": ("check", "IN"),
        "card": ("card", "IN"),
        "find": ("find", "true", "IN"),
        "verify": ("verify", "IN"),
    }.get(name, (name, "IN", "OUT.mcap"))
    for file in [*deep, "."]:
        given = str(box.root / "in" / file)
        words = [w.replace("IN", given).replace("OUT", str(box.out / "x")) for w in pattern]
        assert run_command(box, capsys, *words) == 1
    assert list(box.out.iterdir()) == []


@pytest.mark.usefixtures("empty_figures")
@pytest.mark.parametrize(
    ("junk", "calibration"),
    [
        ("camera/image", {}),
        ("labels", {}),
        ("attitude", {}),
        ("detections", {}),
        ("camera/calibration", {}),
        ("", {"K": [1.0, 2.0]}),
        ("", {"K": [float("nan")] * 9, "D": [float("inf")]}),
        ("", {"K": [0.0] * 9}),
    ],
)
def test_undecodable_messages_give_one_line_errors(
    junk: str, calibration: dict[str, Any], box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    bad, out = write_junk_messages(box.root / "in" / "bad.mcap", junk, calibration), box.out
    for words in (
        ("info", bad),
        ("check", bad),
        ("predict", "dmrl-nano", bad, out / "predicted.mcap"),
        ("track", bad, out / "track.mcap"),
        ("label", bad, out / "label.mcap"),
        ("align", bad, out / "align.mcap"),
        ("dataset", bad, out / "set"),
        ("convert", bad, out / "csv", "--to", "csv"),
        ("convert", bad, out / "ros", "--to", "ros2"),
        ("calibrate", bad, out / "camera.toml"),
        ("evaluate", bad),
        ("view", bad, "--save", out / "view.rrd"),
    ):
        run_command(box, capsys, *words)


@pytest.mark.usefixtures("empty_figures")
def test_input_changed_during_the_run_gives_one_line_error(
    box: Box, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_junk_messages(box.root / "in" / "flight.mcap", "", {})
    other = write_junk_messages(box.root / "temp" / "other.mcap", "labels", {})

    def replace_it(*_: object) -> None:
        other.replace(path)

    monkeypatch.setattr("dmrl.datasets.writing.splits.reject_duplicates", replace_it)
    assert boundary.run_to_status(lambda: app(["dataset", str(path), str(box.out / "set")])) == 1
    output = capsys.readouterr().err
    assert "flight.mcap was changed while it was read. Run it again" in output
    assert list(box.out.iterdir()) == []


def test_non_utf_8_name_gives_one_line_error(box: Box, capsys: pytest.CaptureFixture[str]) -> None:
    made = write_junk_messages(box.root / "in" / "a.mcap", "", {})
    flight = made.rename(made.with_name(os.fsdecode(b"\xff.mcap")))
    for words in (
        ("info", flight),
        ("check", flight),
        ("trim", flight, box.out / "trim.mcap"),
        ("merge", flight, box.out / "merge.mcap"),
        ("recover", flight, box.out / "recover.mcap"),
        ("label", flight, box.out / "label.mcap"),
        ("convert", flight, box.out / "csv", "--to", "csv"),
        ("convert", flight, box.out / "ros", "--to", "ros2"),
        ("evaluate", flight),
        ("view", flight, "--save", box.out / "view.rrd"),
        ("report", box.root / "in", box.out / "page.html"),
        ("dataset", flight, box.out / "set"),
    ):
        run_command(box, capsys, *words)


def test_pipe_in_place_of_a_file_gives_one_line_error(
    box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    """Opening a pipe would wait for a writer for ever."""
    pipe, folder = box.root / "in" / "x.mcap", box.root / "in"
    for name in ("x.mcap", "x.h5", "model.json", "x.csv", "x.png", "labels.csv"):
        os.mkfifo(folder / name)
    for words in (
        ("info", pipe),
        ("recover", pipe, box.out / "recovered.mcap"),
        ("convert", pipe, box.out / "x.mcap"),
        ("convert", folder, box.out / "x.mcap"),
        ("convert", folder / "x.csv", box.out / "x.mcap"),
        ("convert", folder, box.out / "x.mcap", "--from", "images"),
        ("convert", folder, box.out / "x.mcap", "--from", "csv"),
        ("convert", folder, box.out / "x.mcap", "--from", "cfclient"),
        ("predict", folder / "x.h5", pipe, box.out / "x.mcap"),
        ("predict", folder, pipe, box.out / "x.mcap"),
        ("train", folder, box.out / "run"),
        ("report", folder, box.out / "page.html"),
    ):
        assert run_command(box, capsys, *words) == 1
