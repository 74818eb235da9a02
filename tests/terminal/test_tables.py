"""Tables, notes and JSON documents on standard output."""

import json
from pathlib import Path

import pytest

from dmrl.terminal.tables import print_json, print_note, print_table


def test_a_table_holds_every_cell_unwrapped(capsys: pytest.CaptureFixture[str]) -> None:
    name = "a" * 90 + "[red]b"
    print_table("Figures", ("file", "error, px"), [(name, 1.23456), ("c", None)])
    lines = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == "Figures"
    assert any(name in line and line.endswith("1.235") for line in lines)
    assert any(line.strip() == "c" for line in lines)


def test_rows_must_fit_the_columns() -> None:
    with pytest.raises(ValueError, match="a row of 1 cells in a table of 2 columns"):
        print_table("", ("a", "b"), [(1,)])


def test_json_is_one_document(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({"b": 1.5, "a": [None, Path("x.mcap")]})
    assert json.loads(capsys.readouterr().out) == {"b": 1.5, "a": [None, "x.mcap"]}
    with pytest.raises(ValueError, match="JSON"):
        print_json(float("nan"))


def test_a_note_breaks_between_its_definitions(capsys: pytest.CaptureFixture[str]) -> None:
    parts = [f"word {k}: {'x' * 30}" for k in range(6)]
    print_note("; ".join(parts))
    lines = capsys.readouterr().out.splitlines()
    assert "; ".join(lines) == "; ".join(parts)
    assert len(lines) == 3 and max(map(len, lines)) <= 100
