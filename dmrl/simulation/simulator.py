"""Robots that fly commands step by step, with their sensors, and images on request."""

from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from numbers import Integral
from typing import TYPE_CHECKING, Self, get_args

import numpy as np

from dmrl.errors import SettingError
from dmrl.flight import NOISE, Fault, Scenario, Trajectory
from dmrl.flight.dead_reckoning import DeadReckoning
from dmrl.flight.pilot import Command, Observation
from dmrl.flight.stepped import SteppedFlight
from dmrl.geometry.frames import AIDECK_PINHOLE, Array
from dmrl.rendering.onboard_camera import CameraView, SketchedPlace, ViewRenderer, build_view
from dmrl.rendering.shot import Shot
from dmrl.rendering.sketch_renderer import Sketch
from dmrl.samples.flight import RobotPose
from dmrl.simulation.flight_samples import body_at
from dmrl.simulation.settings import CameraRenderer, Preset
from dmrl.terminal.progress import say

if TYPE_CHECKING:
    from dmrl.rendering.renderer import Renderer

STEPS_PER_COMMAND = 5
"""Steps of 10 ms for which a command holds."""


class Simulation:
    """Simulation of a few robots. The same seed and commands give the same numbers.

    `reset` starts a flight, `step` flies 0.05 s of it. Both return what every flown robot measures.

    Parameters
    ----------
    robots
        2 to 20, named cf1, cf2, ...
    flown
        The first robots, so many, fly commands; the others their trajectory. None: all.
    trajectory
        Trajectory of the others. On a figure of eight, the flown robots start behind the first one
        of them and face it.
    distance_m
        Distance of that start, less 0.1 m.
    duration_s
        Longest flight, seconds.
    noise
        How wrong the sensors are.
    camera_renderer
        sketch: drawn by code. blender: rendered in one place for each flight.
    faults
        Additional faults of sensors.

    Raises
    ------
    SettingError
        If a parameter is out of range.

    Examples
    --------
    >>> with Simulation(robots=2, flown=1) as simulation:
    ...     seen = simulation.reset(seed=1)
    ...     while not simulation.is_over:
    ...         seen = simulation.step({"cf1": (0.2, 0.0, 0.0, 0.1)})
    ...     image = simulation.render("cf1").rgb
    >>> image.shape
    (224, 320, 3)
    """

    def __init__(
        self,
        robots: int = 2,
        *,
        flown: int | None = None,
        trajectory: Trajectory = "figure_of_eight",
        distance_m: float = 0.7,
        duration_s: float = 30.0,
        noise: Preset = "realistic",
        camera_renderer: CameraRenderer = "sketch",
        faults: Sequence[Fault] = (),
    ) -> None:
        count = robots if flown is None else flown
        self._scenario = Scenario(
            robots, duration_s, trajectory, flown=count, distance_m=distance_m
        )
        _require("noise", noise, NOISE)
        _require("camera_renderer", camera_renderer, get_args(CameraRenderer))
        self._noise, self._faults, self._kind = NOISE[noise], tuple(faults), camera_renderer
        self._resources = ExitStack()
        self._renderer: Renderer | None = None
        self._draw: ViewRenderer = SketchedPlace(0)
        self._place = 0
        self._motion: SteppedFlight | None = None
        self.reckoning: dict[str, DeadReckoning] = {}
        """Dead reckoning of every robot, from its own sensors."""

    def reset(self, seed: int = 0, place: int | None = None) -> dict[str, Observation]:
        """Start a flight; return what every flown robot measures.

        Parameters
        ----------
        seed
            Another seed gives another flight: path, noise, and appearance.
        place
            Number of the room and of the cameras. None: the seed.

        Raises
        ------
        SettingError
            If one is not a whole number, 0 or more.
        """
        for name, number in (("seed", seed), ("place", seed if place is None else place)):
            if not isinstance(number, Integral) or number < 0:
                raise SettingError(f"{name} = {number!r}. Give a whole number, 0 or more")
        self._place = seed if place is None else place
        self._draw = SketchedPlace(self._place)
        self._motion = SteppedFlight(self._scenario, self._noise, seed, self._faults)
        logs = self._motion.flight.robots
        self.reckoning = {robot: DeadReckoning(log) for robot, log in logs.items()}
        self._range_m: dict[str, dict[str, float]] = {robot: {} for robot in logs}
        if self._renderer is not None:
            self.start_blender()
        self._measure(0)
        return self._observe()

    def step(self, commands: Mapping[str, Command | Sequence[float]]) -> dict[str, Observation]:
        """Fly commands for 0.05 s; return what every flown robot measures.

        Parameters
        ----------
        commands
            By name of the robot: velocity x, y and z, metres per second, and yaw rate, radians per
            second, in the robot's horizontal frame. A robot without a command hovers.

        Raises
        ------
        SettingError
            If a command is for no flown robot, or is not four finite numbers.
        """
        checked = {robot: self._check(robot, command) for robot, command in commands.items()}
        self.advance(checked, STEPS_PER_COMMAND)
        return self._observe()

    def advance(self, commands: Mapping[str, Command], steps: int) -> None:
        """Fly commands for some steps of 10 ms, not beyond the end."""
        first = self.motion.sample + 1
        self.motion.advance(commands, steps)
        self._measure(first)

    @property
    def motion(self) -> SteppedFlight:
        """The flight: true motion and logs.

        Raises
        ------
        SettingError
            If no flight was started.
        """
        if self._motion is None:
            raise SettingError("no flight was started. Call reset(seed) first")
        return self._motion

    @property
    def time_s(self) -> float:
        """Seconds since the start."""
        return self.motion.time_s

    @property
    def is_over(self) -> bool:
        """Whether the flight has reached its end."""
        return self.motion.sample >= self.motion.samples - 1

    def peer_position(self, robot: str, peer: str) -> Array:
        """Return the (3,) true position of a peer in a robot's horizontal frame, metres."""
        for name in (robot, peer):
            _require("robot", name, self.motion.names)
        found = self.motion.flight.peer_in_horizontal(robot, peer, np.array([self.time_s]))
        return np.asarray(found[0])

    def view(self, robot: str) -> CameraView:
        """Return the true poses of all peers in front of a robot's camera."""
        _require("robot", robot, self.motion.names)

        def bodies(moment_s: float) -> dict[str, RobotPose]:
            truth = self.motion.flight.truth
            return {name: body_at(one, moment_s) for name, one in truth.items()}

        number = self.motion.names.index(robot)
        return build_view(bodies, robot, self.time_s, (self._place, number, self.motion.sample))

    def render(self, robot: str) -> Sketch | Shot:
        """Render the present image of a robot's camera, with the true labels.

        Raises
        ------
        BlenderError
            If Blender is wanted and cannot be set up, or does not start.
        """
        return self.draw(self.view(robot))

    def draw(self, view: CameraView) -> Sketch | Shot:
        """Render a view; see `render`."""
        if self._kind == "blender" and self._renderer is None:
            self.start_blender()
        return next(self._draw(AIDECK_PINHOLE, [view]))

    def start_blender(self) -> None:
        """Start Blender, if it does not run, in the place of this flight.

        Raises
        ------
        BlenderError
            If it cannot be set up, or does not start.
        """
        # Blender's rooms are loaded for its images only.
        from dmrl.rendering.blender_environment import ensure_environment  # noqa: PLC0415
        from dmrl.rendering.flight_images import FlightRenderer  # noqa: PLC0415
        from dmrl.rendering.renderer import Renderer, RobotModel  # noqa: PLC0415

        if self._renderer is None:
            self._renderer = self._resources.enter_context(
                Renderer(ensure_environment(say), RobotModel(), workers=1)
            )
        self._draw = FlightRenderer(self._renderer, self._place)

    @property
    def blender_version(self) -> str:
        """Version of Blender; empty while it has not started."""
        return self._renderer.version if self._renderer is not None else ""

    def close(self) -> None:
        """Stop Blender, if it runs."""
        self._resources.close()
        self._renderer = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check(self, robot: str, command: Command | Sequence[float]) -> Command:
        if robot not in self.motion.flown:
            raise SettingError(f"{robot} flies no commands. Flown are: {self.motion.flown}")
        return check_command(robot, command)

    def _measure(self, first: int) -> None:
        """Integrate the new samples, and keep the last range of every pair."""
        part = slice(first, self.motion.sample + 1)
        if part.stop > part.start:
            for reckoning in self.reckoning.values():
                reckoning.extend(part)
        for (robot, peer), ranges in self.motion.flight.ranges.items():
            if len(ranges.range_m):
                self._range_m[robot][peer] = float(ranges.range_m[-1])

    def _observe(self) -> dict[str, Observation]:
        return {robot: self.observe(robot) for robot in self.motion.flown}

    def observe(self, robot: str) -> Observation:
        """Return the present measurements of a robot; a silent sensor keeps its last value."""
        _require("robot", robot, self.motion.names)
        roll, pitch, rate, vx, vy, height = (
            self.reckoning[robot].sensors[:, self.motion.sample].tolist()
        )
        return Observation(
            self.time_s, roll, pitch, rate, np.array([vx, vy]), height, dict(self._range_m[robot])
        )


def check_command(robot: str, command: Command | Sequence[float]) -> Command:
    """Return a command for a robot as numbers.

    Raises
    ------
    SettingError
        If it is not four finite numbers.
    """
    try:
        numbers = [float(value) for value in command]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != 4 or not np.isfinite(numbers).all():
        raise SettingError(
            f"the command of {robot} is {command!r:.80}. Give vx, vy, vz in m/s and a yaw "
            "rate in rad/s"
        )
    return Command(*numbers)


def _require(what: str, name: str, known: Collection[str]) -> None:
    """Raise SettingError unless a name is known."""
    if name not in known:
        raise SettingError(f"{what} {name!r}: there is none. Choose one of {', '.join(known)}")
