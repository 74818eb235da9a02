"""Recordings that earlier versions wrote stay readable.

``tests/old_recordings/<commit>/`` holds what that commit wrote. ``flight.mcap`` of 33b3094 is a
simulated flight of 22 s (``dmrl fly``, seed 7, sensors thinned to 5 Hz, eight JPEG images) with
labels (``dmrl label``), detections (the true pixels) and tracks (``dmrl track``);
``renders.mcap`` is one image of ``dmrl render`` with the detections of dmrl-nano.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

import dmrl

FOLDER = Path(__file__).parent / "old_recordings" / "33b3094"
FLIGHT, RENDERS = FOLDER / "flight.mcap", FOLDER / "renders.mcap"
COUNTS = {
    "/cf1/attitude": 111,
    "/cf1/camera/image": 8,
    "/cf1/detections": 8,
    "/cf1/detections/grid": 1,
    "/cf1/labels": 8,
    "/cf1/peer/cf2/position": 441,
    "/cf1/range/cf2": 110,
    "/cf1/tracks": 8,
}


def run_dmrl(*words: object) -> str:
    """Run a command; return its standard output."""
    command = [sys.executable, "-m", "dmrl.cli", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_topics_open_with_their_messages() -> None:
    recording = dmrl.open(FLIGHT)
    assert {topic: len(recording[topic].to_arrow()) for topic in COUNTS} == COUNTS
    position = recording["/cf1/peer/cf2/position"].to_arrow()
    assert {"x", "y", "z", "covariance", "status"} <= set(position.column_names)


def test_the_provenance_names_every_stage_before() -> None:
    provenance = dmrl.open(FLIGHT).provenance
    assert provenance is not None
    stages = []
    while provenance.inputs:
        stages.append(provenance.stage)
        nested = [i.provenance for i in provenance.inputs if i.provenance is not None]
        if not nested:
            break
        provenance = nested[-1]
    assert stages[0] == "track"
    assert "label" in stages


@pytest.mark.heavy
@pytest.mark.parametrize("path", [FLIGHT, RENDERS], ids=lambda path: path.stem)
def test_old_recordings_can_be_listed_checked_and_viewed(path: Path, tmp_path: Path) -> None:
    assert json.loads(run_dmrl("info", path, "--json"))
    run_dmrl("check", path)
    run_dmrl("view", path, "--save", tmp_path / "view.rrd")
    assert (tmp_path / "view.rrd").stat().st_size > 10_000


@pytest.mark.heavy
def test_a_labelled_flight_is_labelled_again(tmp_path: Path) -> None:
    run_dmrl("label", FLIGHT, tmp_path / "again.mcap")
    again = dmrl.open(tmp_path / "again.mcap")
    assert len(again["/cf1/peer/cf2/position"].to_arrow()) > 400
    assert len(again["/cf1/labels"].to_arrow()) == COUNTS["/cf1/labels"]
