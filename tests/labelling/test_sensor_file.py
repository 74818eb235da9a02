"""Files of sensor constants, and their use in labelling."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.estimation.flight.pairs import estimate_pairs
from dmrl.estimation.solver.layout import Subject
from dmrl.labelling.flight_log import read_flight
from dmrl.labelling.sensor_file import SensorConstants, read_sensors, write_sensors
from dmrl.labelling.sensor_logs import build_sensor_logs

from ..estimation.flights import build_pair, simulate_flight
from .test_sensor_logs import read_logs, write_flight, write_ranges

KNOWN = SensorConstants(
    {
        "cf1": {"yaw_rate_bias_radps": (0.01, 0.001)},
        "cf2": {
            "yaw_rate_bias_radps": (-0.05, 0.002),
            "velocity_scale": (0.15, 0.01),
            "vx_bias_mps": (0.02, 0.01),
            "vy_bias_mps": (-0.03, 0.01),
        },
    },
    {
        ("cf1", "cf2"): {
            "range_offset_m": (0.35, 0.04),
            "range_scale": (0.02, 0.01),
        }
    },
)


def test_sensor_file_round_trips(tmp_path: Path) -> None:
    path = tmp_path / "sensors.toml"
    path.write_text(write_sensors(KNOWN))
    assert read_sensors(path) == KNOWN
    assert KNOWN.names == ["cf1", "cf2"]


def test_logged_values_are_corrected_by_sensor_constants() -> None:
    true = np.array([[0.4, -0.2], [0.0, 1.0]])
    logged = true * 1.15 + [0.02, -0.03]
    assert KNOWN.correct_velocity("cf2", logged) == pytest.approx(true)
    assert KNOWN.correct_velocity("cf1", logged) == pytest.approx(logged)
    assert KNOWN.correct_yaw_rate("cf2", np.array([0.25])) == pytest.approx([0.3])
    assert KNOWN.correct_ranges(("cf1", "cf2"), np.array([2.0 * 1.02 + 0.35])) == pytest.approx(
        [2.0]
    )
    assert KNOWN.correct_ranges(("cf1", "cf3"), np.array([2.0])) == pytest.approx([2.0])


def test_sensor_sigmas_reach_the_solve() -> None:
    assert KNOWN.to_prior_std(("cf1", "cf2")) == {
        ("range_offset", (0, 1)): 0.04,
        ("range_scale", (0, 1)): 0.01,
        ("gyro_bias", (0,)): 0.001,
        ("gyro_bias", (1,)): 0.002,
        ("velocity_scale", (1,)): 0.01,
        ("vx_bias", (1,)): 0.01,
        ("vy_bias", (1,)): 0.01,
    }
    assert KNOWN.to_prior_std(("cf1", "cf3")) == {("gyro_bias", (0,)): 0.001}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[[robots", "Write one: dmrl calibrate --sensors"),
        ("width_px = 3", "it has width_px, and not robots and pairs alone"),
        ("robots = 3", r"robots is no list of tables \[\[robots\]\]"),
        ("[[robots]]\nvelocity_scale = [0.1, 0.1]", "a table of robots has no name"),
        ('[[robots]]\nname = "a"\nmass = [0.1, 0.1]', "mass is none of yaw_rate_bias_radps"),
        ('[[robots]]\nname = "a"\nvelocity_scale = 0.1', "velocity_scale is no"),
        ('[[robots]]\nname = "a"\nvelocity_scale = [-1.0, 0.1]', "velocity_scale is no"),
        ('[[robots]]\nname = "a"\nvelocity_scale = [0.1, 0.0]', "velocity_scale is no"),
        ('[[robots]]\nname = "a"\nvelocity_scale = [nan, 0.1]', "velocity_scale is no"),
        ('[[robots]]\nname = "a"\nvelocity_scale = [true, 0.1]', "velocity_scale is no"),
        ('[[pairs]]\nrobots = ["a"]\nrange_scale = [0.1, 0.1]', "a table of pairs has no robots"),
        ('[[pairs]]\nrobots = ["b", "a"]\nrange_scale = [0.1, 0.1]', "in the order of their names"),
    ],
)
def test_other_file_gives_one_line_error(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "sensors.toml"
    path.write_text(text)
    with pytest.raises(SourceError, match=words):
        read_sensors(path)
    with pytest.raises(SourceError, match=r"no file .*other\.toml"):
        read_sensors(tmp_path / "other.toml")


def test_known_sensor_errors_are_removed_on_reading(tmp_path: Path) -> None:
    found = read_logs(tmp_path / "a.mcap", write_flight, write_ranges).pairs["cf1", "cf2"]
    known = build_sensor_logs(read_flight(tmp_path / "a.mcap"), 0.1, KNOWN).pairs["cf1", "cf2"]
    assert known.range_m == pytest.approx((found.range_m - 0.1 - 0.35) / 1.02)
    assert known.own.vx_mps == pytest.approx(found.own.vx_mps)
    assert known.peer.vx_mps == pytest.approx((found.peer.vx_mps - 0.02) / 1.15)
    assert known.own.yaw_rate_radps == pytest.approx(found.own.yaw_rate_radps - 0.01)
    assert known.known_std == KNOWN.to_prior_std(("cf1", "cf2"))
    assert not found.known_std
    swapped = known.swap_robots().known_std
    assert [swapped["gyro_bias", (side,)] for side in (0, 1)] == [0.002, 0.001]
    assert swapped["range_offset", (0, 1)] == 0.04


@pytest.mark.heavy
def test_known_constants_stay_fixed_in_the_solve() -> None:
    pair = build_pair(simulate_flight("in_view", "realistic", 31))
    free = estimate_pairs([pair])[0][0]
    known: dict[Subject, float] = {("range_offset", (0, 1)): 1e-4, ("velocity_scale", (1,)): 1e-4}
    held = estimate_pairs([replace(pair, known_std=known)])[0][0]
    for name, own in known:
        assert abs(held.value(name, *own)) < 1e-3 < 3e-3 < abs(free.value(name, *own))
    assert abs(held.value("gyro_bias", 0) - free.value("gyro_bias", 0)) < 0.01
