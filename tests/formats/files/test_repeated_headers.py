"""Repeated headers in a text table, as written by a logger that restarts."""

from pathlib import Path

import pytest

from dmrl.errors import SourceError
from dmrl.formats.files.text_table import read_table
from dmrl.terminal.left_out import count_left_out


def read_column(path: Path, text: str, name: str) -> list[str]:
    """Write a text to a file; return the cells of a column."""
    path.write_text(text)
    return read_table(path).columns[name]


def test_a_header_in_another_order_is_followed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.csv"
    text = "t,roll,pitch\n1,10,20\nt,pitch,roll\n2,21,11\nt,roll,pitch\n3,12,22\n"
    assert read_column(path, text, "roll") == ["10", "11", "12"]
    assert read_column(path, text, "pitch") == ["20", "21", "22"]
    assert f"{path}:3: a header with the columns in another order" in capsys.readouterr().err


def test_a_header_of_other_columns_is_refused(tmp_path: Path) -> None:
    text = "t,roll,pitch\n1,10,20\nt,roll,yaw\n2,11,31\n"
    with pytest.raises(SourceError, match=r"a\.csv:3: a header of other columns\. Split the file"):
        read_column(tmp_path / "a.csv", text, "roll")


def test_text_rows_are_not_taken_for_headers(tmp_path: Path) -> None:
    text = "t,robot,mode\n1,cf1,up\n-,robot,mode\n2,cf1,down\n"
    assert read_column(tmp_path / "a.csv", text, "mode") == ["up", "mode", "down"]


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        ("2.3\n", 12),  # the newline shows that the number is complete
        ("2.300", 12),  # as many decimals as in the rows above
        ("2.3", 11),
        ("2", 11),
        ("", 12),
    ],
)
def test_a_number_that_was_cut_off_at_the_end_is_left_out(
    text: str, kept: int, tmp_path: Path
) -> None:
    rows = [f"{k},{k / 8:.3f}" for k in range(11)]
    (path := tmp_path / "a.csv").write_text("\n".join(["t,x", *rows, f"11,{text}"]))
    with count_left_out() as left:
        assert len(read_table(path).columns["x"]) == kept
    assert sum(left.counts.values()) == 12 - kept
