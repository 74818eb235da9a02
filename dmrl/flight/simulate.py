"""Simulation of a whole flight from a scenario, a noise preset and a seed."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.random import Generator

from dmrl.errors import SettingError
from dmrl.flight import fault_effects, sensors, trajectories
from dmrl.flight.faults import END_KINDS, Fault, FaultEvent, check_faults, schedule_fault
from dmrl.flight.flight_arrays import RATE_HZ, Clock, Flight
from dmrl.flight.noise import Noise
from dmrl.flight.trajectories import TRAJECTORIES, Motion, Start, Trajectory
from dmrl.geometry.frames import Array

ROBOTS_MAX = 20
MEAN_HEIGHT_M = 1.0
HEIGHT_SPREAD_M = 0.25
START_SPACING_M = 1.5


@dataclass(frozen=True, slots=True)
class Scenario:
    """Robots, duration and trajectory of a flight.

    Parameters
    ----------
    robots
        2 to 20, named cf1, cf2, ... cf1 leads where a trajectory has a leader.
    duration_s
        Length of the flight, seconds.
    trajectory
        One of ``TRAJECTORIES``.
    yaw_spread_rad
        Initial yaws are uniform within plus and minus this. That of the first robot is 0.
    """

    robots: int = 2
    duration_s: float = 100.0
    trajectory: Trajectory = "in_view"
    yaw_spread_rad: float = float(np.pi)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the robots."""
        return tuple(f"cf{k + 1}" for k in range(self.robots))


def simulate(scenario: Scenario, noise: Noise, seed: int, faults: Sequence[Fault] = ()) -> Flight:
    """Simulate a flight. The same arguments give the same flight.

    Parameters
    ----------
    scenario
        Robots, duration and trajectory.
    noise
        Errors of the sensors.
    seed
        Seed of all random draws.
    faults
        Additional faults. They change only the signals they name.

    Raises
    ------
    SettingError
        If the scenario is impossible, or a fault does not fit into it.
    """
    _check_scenario(scenario)
    flight_s, names = scenario.duration_s, scenario.names
    check_faults(faults, names, flight_s)
    events = [
        schedule_fault(_create_rng(seed, "fault", k), fault, flight_s)
        for k, fault in enumerate(faults)
    ]
    moves = _simulate_motions(scenario, seed)
    truth, clocks, robots = {}, {}, {}
    for k, name in enumerate(names):
        mine = [event for event in events if event.fault.robot == name]
        way, height = _apply_endings(
            moves[k], _draw_height(_create_rng(seed, "height", k), scenario), mine
        )
        truth[name] = trajectories.build_truth(way, height)
        clocks[name] = fault_effects.apply_clock_faults(
            _draw_clock(_create_rng(seed, "clock", k), k, noise), mine
        )
        robots[name] = sensors.simulate_log(
            _create_rng(seed, "log", k), truth[name], way.yaw_rate, clocks[name], noise
        )
    ranges = {
        (names[i], names[j]): sensors.simulate_ranges(
            _create_rng(seed, "range", i, j),
            truth[names[i]],
            truth[names[j]],
            clocks[names[i]],
            noise,
            sensors.draw_pair_errors(_create_rng(seed, "pair", min(i, j), max(i, j)), noise),
        )
        for i, j in permutations(range(len(names)), 2)
    }
    for k, event in enumerate(events):
        robot, rng = event.fault.robot, _create_rng(seed, "fault", k, 1)
        robots[robot] = fault_effects.apply_sensor_fault(rng, robots[robot], truth[robot], event)
        for link in (link for link in ranges if event.affects_link(link)):
            ranges[link] = fault_effects.apply_range_fault(
                rng, ranges[link], clocks[link[0]], event
            )
    return Flight(robots, truth, ranges, clocks, tuple(events))


def _apply_endings(
    motion: Motion, height_m: Array, events: Sequence[FaultEvent]
) -> tuple[Motion, Array]:
    """Apply the landing or crash that ends a robot's motion."""
    for event in (event for event in events if event.fault.kind in END_KINDS):
        motion, height_m = fault_effects.land_or_crash(motion, height_m, event)
    return motion, height_m


RNG_STREAMS = ("motion", "height", "clock", "log", "range", "pair", "start", "fault")


def _create_rng(seed: int, purpose: str, *numbers: int) -> Generator:
    return np.random.default_rng((seed, RNG_STREAMS.index(purpose), *numbers))


def _simulate_motions(scenario: Scenario, seed: int) -> list[Motion]:
    first, others = TRAJECTORIES[scenario.trajectory]
    made: list[Motion] = []
    for k in range(scenario.robots):
        move = others if k else first
        start = _draw_start(_create_rng(seed, "start", k), k, scenario)
        made.append(move(_create_rng(seed, "motion", k), start, made[0] if k else None))
    return made


def _draw_start(rng: Generator, k: int, scenario: Scenario) -> Start:
    """Draw a start: the origin for the first robot; others in front of it, or on a spiral."""
    samples = round(scenario.duration_s * RATE_HZ) + 1
    if k == 0:
        return Start(samples, 0j, 0.0)
    yaw = float(rng.uniform(-1.0, 1.0) * scenario.yaw_spread_rad)
    if scenario.trajectory in ("random", "lawn_mower"):
        # Sunflower spiral: neighbours are about one spacing apart for any number of robots.
        place = START_SPACING_M * np.sqrt(k) * np.exp(1j * (rng.uniform(-0.2, 0.2) + 2.4 * k))
        return Start(samples, complex(place), yaw)
    return Start(samples, complex(trajectories.draw_view_points(rng, 1)[0]), yaw)


def _draw_height(rng: Generator, scenario: Scenario) -> Array:
    """Draw the (N,) slowly varying height of one robot, metres."""
    time_s = np.arange(round(scenario.duration_s * RATE_HZ) + 1) / RATE_HZ
    base = MEAN_HEIGHT_M + rng.uniform(-HEIGHT_SPREAD_M, HEIGHT_SPREAD_M)
    swing = 2 * np.pi * time_s / rng.uniform(15.0, 30.0) + rng.uniform(0, 2 * np.pi)
    return np.asarray(base + 0.05 * np.sin(swing))


def _draw_clock(rng: Generator, k: int, noise: Noise) -> Clock:
    if k == 0:
        return Clock()
    offset = rng.uniform(-noise.clock_offset_s, noise.clock_offset_s)
    return Clock(float(offset), float(rng.normal(0.0, noise.clock_drift_ppm * 1e-6)))


def _check_scenario(scenario: Scenario) -> None:
    if not 2 <= scenario.robots <= ROBOTS_MAX:
        raise SettingError(
            f"{scenario.robots} robots cannot be flown. Choose 2 to {ROBOTS_MAX}: --robots"
        )
    if not 1.0 <= scenario.duration_s <= 3600.0:
        raise SettingError(f"a flight of {scenario.duration_s} s. Choose 1 to 3600: --duration-s")
    if scenario.trajectory not in TRAJECTORIES:
        kinds = ", ".join(TRAJECTORIES)
        raise SettingError(f"no trajectory {scenario.trajectory!r}. There are: {kinds}")
