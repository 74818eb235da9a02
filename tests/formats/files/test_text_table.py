"""Text tables as written by pandas, R, spreadsheets and loggers."""

import io
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.errors import SourceError
from dmrl.formats.base import Options
from dmrl.formats.files import mapped_csv
from dmrl.formats.files.text_cells import parse_time_ns
from dmrl.formats.files.text_table import Dialect, read_table
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import count_left_out

from ..reading import group_by_topic

WANTED = ("t", "roll", "pitch", "d2")
TIME_S = np.arange(200) / 50
VALUES = np.column_stack(
    [TIME_S, 0.1 * np.sin(TIME_S), 0.1 * np.cos(TIME_S), 2 + np.sin(TIME_S * 3)]
).round(6)


def to_text(separator: str = ",", decimal: str = ".", header: str = "", before: str = "") -> str:
    """Return the table as text."""
    rows = [separator.join(f"{x:.6f}".replace(".", decimal) for x in row) for row in VALUES]
    return before + "\n".join([header or separator.join(WANTED), *rows]) + "\n"


def to_text_by_pandas(**how: object) -> str:
    """Return the table as text written by pandas."""
    text = io.StringIO()
    pandas.DataFrame(VALUES, columns=list(WANTED)).to_csv(text, **how)
    return text.getvalue()


def append_note(text: str) -> str:
    """Append a quoted cell of two lines, with separators in it, to each row."""
    first, *rows = text.splitlines()
    return "\n".join([first + ",note", *(f'{row},"a, #b\n{k}"' for k, row in enumerate(rows))])


TEXTS: dict[str, Callable[[], str]] = {
    "plain": to_text,
    "semicolon": lambda: to_text(";"),
    "tab": lambda: to_text("\t"),
    "pipe": lambda: to_text("|"),
    "space": lambda: to_text(" "),
    "columns of spaces": lambda: to_text("   "),
    "decimal comma": lambda: to_text(";", ","),
    "decimal comma, tab": lambda: to_text("\t", ","),
    "comments above": lambda: to_text(before="# a log\n#of two, robots\n\n"),
    "comments of percent": lambda: to_text(before="% a log\n"),
    "comments of C": lambda: to_text(before="// a log\n"),
    "header is a comment": lambda: to_text(header="# t,roll,pitch,d2"),
    "header as rostopic's": lambda: to_text(header="%t,roll,pitch,d2"),
    "comments between": lambda: to_text().replace("\n1.0", "\n# a pause\n1.0"),
    "comments behind": lambda: to_text().replace("\n1.0", " # a pause\n1.0"),
    "title above": lambda: to_text(before="Flight of Monday\n\n"),
    "quoted header": lambda: to_text(header='"t","roll","pitch","d2"'),
    "spaces in header": lambda: to_text(header="t, roll ,  pitch, d2"),
    "units in header": lambda: to_text(header="t [s],roll [rad],pitch (rad),d2 / m"),
    "a line of units": lambda: to_text(header="t,roll,pitch,d2\ns,rad,rad,m"),
    "separator at the end": lambda: to_text().replace("\n", ",\n"),
    "separator at the end of rows": lambda: to_text().replace("\n", ",\n").replace(",\n", "\n", 1),
    "names of rows, as R": lambda: to_text_by_pandas(index_label=False),
    "index of pandas": to_text_by_pandas,
    "all quoted": lambda: to_text_by_pandas(index=False, quoting=1),
    "blank lines": lambda: to_text().replace("\n", "\n\n"),
    "lines of Windows": lambda: to_text().replace("\n", "\r\n"),
    "lines of old Macs": lambda: to_text().replace("\n", "\r"),
    "text of two lines": lambda: append_note(to_text()),
    "no end of line": lambda: to_text().rstrip("\n"),
}


@pytest.mark.parametrize("form", TEXTS)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_every_form_gives_the_same_rows(form: str, encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(TEXTS[form]().encode(encoding))
    with count_left_out() as left_out:
        table = read_table(path, WANTED)
        ordered, time_ns = table.order_by_time("t", 1e9)
        found = np.column_stack([table.parse_numbers(name) for name in WANTED])
    assert left_out.counts == {}
    np.testing.assert_array_equal(found, VALUES)
    assert time_ns.tolist() == np.rint(TIME_S * 1e9).astype(int).tolist()
    assert ordered is table


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (to_text(before="# Flug über\n").encode("latin-1"), "is not UTF-8; read as Latin-1"),
        (to_text().encode("utf-16-le"), ""),
        (to_text().encode("utf-32"), ""),
        (to_text(";", ",").encode(), "read with decimal commas"),
    ],
)
def test_guessed_dialect_is_reported_with_the_deciding_key(
    data: bytes, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.csv").write_bytes(data)
    found = read_table(tmp_path / "a.csv", WANTED).parse_numbers("d2")
    np.testing.assert_array_equal(found, VALUES[:, 3])
    err = capsys.readouterr().err
    assert said in err and bool(said) == ("[file]" in err)


def test_given_dialect_overrides_guessing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.csv").write_bytes(to_text(";", ",", before="! über\n").encode("cp1252"))
    dialect = Dialect(";", ",", "cp1252", "!")
    found = read_table(tmp_path / "a.csv", WANTED, dialect).parse_numbers("d2")
    np.testing.assert_array_equal(found, VALUES[:, 3])
    assert capsys.readouterr().err == ""
    with pytest.raises(SourceError, match=r"a\.csv cannot be read as text.*Save it as UTF-8"):
        read_table(tmp_path / "a.csv", WANTED, Dialect(encoding="none-such"))


@pytest.mark.parametrize("missing", ["", "NA", "n/a", "NaN", "nan", "null", "None", "-", "?", " "])
def test_missing_values_are_no_numbers_and_not_counted(missing: str, tmp_path: Path) -> None:
    lines = to_text().splitlines()
    for k in range(3, 200, 7):
        lines[k] = ",".join([*lines[k].split(",")[:3], missing])
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    with count_left_out() as left_out:
        found = read_table(tmp_path / "a.csv", WANTED).parse_numbers("d2")
    assert found is not None and np.flatnonzero(np.isnan(found)).tolist() == list(range(2, 199, 7))
    assert left_out.counts == {}


def test_unusable_cells_and_rows_are_counted_by_line(tmp_path: Path) -> None:
    lines = to_text(before="# a log\n").splitlines()
    lines[10] = "0.18,0.1"
    lines[12] = lines[12].rsplit(",", 1)[0] + ",1_0"  # Python accepts 1_0 as a number
    lines[14] = "1_0,0,0,2"
    (tmp_path / "a.csv").write_text("\n".join([*lines, lines[1], *lines[-1:]]) + "\n")
    with count_left_out() as left_out:
        table = read_table(tmp_path / "a.csv", WANTED)
        table.parse_numbers("d2")
        table.order_by_time("t", 1e9)
    assert dict(left_out.counts) == {
        "lines with fewer or more cells than the header": 1,
        "cells of 'd2' that are no number": 1,
        "rows without a time": 1,
    }
    assert list(left_out.first.values()) == [f"{tmp_path / 'a.csv'}:{n}" for n in (11, 13, 15)]


@pytest.mark.parametrize(
    ("cells", "times_s"),
    [
        (["2024-05-01T12:00:00Z", "2024-05-01T12:00:00.020Z"], (1714564800, 0.02)),
        (["2024-05-01 12:00:00.5", "2024-05-01 12:00:01"], (1714564800.5, 0.5)),
        (["2024-05-01T14:00:00,25+02:00", "2024-05-01T14:00:01+0200"], (1714564800.25, 0.75)),
        (["2024/05/01 12:00:00.123456789", "2024/05/01 12:00:01.123456789"], (1714564800, 1)),
        (["12:00:00.5", "12:00:01"], (43200.5, 0.5)),
        (["1714564800123456789e-9", "1714564801.123456789"], (1714564800, 1)),
    ],
)
def test_dates_are_parsed_as_times(
    cells: list[str], times_s: tuple[float, float], tmp_path: Path
) -> None:
    quoted = "\n".join(f'"{cell}",1' for cell in cells)
    (tmp_path / "a.csv").write_text(f"t,d2\n{quoted}\n")
    _, time_ns = read_table(tmp_path / "a.csv", ["t", "d2"]).order_by_time("t", 1e9)
    assert time_ns[0] * 1e-9 == pytest.approx(times_s[0], abs=0.2)
    assert (time_ns[1] - time_ns[0]) * 1e-9 == pytest.approx(times_s[1], abs=1e-9)


def test_binary_files_are_no_tables(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for k in range(50):
        (tmp_path / "a.csv").write_bytes(rng.bytes(int(rng.integers(0, 3000))))
        try:
            read_table(tmp_path / "a.csv", WANTED)
        except SourceError as e:
            assert "a.csv" in str(e) and "\n" not in str(e), k


TABLE = """
[time]
name = "t"
unit = "s"
[roll]
name = "roll"
unit = "rad"
[pitch]
name = "pitch"
unit = "rad"
[yaw_rate]
name = "r"
unit = "rad/s"
[range.cf2]
name = "d2"
unit = "m"
"""


def read_samples(folder: Path, **options: object) -> dict[str, list[Sample]]:
    """Return the samples of log.csv, read by map.toml, by topic."""
    given = Options(columns=folder / "map.toml", **options)  # type: ignore[arg-type]
    return group_by_topic(mapped_csv.load_content(folder / "log.csv", given).samples)


def test_unit_in_the_header_that_differs_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "map.toml").write_text(TABLE)
    (tmp_path / "log.csv").write_text("t [ms],roll (rad),pitch [°],r,d2\n1,0,0,0,2\n2,0,0,0,2.5\n")
    read_samples(tmp_path)
    err = capsys.readouterr().err
    assert "the header has t in ms, the table in s" in err
    assert "the header has pitch in deg, the table in rad" in err
    assert "roll" not in err


def test_two_flights_in_one_file_are_refused_with_the_line(tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text(TABLE)
    flight = [f"{0.02 * k:.2f},0,0,0,2.{k:03d}" for k in range(300)]
    (tmp_path / "log.csv").write_text("\n".join(["# a", "t,roll,pitch,r,d2", *flight, *flight]))
    with pytest.raises(SourceError, match=r"log\.csv:303: time goes back from 5\.98 s to 0 s"):
        read_samples(tmp_path)


@pytest.mark.parametrize("bits", [16, 32])
def test_signed_counters_wrap_to_negative_numbers(bits: int, tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text(TABLE.replace('unit = "s"', 'unit = "ms"', 1))
    half = 1 << (bits - 1)
    times_ms = half - 1000 + np.arange(200) * 20
    wrapped = (times_ms + half) % (2 * half) - half
    rows = [f"{t},0,0,0,{2 + 0.01 * k:.2f}" for k, t in enumerate(wrapped)]
    (tmp_path / "log.csv").write_text("\n".join(["t,roll,pitch,r,d2", *rows]))
    found = read_samples(tmp_path)["/cf1/range/cf2"]
    assert [s.time_ns for s in found] == (times_ms * 1_000_000).tolist()


def test_rows_before_time_0_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text(TABLE)
    rows = [f"{0.02 * k - 1:.2f},0,0,0,{2 + 0.01 * k:.2f}" for k in range(200)]
    (tmp_path / "log.csv").write_text("\n".join(["t,roll,pitch,r,d2", *rows]))
    with count_left_out() as left_out:
        found = read_samples(tmp_path)["/cf1/range/cf2"]
    assert [s.time_ns for s in found] == [20_000_000 * k for k in range(150)]
    assert left_out.counts == {"rows with times before 0": 50}
    assert left_out.first["rows with times before 0"].endswith("log.csv:2")


@pytest.mark.parametrize(("held", "count", "counted"), [("", 20, 180), ("true", 20, 0)])
def test_repeated_ranges_are_counted_once(
    held: str, count: int, counted: int, tmp_path: Path
) -> None:
    key = f"held = {held}\n" if held else ""
    (tmp_path / "map.toml").write_text(TABLE + key)
    rows = [f"{0.02 * k:.2f},0,0,0,{2 + 0.37 * np.sin(k // 10):.3f}" for k in range(200)]
    (tmp_path / "log.csv").write_text("\n".join(["t,roll,pitch,r,d2", *rows]))
    with count_left_out() as left_out:
        found = read_samples(tmp_path)["/cf1/range/cf2"]
    assert [s.time_ns for s in found] == [k * 200_000_000 for k in range(count)]
    assert sum(left_out.counts.values()) == counted
    (tmp_path / "map.toml").write_text(TABLE + "held = false\n")
    assert len(read_samples(tmp_path)["/cf1/range/cf2"]) == 200


CELLS = st.one_of(
    st.floats(-1e9, 1e9).map(repr),
    st.integers(-(10**12), 10**12).map(str),
    st.sampled_from(["1e-3", "+2.5", "-0", ".5", "7.", "inf", "-inf"]),
    st.sampled_from(sorted(pandas.io.parsers.readers.STR_NA_VALUES)),
)


@given(st.lists(st.tuples(CELLS, CELLS, CELLS), min_size=3, max_size=20), st.sampled_from(",;\t|"))
def test_numbers_and_missing_values_are_parsed_as_by_pandas(
    rows: list[tuple[str, ...]], separator: str
) -> None:
    names = ["t", "roll", "pitch", "d2"]
    lines = [[str(k), *cells] for k, cells in enumerate(rows)]
    text = "\n".join(separator.join(row) for row in [names, *lines]) + "\n"
    wanted = pandas.read_csv(io.StringIO(text), sep=separator)
    with TemporaryDirectory() as folder, count_left_out() as left_out:
        path = Path(folder) / "a.csv"
        path.write_text(text, encoding="utf-8")
        table = read_table(path, names, Dialect(separator, "."))
        for name in names:
            column = wanted[name].astype(float).to_numpy()
            np.testing.assert_allclose(table.parse_numbers(name), column, rtol=1e-15)
    assert left_out.counts == {}


MOMENTS = st.datetimes(pandas.Timestamp("1970-01-02"), pandas.Timestamp("2200-01-01"))


@given(
    st.lists(MOMENTS, min_size=2, max_size=9, unique=True),
    st.sampled_from(["T", " "]),
    st.sampled_from(["", "Z", "+00:00", "+05:30", "-0800"]),
)
def test_iso_times_are_parsed_as_by_pandas(moments: list[Any], between: str, zone: str) -> None:
    moments = sorted(moments, key=lambda moment: moment.timestamp())
    cells = [moment.isoformat(between) + zone for moment in moments]
    wanted = pandas.to_datetime(pandas.Series(cells), format="ISO8601", utc=True)
    wanted_ns = wanted.dt.as_unit("ns").astype("int64").tolist()
    assert [parse_time_ns(cell, 1e9, has_decimal_commas=False) for cell in cells] == wanted_ns


def test_comment_marks_in_cells_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t,bat,note,d2 # unit m\n0,80 %,lap #3,1.5\n1,79 %,lap #4,1.6 # far\n")
    with count_left_out() as left:
        table = read_table(path, ("t", "d2"))
    assert not left.counts
    assert table.columns["bat"] == ["80 %", "79 %"] and table.columns["d2"] == ["1.5", "1.6"]
    assert table.columns["note"] == ["lap #3", "lap #4"]


def test_decimal_commas_far_below_the_header_are_found(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t;d2\n" + "".join(f"{k};0\n" for k in range(300)) + "300;0,25\n")
    table = read_table(path, ("t", "d2"))
    values = table.parse_numbers("d2")
    assert values is not None and values[-1] == 0.25


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be"])
def test_utf_16_needs_no_mark(encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(to_text().encode(encoding))
    assert set(read_table(path, WANTED).columns) == set(WANTED)


@pytest.mark.parametrize("start", [b"PK\x03\x04", b"\x1f\x8b\x08\0", b"\x89PNG\r\n\x1a\n"])
def test_files_that_are_no_text_are_refused_as_such(start: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(start + bytes(range(256)) * 8)
    with pytest.raises(SourceError, match=r"a\.csv is no text"):
        read_table(path, WANTED)
