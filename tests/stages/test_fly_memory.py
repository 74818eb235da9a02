"""Memory of a simulated flight, counted by Python and NumPy."""

import tracemalloc
from pathlib import Path

import pytest

from dmrl.stages import fly
from dmrl.stages.fly import Settings

KB_PER_SECOND = 20
"""For each robot: seventeen columns of 100 numbers a second are 14, and what makes them 5."""
SHORT_S, LONG_S = 10.0, 60.0


def _peak(out: Path, settings: Settings) -> int:
    """The most bytes that were held at a time."""
    tracemalloc.start()
    try:
        fly.run(out, settings)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.heavy
def test_a_flight_holds_its_columns_and_no_message(tmp_path: Path) -> None:
    fly.run(tmp_path / "first.mcap", Settings(duration_s=2.0))  # loads what is loaded once
    short, long = (
        _peak(tmp_path / f"{duration_s}.mcap", Settings(duration_s=duration_s))
        for duration_s in (SHORT_S, LONG_S)
    )
    assert (long - short) / (LONG_S - SHORT_S) / 2 < KB_PER_SECOND * 1000
