"""Simulated faults have their stated effect and no other."""

from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest

from dmrl.errors import SettingError
from dmrl.flight import NOISE, Clock, Fault, Flight, RobotLog, Scenario, simulate
from dmrl.flight.faults import FaultKind

SHORT = Scenario(3, 15.0, "random")
PLAIN = simulate(SHORT, NOISE["harsh"], 5)
WINDOWS = {"range_gap": 5.0}
"""Duration of a fault whose default is too long for the flight, seconds."""
COLUMNS = [name for name in RobotLog.__slots__ if name != "time_s"]


def simulate_with(*faults: Fault) -> Flight:
    """Simulate a short flight with faults, always from the same seed."""
    return simulate(SHORT, NOISE["harsh"], 5, faults)


def find_changes(flight: Flight) -> dict[str, np.ndarray]:
    """Return by signal the true times, seconds, at which it differs from the flight without it."""
    found = {}
    for robot, log in flight.robots.items():
        for name in COLUMNS:
            same = getattr(log, name) == getattr(PLAIN.robots[robot], name)
            found[f"{robot}.{name}"] = flight.truth[robot].time_s[~same]
    for (one, other), ranges in flight.ranges.items():
        before = PLAIN.ranges[one, other]
        kept = np.isin(before.time_s, ranges.time_s)
        other_value = np.ones(len(kept), bool)
        other_value[kept] = ranges.range_m != before.range_m[kept]
        found[f"{one}-{other}"] = PLAIN.clocks[one].to_true_time(before.time_s[other_value])
    return {name: times for name, times in found.items() if len(times)}


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        ("nlos", {"cf1-cf2", "cf2-cf1"}),
        ("range_gap", {"cf1-cf2", "cf2-cf1"}),
        ("range_offset", {"cf1-cf2", "cf2-cf1"}),
        ("range_outliers", {"cf1-cf2", "cf2-cf1"}),
        ("yaw_rate_bias", {"cf1.yaw_rate_radps"}),
        ("height_step", {"cf1.height_m"}),
        ("height_gap", {"cf1.height_m"}),
        ("velocity_stuck", {"cf1.vx_mps", "cf1.vy_mps"}),
        ("velocity_scale", {"cf1.vx_mps", "cf1.vy_mps"}),
        ("velocity_gap", {"cf1.vx_mps", "cf1.vy_mps"}),
        ("attitude_gap", {"cf1.roll_rad", "cf1.pitch_rad", "cf1.yaw_rate_radps"}),
    ],
)
def test_a_fault_changes_its_own_sensor_in_its_window_alone(
    kind: FaultKind, names: set[str]
) -> None:
    peer = "cf2" if "cf1-cf2" in names else ""
    found = find_changes(simulate_with(Fault(kind, "cf1", peer, start_s=6.0, duration_s=4.0)))
    assert set(found) == names
    for times in found.values():
        assert times.min() >= 6.0 - 1e-9 and times.max() < 10.0 + 1e-9
        assert np.ptp(times) > 3.0


@pytest.mark.parametrize(
    ("fault", "column", "added"),
    [
        (Fault("yaw_rate_bias", "cf2", size=0.07), "yaw_rate_radps", 0.07),
        (Fault("height_step", "cf2", size=-0.4, duration_s=15.0), "height_m", -0.4),
    ],
)
def test_additive_fault_has_its_size(fault: Fault, column: str, added: float) -> None:
    log, before = (f.robots["cf2"] for f in (simulate_with(fault), PLAIN))
    assert np.allclose(getattr(log, column) - getattr(before, column), added)


def test_gap_faults_give_nan_and_stuck_faults_zero() -> None:
    stuck = (
        simulate_with(Fault("velocity_stuck", "cf1", start_s=5.0)).robots["cf1"].vx_mps[500:1500]
    )
    silent = simulate_with(Fault("velocity_gap", "cf1", start_s=5.0)).robots["cf1"].vx_mps[500:1000]
    assert not stuck.any() and np.isnan(silent).all()
    scaled = simulate_with(Fault("velocity_scale", "cf1", size=0.2)).robots["cf1"].vx_mps
    assert np.allclose(scaled, 1.2 * PLAIN.robots["cf1"].vx_mps)


def test_ranges_are_longer_by_the_size_and_outliers_are_a_share() -> None:
    before = PLAIN.ranges["cf2", "cf1"].range_m
    longer = (
        simulate_with(Fault("range_offset", "cf1", "cf2", size=0.5)).ranges["cf2", "cf1"].range_m
    )
    assert np.allclose(longer - before, 0.5)
    off = (
        simulate_with(Fault("range_outliers", "cf1", "cf2", size=0.3)).ranges["cf2", "cf1"].range_m
    )
    assert (off != before).mean() == pytest.approx(0.3, abs=0.05)
    assert (off - before).max() <= 3.0 and off.min() >= 0.01


def test_range_fault_without_peer_affects_all_links_of_the_robot() -> None:
    assert set(find_changes(simulate_with(Fault("nlos", "cf2")))) == {
        "cf1-cf2",
        "cf2-cf1",
        "cf2-cf3",
        "cf3-cf2",
    }


def test_fault_windows_are_spread_evenly_over_the_flight() -> None:
    (event,) = simulate_with(Fault("nlos", "cf1", duration_s=2.0, number=5)).faults
    start, end = event.windows_s.T
    assert np.allclose(end - start, 2.0)
    assert np.array_equal((start // 3).astype(int), np.arange(5))
    assert (end <= 3.0 * np.arange(1, 6)).all()


def test_clock_fault_changes_times_only() -> None:
    wrong = Fault("clock_drift", "cf2", size=200.0), Fault("clock_offset", "cf2", size=0.1)
    flight = simulate_with(*wrong)
    clock, before = flight.clocks["cf2"], PLAIN.clocks["cf2"]
    assert clock == Clock(before.offset_s + 0.1, before.drift + 2e-4)
    assert np.allclose(flight.robots["cf2"].time_s, clock.to_clock_time(flight.truth["cf2"].time_s))
    true_s = clock.to_true_time(flight.ranges["cf2", "cf1"].time_s)
    assert np.allclose(true_s, before.to_true_time(PLAIN.ranges["cf2", "cf1"].time_s))
    assert not find_changes(replace(flight, ranges=PLAIN.ranges))


@pytest.mark.parametrize("kind", ["landing", "crash"])
def test_crashed_robot_falls_and_stays_on_the_floor(kind: FaultKind) -> None:
    flight = simulate_with(Fault(kind, "cf3", start_s=8.0))
    truth, before = flight.truth["cf3"], PLAIN.truth["cf3"]
    assert np.array_equal(truth.position[:800], before.position[:800])
    assert truth.position[-1, 2] == pytest.approx(0.02)
    assert np.ptp(truth.position[-200:], axis=0).max() < 1e-6
    slope = np.diff(truth.position[:, :2], axis=0) * 100
    assert np.abs(slope - (truth.velocity[1:, :2] + truth.velocity[:-1, :2]) / 2).max() < 0.03
    assert np.abs(truth.pitch).max() < np.pi / 2
    assert np.array_equal(flight.robots["cf1"].vx_mps, PLAIN.robots["cf1"].vx_mps)
    away = flight.truth["cf1"].position_at(np.array([14.0])) - truth.position_at(np.array([14.0]))
    last = flight.ranges["cf1", "cf3"]
    at = flight.clocks["cf1"].to_true_time(last.time_s) > 13.0
    assert np.median(last.range_m[at]) == pytest.approx(np.linalg.norm(away), abs=0.8)


def test_velocity_estimate_of_a_crashed_robot_diverges() -> None:
    log = simulate_with(Fault("crash", "cf1", start_s=5.0, size=9.0)).robots["cf1"]
    assert np.hypot(log.vx_mps[-50:], log.vy_mps[-50:]).mean() == pytest.approx(8.9, abs=0.4)
    assert np.array_equal(log.vx_mps[:500], PLAIN.robots["cf1"].vx_mps[:500])


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"kind": "nlos", "duration_s": -1.0}, "must last over 0 s"),
        ({"kind": "nlos", "start_s": -1.0}, "before 0 s"),
        ({"kind": "nlos", "number": 0}, "once or more"),
        ({"kind": "nlos", "number": 2, "start_s": 3.0}, "not both"),
        ({"kind": "nlos", "size": float("nan")}, "finite"),
        ({"kind": "yaw_rate_bias", "number": 2}, "give duration_s"),
        ({"kind": "yaw_rate_bias", "peer": "cf2"}, "has no peer"),
        ({"kind": "range_gap", "size": 1.0}, "has no size"),
        ({"kind": "range_outliers", "size": 1.5}, "(0, 1]"),
        ({"kind": "crash", "duration_s": 1.0}, "lasts to the end"),
        ({"kind": "landing", "number": 2}, "give duration_s"),
        ({"kind": "clock_drift", "start_s": 1.0}, "whole flight"),
    ],
)
def test_inconsistent_faults_are_refused(given: dict[str, Any], why: str) -> None:
    with pytest.raises(ValueError) as caught:
        Fault(robot="cf1", **given)
    assert why in str(caught.value)


@pytest.mark.parametrize(
    ("fault", "why"),
    [
        (Fault("nlos", "cf9"), "choose one of cf1, cf2, cf3"),
        (Fault("nlos", "cf1", "cf9"), "choose one of cf1, cf2, cf3"),
        (Fault("nlos", "cf1", "cf1"), "another robot"),
        (Fault("nlos", "cf1", start_s=15.0), "Start it earlier"),
        (Fault("nlos", "cf1", number=20), "fewer or shorter"),
    ],
)
def test_faults_that_do_not_fit_the_flight_are_refused(fault: Fault, why: str) -> None:
    with pytest.raises(SettingError, match=why):
        simulate_with(fault)


@pytest.mark.parametrize("kind", get_args(FaultKind))
def test_every_fault_kind_has_an_effect_and_is_reproducible(kind: FaultKind) -> None:
    one, same = (simulate_with(Fault(kind, "cf2", duration_s=WINDOWS.get(kind))) for _ in range(2))
    assert one.clocks != PLAIN.clocks or find_changes(one)
    for name in COLUMNS:
        assert np.array_equal(
            getattr(one.robots["cf2"], name), getattr(same.robots["cf2"], name), equal_nan=True
        )
