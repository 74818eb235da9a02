"""A recording session that fails names the file that holds the flight."""

from pathlib import Path

import pytest

from dmrl.errors import OutputError
from dmrl.ingest import live_session
from dmrl.ingest.settings import RecordSettings
from dmrl.live.robot_options import parse_robot

pytest.importorskip("cflib")


def test_a_failed_session_names_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> dict[str, int]:
        raise OutputError("no space left")

    monkeypatch.setattr(live_session, "_write_samples", fail)
    out = tmp_path / "flight.mcap"
    with pytest.raises(OutputError, match="no space left"):
        robots = [parse_robot("cf1=udp://127.0.0.1:7999")]
        live_session.record_session(out, robots, RecordSettings())
    lines = " ".join(capsys.readouterr().err.split())
    assert f"{out}.partial holds the flight until then." in lines
    assert f"dmrl recover {out}.partial" in lines
    assert Path(f"{out}.partial").exists()
