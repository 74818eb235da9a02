"""Plan of a flight: motions, clocks and faults, from a scenario, a noise preset and a seed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from dmrl.errors import SettingError
from dmrl.flight import fault_effects, sensors, trajectories
from dmrl.flight.faults import END_KINDS, Fault, FaultEvent, check_faults, schedule_fault
from dmrl.flight.flight_arrays import RATE_HZ, Clock, Truth
from dmrl.flight.noise import Noise
from dmrl.flight.trajectories import TRAJECTORIES, Motion, Start, Trajectory
from dmrl.geometry.frames import Array

ROBOTS_MAX = 20
MEAN_HEIGHT_M = 1.0
HEIGHT_SPREAD_M = 0.25
HEIGHT_SWING_M, HEIGHT_SWING_S = 0.05, (15.0, 30.0)
"""Amplitude and range of the period of a robot's height."""
EIGHT_SWING_M, EIGHT_SWING_S = 0.15, 11.0
"""Amplitude and period of the height of a robot that flies a figure of eight."""
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
    flown
        The first robots, so many, fly commands; see `SteppedFlight`.
    distance_m
        Distance that they keep from the first robot that flies its trajectory, their leader.
    """

    robots: int = 2
    duration_s: float = 100.0
    trajectory: Trajectory = "in_view"
    yaw_spread_rad: float = float(np.pi)
    flown: int = 0
    distance_m: float = 0.7

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the robots."""
        return tuple(f"cf{k + 1}" for k in range(self.robots))

    @property
    def leader(self) -> str:
        """First robot that flies its trajectory; empty if all fly commands."""
        return "".join(self.names[self.flown : self.flown + 1])

    @property
    def samples(self) -> int:
        """Samples of the flight at 100 Hz."""
        return round(self.duration_s * RATE_HZ) + 1

    @property
    def last_s(self) -> float:
        """Time of the last sample, seconds."""
        return (self.samples - 1) / RATE_HZ


@dataclass(frozen=True, slots=True)
class FlightPlan:
    """Scripted motion, clocks and faults of a flight, by name of the robot.

    Parameters
    ----------
    truth, yaw_rate
        Ground truth, and (N,) yaw rates in radians per second.
    clocks
        Clocks, with their faults.
    events
        Faults with their times.
    """

    truth: dict[str, Truth]
    yaw_rate: dict[str, Array]
    clocks: dict[str, Clock]
    events: tuple[FaultEvent, ...]


def plan_flight(scenario: Scenario, noise: Noise, seed: int, faults: Sequence[Fault]) -> FlightPlan:
    """Plan the motion of every robot, its clock and its faults; see `SteppedFlight`."""
    _check_scenario(scenario)
    check_faults(faults, scenario.names, scenario.duration_s)
    events = tuple(
        schedule_fault(create_rng(seed, "fault", k), fault, scenario.duration_s)
        for k, fault in enumerate(faults)
    )
    plan = FlightPlan({}, {}, {}, events)
    moves = _simulate_motions(scenario, seed)
    for k, name in enumerate(scenario.names):
        mine = [event for event in events if event.fault.robot == name]
        height = _draw_height(create_rng(seed, "height", k), scenario)
        way, height = _apply_endings(moves[k], height, mine)
        plan.truth[name] = trajectories.build_truth(way, height)
        plan.yaw_rate[name] = way.yaw_rate
        clock = _draw_clock(create_rng(seed, "clock", k), k, noise)
        plan.clocks[name] = fault_effects.apply_clock_faults(clock, mine)
    return plan


def draw_link(i: int, j: int, scenario: Scenario, noise: Noise, seed: int) -> sensors.RangeErrors:
    """Draw times and errors of the ranges from robot number ``i`` to robot number ``j``."""
    pair = sensors.draw_pair_errors(create_rng(seed, "pair", min(i, j), max(i, j)), noise)
    return sensors.draw_range_errors(create_rng(seed, "range", i, j), scenario.last_s, noise, pair)


def _apply_endings(
    motion: Motion, height_m: Array, events: Sequence[FaultEvent]
) -> tuple[Motion, Array]:
    """Apply the landing or crash that ends a robot's motion."""
    for event in (event for event in events if event.fault.kind in END_KINDS):
        motion, height_m = fault_effects.land_or_crash(motion, height_m, event)
    return motion, height_m


RNG_STREAMS = ("motion", "height", "clock", "log", "range", "pair", "start", "fault")


def create_rng(seed: int, purpose: str, *numbers: int) -> Generator:
    """Return the random generator of one purpose, and of the robots with these numbers."""
    return np.random.default_rng((seed, RNG_STREAMS.index(purpose), *numbers))


def _simulate_motions(scenario: Scenario, seed: int) -> list[Motion]:
    first, others = TRAJECTORIES[scenario.trajectory]
    made: list[Motion] = []
    for k in range(scenario.robots):
        move = others if k else first
        start = _draw_start(create_rng(seed, "start", k), k, scenario)
        made.append(move(create_rng(seed, "motion", k), start, made[0] if k else None))
    return made


def _draw_start(rng: Generator, k: int, scenario: Scenario) -> Start:
    """Draw a start: the origin for the first robot; others in front of it, or on a spiral."""
    samples = scenario.samples
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
    time_s = np.arange(scenario.samples) / RATE_HZ
    base = MEAN_HEIGHT_M + rng.uniform(-HEIGHT_SPREAD_M, HEIGHT_SPREAD_M)
    swing_s, swing_m = rng.uniform(*HEIGHT_SWING_S), HEIGHT_SWING_M
    if scenario.trajectory == "figure_of_eight":
        base, swing_s, swing_m = MEAN_HEIGHT_M, EIGHT_SWING_S, EIGHT_SWING_M
    swing = 2 * np.pi * time_s / swing_s + rng.uniform(0, 2 * np.pi)
    return np.asarray(base + swing_m * np.sin(swing))


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
    if not 0 <= scenario.flown <= scenario.robots:
        raise SettingError(f"flown = {scenario.flown}: choose 0 to {scenario.robots}, the robots")
    if not 0.2 < scenario.distance_m <= 3.0:
        raise SettingError(f"--distance-m {scenario.distance_m}: choose over 0.2, to 3")
    if scenario.trajectory not in TRAJECTORIES:
        kinds = ", ".join(TRAJECTORIES)
        raise SettingError(f"no trajectory {scenario.trajectory!r}. There are: {kinds}")
