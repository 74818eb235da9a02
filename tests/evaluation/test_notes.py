"""The notes below the tables of ``dmrl evaluate`` explain their columns in words."""

import pytest

from dmrl.evaluation import flights, tracks
from dmrl.terminal.tables import print_note


def test_the_note_on_a_flight_explains_its_columns_and_names_no_fields(
    capsys: pytest.CaptureFixture[str],
) -> None:
    bands = [
        {"by": "distance_m", "from": 0.5, "recall": 0.25, "in_view": 8.0},
        {"by": "turn_radps", "from": 0.0, "recall": 1.0, "in_view": 3.0},
        {"by": "turn_radps", "from": 0.25, "recall": None, "in_view": 0.0},
    ]
    note = flights.note({"flights": [{"robot": "cf1", "peer": "cf2", "bands": bands}]})
    assert note.endswith(
        ".\ncf1, cf2: recall in view from 0.5 m: 25% of 8; from 0 rad/s: 100% of 3"
    )
    assert "_" not in note
    print_note(note)
    assert "\ncf1, cf2: recall in view from 0.5 m: 25% of 8;" in capsys.readouterr().out
    for _, words, _ in flights.COLUMNS:
        assert words.split(",")[0].split("/")[0].removeprefix("longest ") in note


def test_the_note_on_tracks_explains_their_columns() -> None:
    note = tracks.note({"settle_s": 7.0})
    for _, words, _ in tracks.COLUMNS:
        assert words in note or words in ("median, m", "RMSE, m", "of images, m", "false/min")
