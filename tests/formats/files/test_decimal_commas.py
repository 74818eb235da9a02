"""Commas in numbers of text tables: decimal marks, or separators of thousands."""

from pathlib import Path

import pytest

from dmrl.errors import SourceError
from dmrl.formats.files.text_table import Dialect, read_table


@pytest.mark.parametrize("cells", [("1,500", "2,250"), ("950", "-12,000"), ('"1,500"', '"7"')])
def test_commas_that_may_separate_thousands_are_refused(
    cells: tuple[str, str], tmp_path: Path
) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t;d\n" + "".join(f"{k};{cell}\n" for k, cell in enumerate(cells)))
    with pytest.raises(SourceError, match=r"a\.csv: .*,.00 may be .*\..00 or .*\[file\] decimal"):
        read_table(path, ("t", "d"))
    values = read_table(path, ("t", "d"), Dialect(decimal=",")).parse_numbers("d")
    assert values is not None and abs(values).min() < 13


@pytest.mark.parametrize(
    ("cells", "numbers"),
    [
        (("1,500", "0,750"), [1.5, 0.75]),
        (("1,500", "1,5"), [1.5, 1.5]),
        (("1,500", "1234,500"), [1.5, 1234.5]),
        (("-0,125", "-2,000"), [-0.125, -2.0]),
    ],
)
def test_one_unambiguous_number_decides_the_meaning_of_commas(
    cells: tuple[str, str], numbers: list[float], tmp_path: Path
) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t;d\n" + "".join(f"{k};{cell}\n" for k, cell in enumerate(cells)))
    values = read_table(path, ("t", "d")).parse_numbers("d")
    assert values is not None and values.tolist() == numbers


def test_unicode_minus_is_a_minus(tmp_path: Path) -> None:
    (path := tmp_path / "a.csv").write_text("t,x\n1,\u22122.5\n2,3\n", encoding="utf-8")
    found = read_table(path).parse_numbers("x")
    assert found is not None and found.tolist() == [-2.5, 3.0]
