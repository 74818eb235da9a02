"""Simulated robots: their paths, attitudes, measurements and clocks."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.errors import SettingError
from dmrl.flight import NOISE, TRAJECTORIES, Clock, Scenario, Trajectory, simulate
from dmrl.flight.trajectories import GRAVITY_MPS2
from dmrl.geometry.frames import camera_from_horizontal

SHORT = Scenario(duration_s=30.0)
IDEAL = NOISE["ideal"]


@pytest.mark.parametrize("kind", TRAJECTORIES)
def test_velocity_is_the_derivative_of_position(kind: Trajectory) -> None:
    for truth in simulate(replace(SHORT, trajectory=kind), IDEAL, 1).truth.values():
        slope = np.diff(truth.position, axis=0) / np.diff(truth.time_s)[:, None]
        mean = (truth.velocity[1:] + truth.velocity[:-1]) / 2
        assert np.abs(slope - mean).max() < 1e-3


@pytest.mark.parametrize("kind", TRAJECTORIES)
def test_an_ideal_robot_measures_the_truth_in_its_own_frame(kind: Trajectory) -> None:
    flight = simulate(replace(SHORT, trajectory=kind), IDEAL, 2)
    for robot, log in flight.robots.items():
        truth = flight.truth[robot]
        own = (truth.velocity[:, 0] + 1j * truth.velocity[:, 1]) * np.exp(-1j * truth.yaw)
        assert np.allclose(log.vx_mps + 1j * log.vy_mps, own)
        turned = np.cumsum((log.yaw_rate_radps[1:] + log.yaw_rate_radps[:-1]) / 200)
        assert np.allclose(turned, truth.yaw[1:] - truth.yaw[0])


def test_thrust_is_along_acceleration_minus_gravity() -> None:
    truth = simulate(replace(SHORT, trajectory="random"), IDEAL, 3).truth["cf1"]
    pull = np.gradient(truth.velocity, 0.01, axis=0) + np.array([0.0, 0.0, GRAVITY_MPS2])
    for k in (500, 1234, 2500):
        yaw = truth.yaw[k]
        level = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        tilt = camera_from_horizontal(truth.roll[k], truth.pitch[k])
        thrust = tilt @ level @ pull[k]
        assert np.abs(thrust[:2]).max() < 1e-2 * thrust[2]


def test_a_robot_that_speeds_up_pitches_its_nose_down() -> None:
    truth = simulate(replace(SHORT, trajectory="no_yaw"), IDEAL, 1).truth["cf1"]
    forward = np.gradient(truth.velocity[:, 0], 0.01)  # forward is x, since the yaw is 0
    assert np.corrcoef(forward, truth.pitch)[0, 1] > 0.99
    left = np.gradient(truth.velocity[:, 1], 0.01)
    assert np.corrcoef(left, truth.roll)[0, 1] < -0.99


def test_relative_position_has_true_distance_and_bearing() -> None:
    flight = simulate(SHORT, IDEAL, 4)
    time_s = flight.truth["cf1"].time_s
    xyz = flight.peer_in_horizontal("cf1", "cf2", time_s)
    away = flight.truth["cf2"].position - flight.truth["cf1"].position
    assert np.allclose(np.linalg.norm(xyz, axis=1), np.linalg.norm(away, axis=1))
    bearing = np.arctan2(away[:, 1], away[:, 0]) - flight.truth["cf1"].yaw
    assert np.allclose(np.exp(1j * np.arctan2(xyz[:, 1], xyz[:, 0])), np.exp(1j * bearing))


@pytest.mark.heavy
def test_in_view_means_in_the_view_of_the_camera() -> None:
    flight = simulate(Scenario(robots=3), IDEAL, 5)
    for peer in ("cf2", "cf3"):
        x, y, _ = flight.peer_in_horizontal("cf1", peer, flight.truth["cf1"].time_s).T
        assert (np.abs(np.arctan2(y, x)) < 0.71).mean() > 0.95
        assert np.hypot(x, y).max() < 2.5


@pytest.mark.parametrize(
    ("kind", "still"),
    [
        ("observer_static", ("cf1",)),
        ("peer_static", ("cf2",)),
        ("both_static", ("cf1", "cf2")),
    ],
)
def test_static_robots_do_not_move(kind: Trajectory, still: tuple[str, ...]) -> None:
    flight = simulate(replace(SHORT, trajectory=kind), IDEAL, 1)
    moves = {r for r, t in flight.truth.items() if np.ptp(t.position[:, :2], axis=0).max() > 0.01}
    assert moves == set(flight.truth) - set(still)


def test_parallel_robots_keep_their_relative_position() -> None:
    flight = simulate(replace(SHORT, trajectory="parallel"), IDEAL, 1)
    away = flight.truth["cf2"].position - flight.truth["cf1"].position
    assert np.ptp(away[:, :2], axis=0).max() < 1e-9
    assert np.array_equal(flight.robots["cf1"].vx_mps, flight.robots["cf2"].vx_mps)


def test_flight_depends_only_on_arguments_and_seed() -> None:
    one, same, other = (simulate(SHORT, NOISE["harsh"], seed) for seed in (7, 7, 8))
    assert np.array_equal(one.robots["cf2"].vx_mps, same.robots["cf2"].vx_mps)
    assert np.array_equal(one.ranges["cf1", "cf2"].range_m, same.ranges["cf1", "cf2"].range_m)
    assert not np.array_equal(one.robots["cf2"].vx_mps, other.robots["cf2"].vx_mps)


def test_adding_robots_does_not_change_the_others() -> None:
    two, six = (
        simulate(replace(SHORT, robots=n, trajectory="random"), NOISE["harsh"], 1) for n in (2, 6)
    )
    assert np.array_equal(two.truth["cf2"].position, six.truth["cf2"].position)
    assert np.array_equal(two.robots["cf2"].height_m, six.robots["cf2"].height_m)
    assert np.array_equal(two.ranges["cf2", "cf1"].range_m, six.ranges["cf2", "cf1"].range_m)


@pytest.mark.heavy
def test_random_robots_start_apart() -> None:
    truth = simulate(replace(SHORT, robots=20, trajectory="random"), IDEAL, 1).truth
    starts = np.array([t.position[0, :2] for t in truth.values()])
    apart = np.linalg.norm(starts[:, None] - starts[None], axis=2) + 99 * np.eye(20)
    assert apart.min() > 0.7


def test_clock_time_and_true_time_round_trip() -> None:
    clock = Clock(0.03, 2e-5)
    time_s = np.linspace(0, 100, 7)
    assert np.allclose(clock.to_true_time(clock.to_clock_time(time_s)), time_s)
    assert clock.to_clock_time(np.array([100.0]))[0] == pytest.approx(100.032)


def test_first_robot_has_the_true_clock_and_others_offsets() -> None:
    flight = simulate(replace(SHORT, robots=4), NOISE["harsh"], 1)
    assert flight.clocks["cf1"] == Clock()
    for robot, log in flight.robots.items():
        assert np.allclose(
            log.time_s, flight.clocks[robot].to_clock_time(flight.truth[robot].time_s)
        )
    offsets = {clock.offset_s for clock in flight.clocks.values()}
    assert len(offsets) == 4
    assert max(map(abs, offsets)) <= 0.04


@pytest.mark.parametrize(
    ("scenario", "why"),
    [
        (Scenario(robots=1), "Choose 2 to 20"),
        (Scenario(robots=21), "Choose 2 to 20"),
        (Scenario(duration_s=0.5), "Choose 1 to 3600"),
        (Scenario(trajectory="loop"), "There are: in_view"),  # type: ignore[arg-type]
    ],
)
def test_scenarios_that_cannot_be_flown_are_refused(scenario: Scenario, why: str) -> None:
    with pytest.raises(SettingError, match=why):
        simulate(scenario, IDEAL, 0)
