"""Fixtures: a simulated flight and its dataset."""

from pathlib import Path

import pytest

import dmrl


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulate two robots for 6 s, with an image every half second."""
    out = tmp_path_factory.mktemp("api") / "flight.mcap"
    dmrl.fly(out, duration_s=6.0, noise="calibrated", camera=True, camera_rate_hz=2.0, seed=3)
    return out


@pytest.fixture(scope="session")
def data(flight: Path) -> Path:
    """Build the dataset of the flight."""
    return dmrl.make_dataset([flight], flight.with_name("set")).path
