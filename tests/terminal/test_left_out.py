"""Omissions are counted by reason."""

import pytest

from dmrl.errors import SourceError
from dmrl.terminal.left_out import count_left_out, count_so_far, leave_out


def test_omissions_are_counted_by_reason_and_reported_once(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with count_left_out() as held:
        for line in (3, 8, 9):
            leave_out("rows without a time", f"a.csv:{line}")
        leave_out("bytes at the end", "b.bin: byte 70", 12)
        leave_out("files of no known kind", "never", 0)
        assert count_so_far() == {"rows without a time": 3, "bytes at the end": 12}
        assert capsys.readouterr().err == ""
    assert held.counts == {"rows without a time": 3, "bytes at the end": 12}
    assert capsys.readouterr().err.splitlines() == [
        "left out: rows without a time: 3 (first at a.csv:3)",
        "left out: bytes at the end: 12 (first at b.bin: byte 70)",
    ]
    assert count_so_far() == {}


def test_omissions_are_counted_by_the_innermost_context() -> None:
    with count_left_out() as outer:
        with count_left_out() as inner:
            leave_out("rows", "a")
        leave_out("rows", "a")
    assert (outer.counts["rows"], inner.counts["rows"]) == (1, 1)


def test_strict_raises_at_the_first_omission(capsys: pytest.CaptureFixture[str]) -> None:
    match = r"a\.csv:3: rows without a time: 1.*--strict"
    with pytest.raises(SourceError, match=match), count_left_out(strict=True):
        leave_out("rows without a time", "a.csv:3")
    assert count_so_far() == {}
    leave_out("rows", "b.csv:1")
    assert capsys.readouterr().err == "left out: rows: 1 (at b.csv:1)\n"
