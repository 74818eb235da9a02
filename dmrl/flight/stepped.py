"""Simulated flights: some robots fly commands, step by step, the others their trajectory.

The arrays have the length of the whole flight from the start, and are filled up to the present.
"""

from collections.abc import Mapping, Sequence
from itertools import permutations

import numpy as np

from dmrl.errors import SettingError
from dmrl.flight import fault_effects, sensors
from dmrl.flight.faults import END_KINDS, Fault
from dmrl.flight.flight_arrays import RATE_HZ, Flight, Ranges, RobotLog, Truth
from dmrl.flight.noise import Noise
from dmrl.flight.pilot import Command
from dmrl.flight.plan import Scenario, create_rng, draw_link, plan_flight
from dmrl.flight.trajectories import GRAVITY_MPS2, VELOCITY_LAG_S, YAW_RATE_LAG_S
from dmrl.geometry.frames import Array

SPEED_MAX_MPS, CLIMB_MAX_MPS, YAW_RATE_MAX_RADPS = 1.0, 0.4, 1.5
"""Largest commands that a robot follows; larger ones are shortened."""
START_EXTRA_M = 0.1
"""Distance from the leader at the start, beyond the one to keep."""
START_HEIGHT_M = 0.1
"""A robot starts within this above or below its leader."""
START_SPREAD_RAD = np.pi / 2
"""Angle between two robots behind their leader, seen from it."""
_LAG = float(1 - np.exp(-1 / (RATE_HZ * VELOCITY_LAG_S)))
_YAW_LAG = float(1 - np.exp(-1 / (RATE_HZ * YAW_RATE_LAG_S)))


def simulate(scenario: Scenario, noise: Noise, seed: int, faults: Sequence[Fault] = ()) -> Flight:
    """Simulate a whole flight at once; robots that fly commands hover. See `SteppedFlight`."""
    return SteppedFlight(scenario, noise, seed, faults, scenario.samples).flight


class SteppedFlight:
    """A flight that goes on by steps of 10 ms. The same commands give the same flight.

    Faults change only the signals they name.

    Parameters
    ----------
    scenario
        Robots, duration and trajectory. The first ``scenario.flown`` robots fly commands.
    noise
        Errors of the sensors.
    seed
        Seed of all random draws.
    faults
        Additional faults of sensors.
    samples
        Samples before the first command, in which all hover.

    Raises
    ------
    SettingError
        If the scenario is impossible, or a fault does not fit into it.
    """

    def __init__(
        self,
        scenario: Scenario,
        noise: Noise,
        seed: int,
        faults: Sequence[Fault] = (),
        samples: int = 1,
    ) -> None:
        self.names, self.flown = scenario.names, scenario.names[: scenario.flown]
        for fault in faults:
            if fault.robot in self.flown and fault.kind in END_KINDS:
                raise SettingError(f"{fault}: a pilot flies it. Choose another robot for the fault")
        self._seed, self._plan = seed, plan_flight(scenario, noise, seed, faults)
        self.sample = -1
        """Last sample that is there."""
        self.samples = scenario.samples
        count = range(scenario.robots)
        self._noise = noise
        self._errors: dict[int, sensors.LogErrors] = {}
        self._links = {
            (self.names[i], self.names[j]): draw_link(i, j, scenario, noise, seed)
            for i, j in permutations(count, 2)
        }
        self._ranged = dict.fromkeys(self._links, 0)
        self._flyers = {
            name: _Flyer(self._plan.truth[name], *_place(self._plan.truth, k, scenario, seed))
            for k, name in enumerate(self.flown)
        }
        for name, flyer in self._flyers.items():
            self._plan.truth[name], self._plan.yaw_rate[name] = flyer.truth, flyer.yaw_rate
        # A first step over the whole flight makes the logs.
        names = self.names if samples < self.samples else ()
        logs = {name: RobotLog(*np.full((7, self.samples), np.nan)) for name in names}
        self.flight = Flight(logs, self._plan.truth, {}, self._plan.clocks, self._plan.events)
        """Logs and truth up to the present; the ranges of the last step only."""
        self.advance({}, samples)

    @property
    def time_s(self) -> float:
        """True time of the last sample, seconds."""
        return self.sample / RATE_HZ

    def advance(self, commands: Mapping[str, Command], steps: int = 1) -> None:
        """Fly commands for some steps, not beyond the end, and measure with every sensor.

        Parameters
        ----------
        commands
            Command of each flown robot; without one it hovers.
        steps
            Steps of 10 ms.
        """
        first = self.sample + 1
        last = min(self.sample + steps, self.samples - 1)
        for name, flyer in self._flyers.items():
            for k in range(max(first, 1), last + 1):
                flyer.step(k, commands.get(name, Command()))
        self.sample = last
        self._measure(slice(first, last + 1))

    def _measure(self, part: slice) -> None:
        truth, clocks = self._plan.truth, self._plan.clocks
        logs: dict[str, RobotLog] = {}
        for k, name in enumerate(self.names):
            drawn, yaw_rate = self._draw_errors(k), self._plan.yaw_rate[name]
            logs[name] = sensors.measure_log(truth[name], yaw_rate, clocks[name], drawn, part)
        ranges: dict[tuple[str, str], Ranges] = {}
        for (robot, peer), errors in self._links.items():
            begin = self._ranged[robot, peer]
            end = int(np.searchsorted(errors.time_s, self.time_s, side="right"))
            self._ranged[robot, peer] = end
            ranges[robot, peer] = sensors.measure_ranges(
                truth[robot], truth[peer], clocks[robot], errors, slice(begin, end)
            )
        self._apply_faults(logs, ranges, part)
        if not self.flight.robots:
            self.flight.robots.update(logs)
        for name, log in logs.items():
            for column in RobotLog.__slots__:
                getattr(self.flight.robots[name], column)[part] = getattr(log, column)
        self.flight.ranges.clear()
        self.flight.ranges.update(ranges)

    def _draw_errors(self, number: int) -> sensors.LogErrors:
        """Return the errors of a robot's log. They are kept only while samples are to come."""
        errors = self._errors.pop(number, None)
        if errors is None:
            rng = create_rng(self._seed, "log", number)
            errors = sensors.draw_log_errors(rng, self.samples, self._noise)
        if self.sample < self.samples - 1:
            self._errors[number] = errors
        return errors

    def _apply_faults(
        self, logs: dict[str, RobotLog], ranges: dict[tuple[str, str], Ranges], part: slice
    ) -> None:
        """Apply the faults of sensors to the logs and ranges of some samples, in place."""
        for k, event in enumerate(self._plan.events):
            robot = event.fault.robot
            rng = create_rng(self._seed, "fault", k, 1, *([part.start] if part.start else []))
            time_s = self._plan.truth[robot].time_s[part]
            logs[robot] = fault_effects.apply_sensor_fault(rng, logs[robot], time_s, event)
            for link in (link for link in ranges if event.affects_link(link)):
                clock = self._plan.clocks[link[0]]
                ranges[link] = fault_effects.apply_range_fault(rng, ranges[link], clock, event)


def _place(
    truth: Mapping[str, Truth], number: int, scenario: Scenario, seed: int
) -> tuple[Array, float]:
    """Return position and yaw at the start: behind the leader, facing it, where there is one."""
    own = truth[scenario.names[number]]
    if not scenario.leader or scenario.trajectory != "figure_of_eight":
        return own.position[0], float(own.yaw[0])
    leader = truth[scenario.leader]
    vx, vy, _ = leader.velocity[0]
    aside = START_SPREAD_RAD * (number - (scenario.flown - 1) / 2)
    yaw = float(np.arctan2(vy, vx) + aside)
    back = np.array([np.cos(yaw), np.sin(yaw), 0.0]) * (scenario.distance_m + START_EXTRA_M)
    height = create_rng(seed, "start", number).uniform(-START_HEIGHT_M, START_HEIGHT_M)
    return leader.position[0] - back + np.array([0.0, 0.0, height]), yaw


class _Flyer:
    """A robot that follows commands with lag, and tilts as its acceleration needs.

    Its arrays hold one sample more than there is, where the robot would be without acceleration:
    pictures need the motion around their time.
    """

    def __init__(self, planned: Truth, start_m: Array, yaw_rad: float) -> None:
        count = len(planned.time_s)
        self.truth = Truth(
            planned.time_s,
            np.zeros((3, count)).T,
            np.zeros((count, 3)),
            np.zeros(count),
            np.zeros(count),
            np.zeros(count),
        )
        self.yaw_rate = np.zeros(count)
        x, y, self._z = start_m.tolist()
        self._xy, self._yaw = complex(x, y), yaw_rad
        self._velocity, self._climb, self._turn = 0j, 0.0, 0.0
        self._store(0, 0j, 0.0)

    def step(self, k: int, command: Command) -> None:
        """Fly a command from sample ``k - 1`` to sample ``k``."""
        vx, vy, vz, turn = command
        wanted = complex(vx, vy) * min(1.0, SPEED_MAX_MPS / max(abs(complex(vx, vy)), 1e-9))
        wanted *= np.exp(1j * self._yaw)
        vz = min(max(vz, -CLIMB_MAX_MPS), CLIMB_MAX_MPS)
        turn = min(max(turn, -YAW_RATE_MAX_RADPS), YAW_RATE_MAX_RADPS)
        velocity, climb, rate = self._velocity, self._climb, self._turn
        self._velocity += _LAG * (wanted - velocity)
        self._climb += _LAG * (vz - climb)
        self._turn += _YAW_LAG * (turn - rate)
        self._xy += (self._velocity + velocity) / (2 * RATE_HZ)
        self._z += (self._climb + climb) / (2 * RATE_HZ)
        self._yaw += (self._turn + rate) / (2 * RATE_HZ)
        self._store(k, (self._velocity - velocity) * RATE_HZ, (self._climb - climb) * RATE_HZ)

    def _store(self, k: int, acceleration: complex, lift: float) -> None:
        truth, v = self.truth, self._velocity
        pull = acceleration * np.exp(-1j * self._yaw)
        up = GRAVITY_MPS2 + lift
        truth.pitch[k] = np.arctan2(pull.real, up)
        truth.roll[k] = -np.arctan2(pull.imag, np.hypot(pull.real, up))
        truth.velocity[k] = v.real, v.imag, self._climb
        self.yaw_rate[k] = self._turn
        for ahead in range(k, min(k + 2, len(truth.yaw))):
            dt_s = (ahead - k) / RATE_HZ
            xy = self._xy + v * dt_s
            truth.position[ahead] = xy.real, xy.imag, self._z + self._climb * dt_s
            truth.yaw[ahead] = self._yaw + self._turn * dt_s
        truth.roll[k + 1 : k + 2], truth.pitch[k + 1 : k + 2] = truth.roll[k], truth.pitch[k]
