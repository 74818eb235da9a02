"""Headers of text tables, as in well-known sets of flights."""

from pathlib import Path

import pytest

from dmrl.formats.files.text_table import read_table

TUM = "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n1.5 1 2 3 0 0 0 1\n"
EUROC = "#timestamp, p_RS_R_x [m], q_RS_w [], v_RS_R_x [m s^-1]\n1,0.1,1,0.5\n"


@pytest.mark.parametrize(
    ("text", "wanted", "row"),
    [
        (TUM, ("timestamp", "tx", "qw"), [1.5, 1.0, 1.0]),
        (TUM.replace("# timestamp", "#timestamp"), ("timestamp", "tz"), [1.5, 3.0]),
        (EUROC, ("timestamp", "p_RS_R_x", "q_RS_w", "v_RS_R_x"), [1.0, 0.1, 1.0, 0.5]),
        (EUROC, ("#timestamp", "q_RS_w []"), [1.0, 1.0]),
    ],
)
def test_a_comment_may_be_the_header(
    text: str, wanted: tuple[str, ...], row: list[float], tmp_path: Path
) -> None:
    (path := tmp_path / "a.txt").write_text(text)
    table = read_table(path, wanted)
    assert [float(table.columns[name][0]) for name in wanted] == row
