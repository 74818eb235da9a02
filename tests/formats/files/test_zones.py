"""Dates without a zone in text tables."""

from pathlib import Path

import pytest

from dmrl.formats.files.text_table import read_table


@pytest.mark.parametrize(("zone", "said"), [("", True), ("Z", False), ("+02:00", False)])
@pytest.mark.parametrize("before", ["", "\nNaN,0"])
def test_dates_without_a_zone_are_reported_also_behind_rows_without_a_time(
    before: str, zone: str, *, said: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [f"2024-03-01 12:00:0{k}{zone},{k}" for k in range(3)]
    (tmp_path / "a.csv").write_text("t,x" + before + "\n" + "\n".join(rows) + "\n")
    text, time_ns = read_table(tmp_path / "a.csv", ["t"]).order_by_time("t", 1e9)
    assert text.columns["x"] == ["0", "1", "2"]
    hours = 10 if zone == "+02:00" else 12
    assert time_ns.tolist() == [(1_709_251_200 + hours * 3600 + k) * 10**9 for k in range(3)]
    assert ("times without a zone are read as UTC" in capsys.readouterr().err) == said
