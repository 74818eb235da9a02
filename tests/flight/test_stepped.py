"""Stepped flights have the specified dynamics, and the same measurements as whole flights."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.errors import SettingError
from dmrl.flight import NOISE, Fault, Scenario, simulate
from dmrl.flight.dead_reckoning import DeadReckoning
from dmrl.flight.flight_arrays import RobotLog
from dmrl.flight.pilot import Command
from dmrl.flight.stepped import SteppedFlight

EIGHT = Scenario(2, 60.0, "figure_of_eight", flown=1)


def fly(command: Command, seconds: float, scenario: Scenario = EIGHT) -> SteppedFlight:
    """Fly one command with ideal sensors for some seconds."""
    flight = SteppedFlight(scenario, NOISE["ideal"], 3)
    flight.advance({"cf1": command}, round(seconds * 100))
    return flight


@pytest.mark.parametrize("seed", range(4))
def test_leader_flies_the_specified_figure_eight(seed: int) -> None:
    truth = simulate(replace(EIGHT, flown=0), NOISE["ideal"], seed).truth["cf2"]
    assert np.abs(truth.position[:, :2]).max(axis=0) == pytest.approx([1.6, 1.2], abs=0.01)
    assert np.hypot(*truth.velocity[:, :2].T).max() <= 0.6 + 1e-9
    assert truth.position[:, 2].min() == pytest.approx(0.85, abs=0.01)
    assert truth.position[:, 2].max() == pytest.approx(1.15, abs=0.01)
    # One round is the time between two passages through the origin in the same direction.
    right = truth.position[:, 0] > 0
    crossings = np.flatnonzero(right[1:] & ~right[:-1]) / 100
    assert 18.0 <= np.diff(crossings).mean() <= 30.0


@pytest.mark.parametrize("distance_m", [0.7, 1.0])
def test_follower_starts_behind_the_leader_and_faces_it(distance_m: float) -> None:
    flight = SteppedFlight(replace(EIGHT, distance_m=distance_m), NOISE["ideal"], 5).flight
    x, y, z = flight.peer_in_horizontal("cf1", "cf2", np.zeros(1))[0]
    assert (x, y) == pytest.approx((distance_m + 0.1, 0.0))
    assert abs(z) <= 0.1


@pytest.mark.heavy
def test_commands_are_followed_with_lag_and_within_limits() -> None:
    truth = fly(Command(0.8, 0.0, 0.0, 0.0), 2.0).flight.truth["cf1"]
    speed = np.hypot(*truth.velocity[:, :2].T)
    assert speed[25] == pytest.approx(0.8 * (1 - np.exp(-1)), abs=0.02)  # the lag is 0.25 s
    turning = fly(Command(0.0, 0.0, 0.0, 1.0), 2.0)._flyers["cf1"].yaw_rate
    assert turning[15] == pytest.approx(1 - np.exp(-1), abs=0.03)  # the lag is 0.15 s
    fast = fly(Command(5.0, 5.0, 5.0, 9.0), 5.0)
    assert np.hypot(*fast.flight.truth["cf1"].velocity[:501, :2].T).max() <= 1.0 + 1e-9
    assert fast.flight.truth["cf1"].velocity[500, 2] == pytest.approx(0.4, abs=0.01)
    assert fast._flyers["cf1"].yaw_rate[500] == pytest.approx(1.5, abs=0.01)


def test_velocity_is_in_body_axes_and_acceleration_tilts_the_robot() -> None:
    flight = fly(Command(0.0, 0.5, 0.0, 0.0), 1.0)
    log = flight.flight.robots["cf1"]
    assert log.vy_mps[100] == pytest.approx(0.5, abs=0.02)
    assert log.vx_mps[:101] == pytest.approx(0.0, abs=1e-9)
    truth = flight.flight.truth["cf1"]
    assert truth.roll[5] < -0.02  # it accelerates to the left, with the left side down
    assert truth.pitch[5] == pytest.approx(0.0, abs=1e-6)


def test_a_flight_does_not_depend_on_the_size_of_its_steps() -> None:
    noise = NOISE["harsh"]
    faults = (Fault("velocity_gap", "cf2", start_s=1.0), Fault("nlos", "cf1", start_s=0.5))
    scenario = Scenario(3, 4.0, "in_view")
    whole = simulate(scenario, noise, 7, faults)
    stepped = SteppedFlight(scenario, noise, 7, faults)
    ranges = [stepped.flight.ranges["cf1", "cf2"].range_m]
    while stepped.sample < stepped.samples - 1:
        stepped.advance({}, 7)
        ranges.append(stepped.flight.ranges["cf1", "cf2"].range_m)
    for robot, log in whole.robots.items():
        for column in RobotLog.__slots__:
            found = getattr(stepped.flight.robots[robot], column)
            np.testing.assert_array_equal(found, getattr(log, column))
    np.testing.assert_array_equal(np.concatenate(ranges), whole.ranges["cf1", "cf2"].range_m)


def test_dead_reckoning_of_an_ideal_robot_is_its_true_path() -> None:
    flight = SteppedFlight(EIGHT, NOISE["ideal"], 1)
    reckoning = DeadReckoning(flight.flight.robots["cf1"])
    reckoning.extend(slice(0, 1))
    for k in range(100):
        first = flight.sample + 1
        flight.advance({"cf1": Command(0.4, 0.2, 0.1, np.sin(k / 9))}, 5)
        reckoning.extend(slice(first, flight.sample + 1))
    truth = flight.flight.truth["cf1"]
    c, s = np.cos(truth.yaw[100]), np.sin(truth.yaw[100])
    x, y, z = truth.position[500] - truth.position[100]
    dt_s, way_m, turn_rad = reckoning.motion(100, 500)
    assert dt_s == pytest.approx(4.0)
    assert way_m == pytest.approx([c * x + s * y, c * y - s * x, z], abs=1e-3)
    assert turn_rad == pytest.approx(truth.yaw[500] - truth.yaw[100], abs=1e-3)


def test_a_silent_sensor_keeps_its_last_value() -> None:
    flight = SteppedFlight(
        EIGHT, NOISE["ideal"], 1, (Fault("velocity_gap", "cf1", start_s=1.0, duration_s=1.0),)
    )
    flight.advance({"cf1": Command(0.5)}, 150)
    reckoning = DeadReckoning(flight.flight.robots["cf1"])
    reckoning.extend(slice(0, 151))
    assert np.isnan(flight.flight.robots["cf1"].vx_mps[150])
    assert reckoning.sensors[3, 150] == reckoning.sensors[3, 99] > 0.4


def test_invalid_stepped_flight_is_refused() -> None:
    with pytest.raises(SettingError, match="a pilot flies it"):
        SteppedFlight(EIGHT, NOISE["ideal"], 1, (Fault("crash", "cf1"),))
    with pytest.raises(SettingError, match="flown = 3"):
        SteppedFlight(replace(EIGHT, flown=3), NOISE["ideal"], 1)
    with pytest.raises(SettingError, match="--distance-m"):
        SteppedFlight(replace(EIGHT, distance_m=9.0), NOISE["ideal"], 1)
