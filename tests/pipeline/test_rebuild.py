"""Rebuilding a recording from its provenance."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from dmrl.errors import DmrlError, RecordingError
from dmrl.pipeline.rebuild import rebuild
from dmrl.recording import read_summary
from dmrl.stages import fly, predict, run, trim

from ..faults.inputs import Inputs
from ..recording.test_budgets import write_chunks


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    return Inputs(tmp_path_factory.mktemp("inputs"))


def trim_recording(source: Path, out: Path, end_s: float) -> Path:
    """Trim a recording to its first seconds."""
    trim.run(source, out, trim.Settings(to_s=end_s))
    return out


@pytest.mark.heavy
def test_a_recording_is_made_again_with_the_inputs_that_are_absent(
    inputs: Inputs, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    long = trim_recording(inputs.dots, tmp_path / "long.mcap", 0.9)
    short = trim_recording(long, tmp_path / "short.mcap", 0.5)
    long.unlink()
    with pytest.raises(DmrlError, match="no stage 'test'"):  # the stage of dots.mcap
        rebuild(short, tmp_path / "never.mcap")
    run.command(str(short), out=tmp_path / "new.mcap", data=inputs.dots.parent, as_json=True)
    assert json.loads(capsys.readouterr().out) == {"same": True, "differences": []}
    assert (tmp_path / "new.mcap").read_bytes() == short.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["new.mcap", "short.mcap"]


def test_differences_of_a_rebuilt_recording_are_printed(
    inputs: Inputs,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    short = trim_recording(inputs.dots, tmp_path / "short.mcap", 0.5)
    summary = read_summary(short)
    assert summary.provenance is not None
    settings = {**summary.provenance.settings, "to_s": 0.3}
    other = replace(summary.provenance, settings=settings, dmrl_version="0.0.1")
    monkeypatch.setattr(
        "dmrl.pipeline.rebuild.read_summary",
        lambda path: replace(summary, provenance=other) if path == short else read_summary(path),
    )
    run.command(str(short), out=tmp_path / "new.mcap", data=inputs.dots.parent)
    output = capsys.readouterr().out
    assert "came out otherwise" in output and "0.0.1" in output and "differs from" in output


def test_recording_without_provenance_is_refused(tmp_path: Path) -> None:
    write_chunks(tmp_path / "a.mcap")
    with pytest.raises(RecordingError, match="has no provenance"):
        rebuild(tmp_path / "a.mcap", tmp_path / "b.mcap")


@pytest.mark.heavy
def test_a_simulated_flight_and_its_detections_are_made_again(tmp_path: Path) -> None:
    """The settings alone determine the flight, and the network is found by its name."""
    settings = fly.Settings(duration_s=2.0, camera=True, camera_renderer="sketch", seed=5)
    fly.run(tmp_path / "flight.mcap", settings)
    predict.run(
        Path("dmrl-nano"),
        tmp_path / "flight.mcap",
        tmp_path / "found.mcap",
        predict.Settings(backend="integer", most=1),
    )
    (tmp_path / "flight.mcap").unlink()
    assert rebuild(tmp_path / "found.mcap", tmp_path / "new.mcap") == []
