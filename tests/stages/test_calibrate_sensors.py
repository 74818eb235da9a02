"""Calibration of constant sensor errors over several flights."""

from dataclasses import replace
from pathlib import Path

import pytest

from dmrl.errors import OutputError, RecordingError, SettingError
from dmrl.flight import Fault
from dmrl.labelling.calibration import sensor_calibration
from dmrl.labelling.sensor_file import SensorConstants, read_sensors, write_sensors
from dmrl.recording import read_summary
from dmrl.stages import calibrate, fly, label
from dmrl.stages.calibrate import Settings

pytestmark = pytest.mark.heavy
FAULTS = [
    Fault("range_offset", "cf1", "cf2"),
    Fault("yaw_rate_bias", "cf2"),
    Fault("velocity_scale", "cf1"),
]
SENSORS = Settings(sensors=True)


def write_flight(path: Path, seed: int, length_s: float = 50.0) -> Path:
    """Fly two robots whose sensors have the same faults in every flight."""
    fly.run(path, fly.Settings(2, length_s, noise="calibrated", seed=seed, faults=FAULTS))
    return path


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return three flights of the same sensors."""
    folder = tmp_path_factory.mktemp("sensors")
    return [write_flight(folder / f"{seed}.mcap", seed) for seed in (9301, 9302, 9303)]


@pytest.fixture(scope="module")
def sensor_file(flights: list[Path]) -> Path:
    """Return the sensor errors that were estimated from the three flights."""
    out = flights[0].with_name("sensors.toml")
    calibrate.run(flights, out, SENSORS)
    return out


def test_constant_sensor_errors_are_estimated(sensor_file: Path) -> None:
    found = read_sensors(sensor_file)
    offset_m, std_m = found.pairs["cf1", "cf2"]["range_offset_m"]
    assert offset_m == pytest.approx(0.35, abs=0.1)
    assert std_m < 0.12
    assert found.robots["cf2"]["yaw_rate_bias_radps"][0] == pytest.approx(0.05, abs=0.008)


def test_known_sensor_errors_improve_the_labels_of_a_short_flight(
    sensor_file: Path, tmp_path: Path
) -> None:
    flight = write_flight(tmp_path / "flight.mcap", 9310, 20.0)
    without = label.run(flight, tmp_path / "without.mcap", label.Settings())
    out = tmp_path / "with.mcap"
    better = label.run(flight, out, label.Settings(sensors=sensor_file))
    for before, after in zip(without.pairs, better.pairs, strict=True):
        assert after.kept_share >= before.kept_share - 0.05
        assert after.sigma_m < before.sigma_m
        assert after.rmse_ok_m is not None
        assert after.rmse_ok_m < 0.2
    assert better.warnings == []
    assert sensor_file.name in [one.name for one in read_summary(out).provenance.inputs]


def test_wrong_sensor_file_is_detected(sensor_file: Path, tmp_path: Path) -> None:
    sensors = read_sensors(sensor_file)
    other = {**sensors.robots["cf2"], "yaw_rate_bias_radps": (-0.05, 0.004)}
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(write_sensors(replace(sensors, robots={"cf2": other})))
    flight = write_flight(tmp_path / "flight.mcap", 9311)
    found = label.run(flight, tmp_path / "out.mcap", label.Settings(sensors=wrong))
    assert any("cf2" in line and "yaw rate" in line for line in found.warnings), found.warnings


def test_workers_change_no_byte(flights: list[Path], sensor_file: Path, tmp_path: Path) -> None:
    calibrate.run(flights, tmp_path / "two.toml", SENSORS, workers=2)
    assert (tmp_path / "two.toml").read_bytes() == sensor_file.read_bytes()


def test_invalid_sensor_calibration_gives_one_line_error(
    flights: list[Path], sensor_file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "sensors.toml"
    with pytest.raises(RecordingError, match="no pair of robots has 2 flights"):
        calibrate.run(flights[:1], out, SENSORS)
    with pytest.raises(RecordingError, match="twice"):
        calibrate.run([*flights, flights[0]], out, SENSORS)
    with pytest.raises(SettingError, match="cannot be combined"):
        calibrate.run(flights, out, Settings(sensors=True, board="9x6"))
    with pytest.raises(OutputError):
        calibrate.run(flights, sensor_file, SENSORS)
    assert list(tmp_path.iterdir()) == []


def test_flights_that_agree_on_nothing_leave_no_file(
    flights: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sensor_calibration, "MAX_STD_SHARE", 0.0)
    monkeypatch.setattr(sensor_calibration, "MIN_SIGMAS", float("inf"))
    with pytest.raises(RecordingError, match="determine no sensor constant better"):
        calibrate.run(flights[:2], tmp_path / "sensors.toml", SENSORS)
    assert list(tmp_path.iterdir()) == []


def test_a_file_of_other_robots_is_refused(flights: list[Path], tmp_path: Path) -> None:
    path = tmp_path / "sensors.toml"
    path.write_text(write_sensors(SensorConstants({"cf7": {"velocity_scale": (0.1, 0.01)}})))
    with pytest.raises(SettingError, match=r"is of cf7, and .* has cf1, cf2"):
        label.run(flights[0], tmp_path / "out.mcap", label.Settings(sensors=path))
