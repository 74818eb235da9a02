"""`dmrl evaluate` for estimated positions."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import OutputError, RecordingError, SettingError
from dmrl.evaluation import positions
from dmrl.evaluation.pipeline_summary import StepOutcome, print_report
from dmrl.messages import STATUS_OK, STATUS_UNCONVERGED, message_class
from dmrl.recording import Provenance, RecordingWriter
from dmrl.stages.evaluate import Settings, command, run

Make = Callable[..., Path]


def make_position(x: float, y: float, std_m: float = 0.1, status: int = STATUS_OK) -> object:
    """Return a PeerPosition in metres with a diagonal covariance."""
    covariance = (np.eye(3) * std_m**2).ravel().tolist()
    return message_class("PeerPosition")(x=x, y=y, covariance=covariance, status=status)


@pytest.fixture
def labelled_flight(tmp_path: Path) -> Path:
    """Return positions of two robots over 40 s.

    Those of cf1 have an error of 0.1 m in x and are unconverged for 10 s. Those of cf2 are exact
    but without covariance.
    """
    path = tmp_path / "labelled.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(800):
            at = k * 50_000_000
            for robot, peer in (("cf1", "cf2"), ("cf2", "cf1")):
                truth = make_position(1.0 + 0.001 * k, 0.5, 0.0)
                sink.write(at, f"/{robot}/peer/{peer}/truth", truth)
            late = at + 25_000_000  # between two true positions
            status = STATUS_UNCONVERGED if k < 200 else STATUS_OK
            here = make_position(1.1 + 0.001 * (k + 0.5), 0.5, status=status)
            sink.write(late, "/cf1/peer/cf2/position", here)
            unknown = message_class("PeerPosition")(x=1.0 + 0.001 * k, y=0.5)
            sink.write(at, "/cf2/peer/cf1/position", unknown)
    return path


@pytest.mark.heavy
def test_positions_are_judged_pair_by_pair(labelled_flight: Path) -> None:
    one, other = positions.judge(labelled_flight)
    assert (one.name, other.name) == ("cf1 sees cf2", "cf2 sees cf1")
    assert one.judged.error_m == pytest.approx(np.tile([0.1, 0.0], (799, 1)))
    assert one.without_truth == 1  # after the last truth
    assert other.judged.error_m == pytest.approx(np.zeros((800, 2)))
    assert np.isnan(other.judged.covariance).all()
    made = run([labelled_flight], None, Settings())
    assert isinstance(made, dict)
    first, second = made["pairs"]
    assert first["rmse_m"] == pytest.approx(0.1)
    assert first["nees"] == pytest.approx(1.0)
    assert first["kept"] == pytest.approx(599 / 799)
    assert (first["precision"], first["wrong_basin"]) == (1.0, 0.0)
    assert (second["rmse_m"], second["nees"]) == (pytest.approx(0.0), None)
    assert made["overall"]["samples"] == 1599


@pytest.mark.heavy
def test_figures_and_plots_are_written(labelled_flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "judged"
    made = run([labelled_flight], out, Settings(settle_s=5.0))
    assert json.loads((out / "positions.json").read_text()) == made
    names = {path.name for path in out.iterdir()}
    assert {"position-error-cf1-cf2.png", "position-error-cf2-cf1.svg"} <= names
    with pytest.raises(OutputError):
        run([labelled_flight], out, Settings())


@pytest.mark.heavy
def test_the_table_has_a_row_per_pair_and_one_for_all(
    labelled_flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command([labelled_flight])
    text = capsys.readouterr().out
    explained = ("covered:", "95 %:", "wrong:", "NEES:", "in 95 %:", "kept:", "good:", "From 20 s")
    assert all(word in text for word in explained)
    assert [row in text for row in ("cf1 sees cf2", "cf2 sees cf1", "all")] == [True] * 3
    command([labelled_flight], as_json=True)
    assert json.loads(capsys.readouterr().out)["settle_s"] == 20.0


def test_coverage_counts_missing_estimates(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "picked.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(400):
            sink.write(k * 10**8, "/cf1/peer/cf2/truth", make_position(1.0, 0.0, 0.0))
            if k < 100:  # a quarter of the flight
                sink.write(k * 10**8, "/cf1/peer/cf2/position", make_position(1.0, 0.0))
    made = run([path], None, Settings())
    assert isinstance(made, dict)
    assert made["overall"]["covered"] == made["pairs"][0]["covered"] == pytest.approx(0.25)
    assert made["overall"]["kept"] == 1.0
    command([path])
    assert "covered" in capsys.readouterr().out


def test_a_short_flight_settles_in_its_first_half(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "short.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(121):
            sink.write(k * 10**8, "/cf1/peer/cf2/truth", make_position(1.0, 0.0, 0.0))
            error = 0.5 if k < 60 else 0.1
            sink.write(k * 10**8, "/cf1/peer/cf2/position", make_position(1.0 + error, 0.0))
    made = run([path], None, Settings())
    assert isinstance(made, dict)
    assert made["settle_s"] == 6.0
    assert made["overall"]["rmse_m"] == pytest.approx(0.1)
    assert capsys.readouterr().err == ""
    made = run([path], None, Settings(settle_s=20.0))
    assert isinstance(made, dict)
    assert made["overall"]["rmse_m"] is None
    assert "ends, after 12.0 s: give a smaller --settle-s" in capsys.readouterr().err


def test_truth_is_not_interpolated_over_gaps(tmp_path: Path) -> None:
    path = tmp_path / "gap.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        for at_s in (0.0, 0.2, 5.0):
            sink.write(round(at_s * 1e9), "/cf1/peer/cf2/truth", make_position(at_s, 0.0, 0.0))
        for at_s in (0.1, 0.2, 3.0, 5.0):
            sink.write(round(at_s * 1e9), "/cf1/peer/cf2/position", make_position(at_s, 0.0))
    (pair,) = positions.judge(path)
    assert pair.judged.error_m == pytest.approx(np.zeros((3, 2)))
    assert pair.without_truth == 1


def test_recordings_with_nothing_to_judge_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "truth.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.write(0, "/cf1/peer/cf2/truth", make_position(1, 0, 0.0))
    with pytest.raises(RecordingError, match=r"has no positions\. Try: dmrl label"):
        run([path], None, Settings(what="positions"))
    with pytest.raises(SettingError, match="positions are judged one recording at a time"):
        run([path, path], None, Settings(what="positions"))
    other = tmp_path / "estimate.mcap"
    with RecordingWriter(other, Provenance("test")) as sink:
        sink.write(0, "/cf1/peer/cf2/position", make_position(1, 0))
    with pytest.raises(RecordingError, match="no true position for any"):
        run([other], None, Settings())


@pytest.mark.heavy
def test_a_pipeline_shows_judged_positions(
    labelled_flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run([labelled_flight], tmp_path / "positions", Settings())
    done = [StepOutcome("evaluate", tmp_path / "positions", 1.0, skipped=False)]
    print_report(done)
    assert "cf1 sees cf2" in capsys.readouterr().out
    print_report(done, as_json=True)
    shown = json.loads(capsys.readouterr().out)
    assert shown["positions"]["positions"]["overall"]["samples"] == 1599
