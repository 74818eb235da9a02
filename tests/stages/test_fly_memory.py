"""Memory of a simulated flight, measured by tracemalloc."""

import tracemalloc
from pathlib import Path

import pytest

from dmrl.stages import fly
from dmrl.stages.fly import Settings

KB_PER_SECOND = 20
"""Allowed for each robot.

Seventeen columns of 100 numbers a second need 14 kB, and computing them another 5 kB.
"""
SHORT_S, LONG_S = 10.0, 60.0


def _measure_peak(out: Path, settings: Settings) -> int:
    """Fly; return the peak of allocated memory, bytes."""
    tracemalloc.start()
    try:
        fly.run(out, settings)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.heavy
def test_a_flight_holds_its_columns_and_no_message(tmp_path: Path) -> None:
    fly.run(tmp_path / "first.mcap", Settings(duration_s=2.0))  # exclude what is loaded only once
    short, long = (
        _measure_peak(tmp_path / f"{duration_s}.mcap", Settings(duration_s=duration_s))
        for duration_s in (SHORT_S, LONG_S)
    )
    assert (long - short) / (LONG_S - SHORT_S) / 2 < KB_PER_SECOND * 1000
