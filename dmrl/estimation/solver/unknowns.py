"""Table of the unknowns of a flight: the one place where an error of a sensor is declared.

A row contains the name, unit and prior of an unknown, its owner, its evolution over time, and its
effect on each measurement. Layout, priors, Jacobians, sensor files and reports derive from it. A
new unknown is one row with one effect.

A measurement is predicted as (1 + sum a u) z + sum b u, with z the value without errors and u the
unknowns. An effect returns a or b. ``Steps``, ``RangeLink`` and ``CameraView`` are the measured
data that an effect can use; see `problem`.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.robust_loss import Cauchy, Gaussian, Loss

if TYPE_CHECKING:
    from dmrl.estimation.solver.problem import CameraView, RangeLink, Sight, Steps

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
    range, range_power
        Additive (R,) effect on a range; or the power of the distance that the effect is, 0: none.
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
    range: "Callable[[RangeLink, Sight], Array] | None" = None
    range_power: int = 0
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


def along_x(steps: "Steps") -> Array:
    """Return the effect of a forward velocity error."""
    return _shift_along(steps, 0)


def along_y(steps: "Steps") -> Array:
    """Return the effect of a velocity error to the left."""
    return _shift_along(steps, 1)


def turn(steps: "Steps") -> Array:
    """Return the effect of a yaw rate bias."""
    none = np.zeros(len(steps.steps_s))
    return np.column_stack([none, none, steps.steps_s])


def later(steps: "Steps") -> Array:
    """Return the effect of a clock that stamps late: the motion shown is that of before."""
    return -steps.clock_derivative


def longer(_link: "RangeLink", sight: "Sight") -> Array:
    """Return the effect of an excess of the ranges."""
    return np.ones_like(sight.distance)


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
        range=longer,
    ),
    Unknown("range_scale", "1", 0.02, "pair", graded=True, key="range_scale", range_power=1),
    Unknown(
        "gyro_bias", "rad/s", 0.003, "robot", Cauchy(2.0), key="yaw_rate_bias_radps", motion=turn
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
    Unknown("vx_bias", "m/s", 0.02, "robot", key="vx_bias_mps", motion=along_x),
    Unknown("vy_bias", "m/s", 0.02, "robot", key="vy_bias_mps", motion=along_y),
    Unknown("clock", "s", 0.02, "clock", Cauchy(2.0), negated=True, motion=later),
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
        motion=along_x,
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
        motion=along_y,
    ),
    Unknown(
        "range_error",
        "m",
        0.002,
        "pair",
        Cauchy(1.0),
        "jump",
        range=longer,
        start_std=0.02,
        pull_std=0.05,
        pull_weight=0.04,
    ),
    Unknown("height_error", "m", 0.03, "robot", evolution="fading", time_s=4.0, height=1.0),
    Unknown("camera_azimuth", "rad", 0.03, "antenna", Cauchy(2.0), bearing=_aside),
    Unknown("camera_elevation", "rad", 0.1, "antenna", bearing=_upwards),
    Unknown("camera_distance", "1", 0.3, "antenna", Cauchy(2.0), bearing=_farther),
)
"""The unknowns of a flight.

Standard deviations are those of sensors that nobody calibrated: the constants of UWB modules and of
optical flow on small drones (docs/flights.md, preset "realistic", rounded up). Losses: an offset, a
gyroscope or a clock is mostly good and sometimes far off, so their priors have Cauchy tails at 1.5
to 2 sigmas. So have the azimuth of a camera, as a board that is plugged in points within two
degrees, and its distances, whose standard deviation a flight shows (`camera_noise`).
A scale keeps a Gaussian prior: otherwise it could shrink the path to nothing."""

MEASURED_CLOCK = replace(next(row for row in TABLE if row.name == "clock"), loss=Gaussian())
"""Clock of a flight whose ranges show it: it is not far off."""

YAW_RATE_ERROR = Unknown(
    "yaw_rate_error", "rad/s", 0.003, "robot", Cauchy(2.0), "jump", motion=turn, start_std=0.03
)
"""Bias of a yaw rate that changes over time, by small steps or by jumps."""

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
