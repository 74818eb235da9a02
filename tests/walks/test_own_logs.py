"""Logs of drones are converted: micro-SD logs, published CSV flights, and clocks since boot."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.recording import check, read_summary, read_table
from dmrl.stages import align, convert, merge

from ..formats import plain_usd

pytestmark = pytest.mark.slow


def test_every_sd_card_log_gives_motion_or_a_reason(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for card in sorted((data / "crazypad").glob("*_log*")):
        out = tmp_path / f"{card.name}.mcap"
        counts = convert.run(card, out, convert.Settings(robot="cf7"))
        output = capsys.readouterr().err
        for topic, reason in (("attitude", "no attitude: no"), ("velocity", "no velocity: no")):
            assert (f"/cf7/{topic}" in counts) != (reason in output), (card.name, topic)
        # All logged variables are there, and the licence of the folder.
        assert counts["/cf7/log/fixedFrequency"] > 2500
        assert read_summary(out).metadata["dmrl.licences"] == [{card.name: "MIT License"}]
        assert not [finding for finding in check(out) if finding.level == "error"]


def test_third_party_csv_flights_are_read_by_column_map(data: Path, tmp_path: Path) -> None:
    for k, flight in enumerate(sorted((data / "nanobench").glob("*.csv")), 1):
        out = tmp_path / f"{flight.stem}.mcap"
        counts = convert.run(flight, out, convert.Settings(robot=f"cf{k}"))
        assert {
            f"/cf{k}/{name}" for name in ("attitude", "velocity", "pose/truth")
        } <= counts.keys()
        speed = read_table(out, f"/cf{k}/velocity")
        assert np.hypot(speed["vx_mps"].to_numpy(), speed["vy_mps"].to_numpy()).max() < 20
    flights = sorted(tmp_path.glob("*.mcap"))
    merge.run(flights[:2], tmp_path / "both.mcap")
    assert [f.topic for f in check(tmp_path / "both.mcap") if "shares no time" in f.text]


def test_two_clocks_are_aligned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The clocks of the two robots differ by 100 s. Their ranges to each other align them."""
    rng = np.random.default_rng(0)
    time_s = np.cumsum(rng.uniform(0.03, 0.05, 1500))
    range_m = 3 + 0.5 * np.sin(time_s) + 0.4 * np.sin(1.7 * time_s) + rng.normal(0, 0.05, 1500)
    (tmp_path / "logs").mkdir()
    for robot, peer, boot_s in (("cf1", 2, 100.0), ("cf2", 1, 0.0)):
        events = {1: ("range", [(f"ranging.distance{peer}", "f"), ("stateEstimate.z", "f")])}
        rows = [
            (1, round((t + boot_s) * 1e6), (float(r), 1.0))
            for t, r in zip(time_s, range_m, strict=True)
        ]
        (tmp_path / "logs" / robot).write_bytes(plain_usd.encode(events, rows))
    convert.run(tmp_path / "logs", tmp_path / "flight.mcap", convert.Settings())
    assert "shares no time with /cf2" in capsys.readouterr().err
    clocks = align.run(tmp_path / "flight.mcap", tmp_path / "aligned.mcap", align.Settings())
    assert clocks.keys() == {"cf1", "cf2"} and abs(clocks["cf2"].offset_s - 100.0) < 0.01
    assert not [f for f in check(tmp_path / "aligned.mcap") if "shares no time" in f.text]
