"""Ranges whose peer is named by another column of the row."""

from pathlib import Path

import pytest

import dmrl
from dmrl.errors import SourceError
from dmrl.formats.base import Options
from dmrl.formats.files import mapped_csv

TIME_AND_ROBOT = '[time]\nname = "t"\nunit = "s"\n[robot]\nname = "from"\n'
PEER = '[peer]\nname = "to"\n'
ANY_RANGE = '[range."*"]\nname = "d"\nunit = "cm"\n'
ROWS = "t,from,to,d\n0.0,a,b,100\n0.0,a,c,500\n0.0,b,a,110\n0.1,a,b,101\n0.1,a,c,\n0.1,b,c,320\n"


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Return a file with a row for each range between three robots."""
    path = tmp_path / "ranges.csv"
    path.write_text(ROWS)
    return path


def read_ranges(source: Path, text: str, **options: str) -> dict[str, list[float]]:
    """Return the ranges, metres, by topic; ``options`` rename robots."""
    table = source.with_name("map.toml")
    table.write_text(text)
    made = Options(columns=table, names=options)
    found: dict[str, list[float]] = {}
    for sample in mapped_csv.load_content(source, made).samples:
        if "/range/" in sample.topic:
            found.setdefault(sample.topic, []).append(sample.fields["range_m"])
    return found


def test_rows_name_their_peer(source: Path) -> None:
    assert read_ranges(source, TIME_AND_ROBOT + PEER + ANY_RANGE, c="cf3") == {
        "/a/range/b": [1.0, 1.01],
        "/a/range/cf3": [5.0],
        "/b/range/a": [pytest.approx(1.1)],
        "/b/range/cf3": [3.2],
    }


def test_a_column_is_not_the_range_to_two_peers(source: Path) -> None:
    ranges = "".join(f'[range.{peer}]\nname = "d"\nunit = "cm"\n' for peer in "abc")
    with pytest.raises(SourceError, match=r"d cannot be the range of a to both b and c.*\[peer\]"):
        read_ranges(source, TIME_AND_ROBOT + ranges)


def test_a_file_with_ranges_to_its_own_robot_alone_is_named(
    source: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ranges = ANY_RANGE.replace('"*"', "cf1")
    assert not read_ranges(source, TIME_AND_ROBOT.split("[robot]")[0] + ranges)
    assert (
        "nothing is of cf1, which has no range to itself. Try: --robot" in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (PEER.replace("to", "whom") + ANY_RANGE, "no column whom"),
        (PEER, r"\[peer\] needs \[range\.\"\*\"\]"),
        (PEER + ANY_RANGE.replace('"d"', '"{peer}_d"'), "rows name the peer"),
        (ANY_RANGE, r"no \{peer\} in it"),
    ],
)
def test_tables_that_name_no_peer_are_refused(source: Path, text: str, fault: str) -> None:
    with pytest.raises(SourceError, match=fault):
        read_ranges(source, TIME_AND_ROBOT + text)


def test_topics_take_no_column_of_peers(source: Path) -> None:
    recording = source.with_name("flight.mcap")
    with dmrl.writer(recording, robots="one") as out:
        out.write_columns("/a/height", [0.0], {"height_m": [1.0]})
    table = source.with_name("map.toml")
    table.write_text(TIME_AND_ROBOT + PEER + ANY_RANGE)
    with pytest.raises(SourceError, match="are for text files"):
        dmrl.convert(recording, source.with_name("out.mcap"), columns=table)
