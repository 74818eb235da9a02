"""Table of the unknowns of a flight: the one place where an error of a sensor is declared.

A row contains the name, unit and prior of an unknown, its owner, its evolution over time, and its
effect on each measurement. Layout, priors, Jacobians, sensor files and reports derive from it. A
new unknown is one row with one effect.

A measurement is predicted as (1 + sum a u) z + sum b u, with z the value without errors and u the
unknowns. An effect returns a or b. ``Steps``, ``RangeLink`` and ``CameraView`` are the measured
data that an effect can use; see `keyframes`.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.robust_loss import Cauchy, Gaussian, Loss

if TYPE_CHECKING:
    from dmrl.estimation.solver.keyframes import CameraView, RangeLink, Steps

Owner = Literal["robot", "clock", "antenna", "pair", "flight"]
"""Owner of an unknown. A clock: every robot but the first, whose clock counts. An antenna or a
camera is one per robot."""
Evolution = Literal["constant", "walk", "jump", "fading"]
"""constant: one value a flight. walk: Gaussian steps. jump: steps with the row's loss. fading: an
Ornstein-Uhlenbeck process."""


@dataclass(frozen=True, slots=True)
class Unknown:
    """One row of the table.

    Parameters
    ----------
    name, unit
        Name and SI unit.
    std
        Standard deviation: of a constant, of a fading value, or of the step of a walk or jump in
        one second.
    owner
        Owner of each value.
    loss
        Loss of the prior of a constant, or of each step.
    evolution, time_s
        Evolution over time, and the correlation time of a fading value.
    graded
        Whether the standard deviation is proportional to the noise grade of the flight.
    key
        Name in the sensor file of ``dmrl calibrate --sensors``; empty: not in the file.
    negated
        Whether the value changes its sign when the other robot is the observer.
    motion
        Effect on the measured motion: additive (S, 3), x and y in metres and turn in radians.
    motion_scale
        Scale effect on the measured shift: (2,) factors of x and y.
    range, range_scale
        Additive (R,) and scale (scalar) effect on a range.
    height
        Sign of the effect on a robot's measured height, metres.
    bearing
        Additive (3,) effect on azimuth, elevation and log distance of a detection.
    start_std
        Standard deviation of the first value of a walk or jump.
    pull_std, pull_weight
        Weak Cauchy pull of every value to zero: scale and weight. It is no density.
    """

    name: str
    unit: str
    std: float
    owner: Owner
    loss: Loss = field(default_factory=Gaussian)
    evolution: Evolution = "constant"
    time_s: float = np.inf
    graded: bool = False
    key: str = ""
    negated: bool = False
    motion: "Callable[[Steps], Array] | None" = None
    motion_scale: tuple[float, float] | None = None
    range: "Callable[[RangeLink, Array], Array] | None" = None
    range_scale: float = 0.0
    height: float = 0.0
    bearing: "Callable[[CameraView], Array] | None" = None
    start_std: float = 1.0
    pull_std: float = 1.0
    pull_weight: float = 0.0

    @property
    def is_constant(self) -> bool:
        """Whether the unknown has one value a flight."""
        return self.evolution == "constant"

    def step_model(self, steps_s: Array) -> tuple[Array, Array]:
        """Return (S,) kept shares and standard deviations of the steps between keyframes."""
        if self.evolution == "fading":
            kept = np.exp(-steps_s / self.time_s)
            return kept, self.std * np.sqrt(1 - kept**2)
        return np.ones(len(steps_s)), self.std * np.sqrt(steps_s)


def _shift_along(steps: "Steps", axis: int) -> Array:
    """Return the effect of a velocity error along one axis of the robot, metres per m/s."""
    shift = steps.motion.bias_jacobian_s[:, :, axis]
    return np.column_stack([shift, np.zeros(len(shift))])


def _along_x(steps: "Steps") -> Array:
    """Return the effect of a forward velocity error."""
    return _shift_along(steps, 0)


def _along_y(steps: "Steps") -> Array:
    """Return the effect of a velocity error to the left."""
    return _shift_along(steps, 1)


def _turn(steps: "Steps") -> Array:
    """Return the effect of a yaw rate bias."""
    none = np.zeros(len(steps.steps_s))
    return np.column_stack([none, none, steps.steps_s])


def _later(steps: "Steps") -> Array:
    """Return the effect of a clock that stamps late: the motion shown is that of before."""
    return -steps.clock_derivative


def _longer(_link: "RangeLink", distance: Array) -> Array:
    """Return the effect of an excess of the ranges."""
    return np.ones_like(distance)


def _aside(_view: "CameraView") -> Array:
    """Return the effect of an azimuth error of a camera."""
    return np.array([1.0, 0.0, 0.0])


def _upwards(_view: "CameraView") -> Array:
    """Return the effect of an elevation error of a camera."""
    return np.array([0.0, 1.0, 0.0])


def _farther(_view: "CameraView") -> Array:
    """Return the effect of an error of a network's log distances."""
    return np.array([0.0, 0.0, 1.0])


TABLE: tuple[Unknown, ...] = (
    Unknown(
        "range_offset",
        "m",
        0.15,
        "pair",
        Cauchy(1.5),
        graded=True,
        key="range_offset_m",
        range=_longer,
    ),
    Unknown("range_scale", "1", 0.02, "pair", graded=True, key="range_scale", range_scale=1.0),
    Unknown(
        "gyro_bias", "rad/s", 0.003, "robot", Cauchy(2.0), key="yaw_rate_bias_radps", motion=_turn
    ),
    Unknown(
        "velocity_scale",
        "1",
        0.05,
        "robot",
        graded=True,
        key="velocity_scale",
        motion_scale=(1.0, 1.0),
    ),
    Unknown("vx_bias", "m/s", 0.02, "robot", key="vx_bias_mps", motion=_along_x),
    Unknown("vy_bias", "m/s", 0.02, "robot", key="vy_bias_mps", motion=_along_y),
    Unknown(
        "clock",
        "s",
        0.02,
        "clock",
        Cauchy(2.0),
        negated=True,
        motion=_later,
    ),
    Unknown("height_offset", "m", 0.03, "robot", height=1.0),
    Unknown(
        "velocity_error_x",
        "m/s",
        0.08,
        "robot",
        Cauchy(5.0),
        "fading",
        0.3,
        graded=True,
        motion=_along_x,
    ),
    Unknown(
        "velocity_error_y",
        "m/s",
        0.08,
        "robot",
        Cauchy(5.0),
        "fading",
        0.3,
        graded=True,
        motion=_along_y,
    ),
    Unknown(
        "range_error",
        "m",
        0.002,
        "pair",
        Cauchy(1.0),
        "jump",
        range=_longer,
        start_std=0.02,
        pull_std=0.05,
        pull_weight=0.04,
    ),
    Unknown("height_error", "m", 0.03, "robot", evolution="fading", time_s=4.0, height=1.0),
    Unknown("camera_azimuth", "rad", 0.1, "antenna", bearing=_aside),
    Unknown("camera_elevation", "rad", 0.1, "antenna", bearing=_upwards),
    Unknown("camera_distance", "1", 0.3, "antenna", bearing=_farther),
)
"""The unknowns of a flight.

Standard deviations are those of sensors that nobody calibrated: the constants of UWB modules and of
optical flow on small drones (docs/flights.md, preset "realistic", rounded up). Losses: an offset, a
gyroscope or a clock is mostly good and sometimes far off, so their priors have Cauchy tails at 1.5
to 2 sigmas. A scale keeps a Gaussian prior: otherwise it could shrink the path to nothing."""

RANGE_MODELS: dict[str, Unknown] = {
    "jump": next(row for row in TABLE if row.name == "range_error"),
    "fading": Unknown(
        "range_error",
        "m",
        0.1,
        "pair",
        Cauchy(5.0),
        "fading",
        1.0,
        range=_longer,
    ),
}
"""Models of the temporary excess of ranges: jumps behind an obstacle, or reflections that fade in a
second. Each is one row; `noise.select_model` compares their evidence."""

SIGHTED = ("height_error", "camera_azimuth", "camera_elevation", "camera_distance")
"""Unknowns that only detections determine."""


def with_rows(table: tuple[Unknown, ...], *rows: Unknown) -> tuple[Unknown, ...]:
    """Return the table with rows replaced by name, or added."""
    new = {row.name: row for row in rows}
    kept = tuple(new.pop(row.name, row) for row in table)
    return (*kept, *new.values())


def without_rows(table: tuple[Unknown, ...], names: Collection[str]) -> tuple[Unknown, ...]:
    """Return the table without the rows of some names."""
    return tuple(row for row in table if row.name not in names)


Subject = tuple[str, tuple[int, ...]]
"""Name of an unknown, and the indices of its robots."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Columns of a flight's unknowns, derived from a table.

    Parameters
    ----------
    robots
        Number of robots N. A keyframe begins with x, y, theta of each.
    states, constants
        Subject and row of every further column of a keyframe, and of every constant.
    """

    robots: int
    states: tuple[tuple[Subject, Unknown], ...]
    constants: tuple[tuple[Subject, Unknown], ...]

    @property
    def width(self) -> int:
        """Number of columns of a keyframe."""
        return 3 * self.robots + len(self.states)

    def pose(self, robot: int) -> list[int]:
        """Return the columns of a robot's pose."""
        return [3 * robot, 3 * robot + 1, 3 * robot + 2]

    def find(self, name: str, *robots: int) -> int:
        """Return the index of a constant.

        Raises
        ------
        KeyError
            If the flight has no such constant.
        """
        return {subject: k for k, (subject, _) in enumerate(self.constants)}[name, robots]

    def state_column(self, name: str, *robots: int) -> int | None:
        """Return the column of a state; None if the flight has none."""
        for k, (subject, _) in enumerate(self.states):
            if subject == (name, robots):
                return 3 * self.robots + k
        return None

    def of(self, *robots: int) -> Iterator[tuple[Unknown, int, bool]]:
        """Yield row, column and whether it is a constant, of the unknowns that robots own."""
        for k, ((_, own), row) in enumerate(self.states):
            if own in (robots, ()):
                yield row, 3 * self.robots + k, False
        for k, ((_, own), row) in enumerate(self.constants):
            if own in (robots, ()):
                yield row, k, True

    def measured(
        self, both: tuple[int, int], kind: Literal["range", "bearing", "height"]
    ) -> list[tuple[Unknown, int, bool, float]]:
        """Return the unknowns of a measurement between two robots.

        Parameters
        ----------
        both
            Observer and peer.
        kind
            Kind of the measurement. Ranges and bearings depend on heights too.

        Returns
        -------
        list
            Row, column, whether it is a constant, and the sign of its effect on the height
            difference: measured heights exceed true ones by the error.
        """
        found = []
        for owners, side in (((both[0],), 1.0), ((both[1],), -1.0), (tuple(sorted(both)), 1.0)):
            for row, column, constant in self.of(*owners):
                if row.owner == "flight" and owners != (both[0],):
                    continue
                of_range = kind == "range" and (row.range or row.range_scale)
                # A camera's own errors are those of the observer.
                of_bearing = kind == "bearing" and row.bearing and owners == (both[0],)
                if row.height or of_range or of_bearing:
                    found.append((row, column, constant, side))
        return found


def build_layout(
    table: tuple[Unknown, ...],
    robots: int,
    links: Collection[tuple[int, int]],
    sighted: Collection[int] = (),
    unused: Collection[Subject] = (),
) -> Layout:
    """Build the columns of a flight.

    Parameters
    ----------
    table
        Rows of the unknowns.
    robots
        Number of robots.
    links
        Pairs of robots with ranges.
    sighted
        Robots with detections by or of them.
    unused
        Unknowns that the flight does not need.
    """
    owners: Mapping[Owner, list[tuple[int, ...]]] = {
        "robot": [(k,) for k in range(robots)],
        "clock": [(k,) for k in range(1, robots)],
        "antenna": [(k,) for k in range(robots)],
        "pair": [tuple(link) for link in links],
        "flight": [()],
    }
    every = [
        ((row.name, own), row)
        for row in table
        for own in owners[row.owner]
        if (row.name not in SIGHTED or own[0] in sighted) and (row.name, own) not in unused
    ]
    return Layout(
        robots,
        tuple(one for one in every if not one[1].is_constant),
        tuple(one for one in every if one[1].is_constant),
    )


def from_peer(layout: Layout, values: Array) -> Array:
    """Return the constants (G,) of a pair with observer and peer exchanged."""
    out = np.empty_like(values)
    for k, ((name, own), row) in enumerate(layout.constants):
        other = own if row.owner in ("pair", "clock", "flight") else (1 - own[0],)
        out[layout.find(name, *other)] = -values[k] if row.negated else values[k]
    return out
