"""Flights with columns in wrong units are reported by ``dmrl convert`` or ``dmrl check``."""

from pathlib import Path

import numpy as np
import pytest

from dmrl import boundary
from dmrl.cli import app

pytestmark = pytest.mark.slow

UNITS = {
    "roll_deg": ("roll_rad", 57.3),
    "pitch_deg": ("pitch_rad", 57.3),
    "yaw_rate_deg": ("yaw_rate_radps", 57.3),
    "velocity_mm": ("v", 1e3),
    "velocity_cm": ("v", 1e2),
    "height_mm": ("height_m", 1e3),
    "height_cm": ("height_m", 1e2),
    "range_mm": ("range", 1e3),
    "range_cm": ("range", 1e2),
    "time_ms": ("time_s", 1e3),
    "time_us": ("time_s", 1e6),
    "time_ns": ("time_s", 1e9),
    "time_min": ("time_s", 1e-5),
}
"""Start of the names of the wrong columns, and the factor that they are multiplied by."""


def write_flight(folder: Path, column: str = "", factor: float = 1.0) -> Path:
    """Write the CSV logs of two robots over 20 s, with some columns multiplied by a factor."""
    time_s = np.arange(0.0, 20.0, 0.02)
    noise = np.random.default_rng(1)
    paths = {
        "cf1": np.stack([np.sin(0.5 * time_s), 0.8 * np.cos(0.7 * time_s), 0.5 + 0 * time_s]),
        "cf2": np.stack([2 + np.cos(0.4 * time_s), np.sin(0.9 * time_s), 0.9 + 0 * time_s]),
    }
    apart = np.linalg.norm(paths["cf1"] - paths["cf2"], axis=0)
    folder.mkdir()
    for own, peer in (("cf1", "cf2"), ("cf2", "cf1")):
        speed = np.gradient(paths[own], time_s, axis=1)
        pull = np.gradient(speed, time_s, axis=1) / 9.81
        yaw = 0.6 * np.sin(0.8 * time_s)
        cos, sin = np.cos(yaw), np.sin(yaw)
        columns = {
            "time_s": time_s,
            "roll_rad": -pull[1] + noise.normal(0, 0.01, len(time_s)),
            "pitch_rad": pull[0] + noise.normal(0, 0.01, len(time_s)),
            "yaw_rate_radps": np.gradient(yaw, time_s),
            "vx_mps": cos * speed[0] + sin * speed[1],
            "vy_mps": cos * speed[1] - sin * speed[0],
            "height_m": paths[own][2],
            f"range_{peer}_m": apart + noise.normal(0, 0.05, len(time_s)),
        }
        for name in columns:
            if column and name.startswith(column):
                columns[name] = columns[name] * factor
        lines = [",".join(columns)]
        lines += [",".join(f"{x:.9g}" for x in row) for row in zip(*columns.values(), strict=True)]
        (folder / f"{own}.csv").write_text("\n".join(lines) + "\n")
    return folder


def convert_and_read_stderr(source: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Convert and check a flight; return the warnings of both commands."""
    words = [["convert", str(source), str(out)], ["check", str(out)]]
    status = [
        boundary.run_to_status(lambda w=w: app(w, result_action="return_value")) for w in words
    ]
    printed = capsys.readouterr()
    assert status[0] == 0 or status == [1, 1]
    warnings = [line for line in printed.out.splitlines() if "warning" in line]
    return printed.err + "\n".join(line for line in warnings if "0 warnings" not in line)


def test_right_units_give_no_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        convert_and_read_stderr(write_flight(tmp_path / "flight"), tmp_path / "out.mcap", capsys)
        == ""
    )


@pytest.mark.parametrize("name", UNITS)
def test_wrong_unit_is_reported_with_its_column(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    column, factor = UNITS[name]
    text = convert_and_read_stderr(
        write_flight(tmp_path / "flight", column, factor), tmp_path / "out.mcap", capsys
    )
    asked = {"roll": "degrees", "pitch": "degrees", "yaw": "degrees per second", "time": "Were"}
    asked |= {"velocity": "mm/s or cm/s", "height": "mm or cm", "range": "left out"}
    assert asked[name.partition("_")[0]] in text
