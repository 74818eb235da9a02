"""Logged data of the layout ``compare``: two models in the same images."""

from collections.abc import Callable
from pathlib import Path

import pytest

from dmrl.colours import RGB, SECOND_DETECTION_RGB
from dmrl.errors import RecordingError
from dmrl.viewer import Settings, save

from .rrd import count_rows, read_column, read_panel_names

pytestmark = pytest.mark.heavy

Make = Callable[..., Path]
COMPARE = Settings(layout="compare")


@pytest.fixture
def rrd(tmp_path: Path) -> Path:
    """Return the path of an .rrd file to be written."""
    return tmp_path / "both.rrd"


def test_two_models_stand_below_each_other_in_their_colours(
    make_recording: Make, rrd: Path
) -> None:
    assert save([make_recording("old.mcap"), make_recording("new.mcap")], rrd, COMPARE) == 10
    maps = {"image", "confidence", "depth, m"}
    errors = {"pixel error against truth, px", "depth error against truth, m", "both models"}
    assert (
        read_panel_names(rrd) == {f"{m} {name}" for m in ("old", "new") for name in maps} | errors
    )
    colours = {
        model: read_column(rrd, f"/{model}/cf1/detections", "Points2D:colors")[0][0] >> 8
        for model in ("old", "new")
    }
    assert colours == {
        "old": int.from_bytes(bytes(RGB["detection"])),
        "new": int.from_bytes(bytes(SECOND_DETECTION_RGB)),
    }
    assert count_rows(rrd)["/new/cf1/detections/grid/confidence", "DepthImage"] == 10
    legend = read_column(rrd, "/cf1/legend/sources", "LineStrips2D:labels")
    assert legend == [["truth", "published", "old", "new"]]


def test_errors_are_label_minus_detection(make_recording: Make, rrd: Path) -> None:
    save([make_recording("old.mcap"), make_recording("new.mcap")], rrd, COMPARE)
    # The label is at (20, 12), 1.25 m; the most confident detection at (21, 13), 1.2 m.
    errors_px = read_column(rrd, "/models/old/error_px", "Scalars:scalars")
    assert errors_px == [[pytest.approx(2**0.5)]] * 9
    assert read_column(rrd, "/models/new/error_m", "Scalars:scalars")[0] == [pytest.approx(0.05)]
    ((table,),) = read_column(rrd, "/models/table", "TextDocument:text")
    assert "| median error, px | 1.41 | 1.41 |" in table
    assert "| labels | 9 | 9 |" in table


def test_models_are_compared_without_labels_too(
    make_recording: Make, rrd: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recordings = [make_recording(name, without=("labels",)) for name in ("old.mcap", "new.mcap")]
    save(recordings, rrd, COMPARE)
    assert "no errors of old: " in capsys.readouterr().err
    assert "both models" not in read_panel_names(rrd)


@pytest.mark.parametrize("names", [("old.mcap",), ("old.mcap", "new.mcap", "newest.mcap")])
def test_compare_needs_exactly_two_models(
    make_recording: Make, rrd: Path, names: tuple[str, ...]
) -> None:
    with pytest.raises(RecordingError, match=r"compare takes two. Try: dmrl predict"):
        save([make_recording(name) for name in names], rrd, COMPARE)
    assert list(rrd.parent.glob("*.rrd*")) == []
