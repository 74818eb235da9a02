"""Table of error models: the ways in which a sensor is wrong, a row each.

A model frees unknowns that the plain model lacks, or changes the noise of a sensor. A new model is
one row. Names begin with the signal, since `dmrl check` and `view` print them as they are.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dmrl.estimation.model.odometry import QUARTER_TURN
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.layout import Subject
from dmrl.estimation.solver.problem import Problem
from dmrl.estimation.solver.robust_loss import Cauchy
from dmrl.estimation.solver.unknowns import (
    YAW_RATE_ERROR,
    Unknown,
    along_x,
    along_y,
    later,
    longer,
    turn,
    with_rows,
)

if TYPE_CHECKING:
    from dmrl.estimation.solver.problem import RangeLink, Sight, Steps


COMMON, RARE = -4.5, -7.0
"""Prior log odds of models against the plain one: errors that most labs have met, and others."""
FOR_A_WHILE = RARE - 2 * np.log(50)
"""Prior log odds of noise in a stretch: its ends are two of the 50 windows of a flight of 100 s."""


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """One row: a way in which a sensor is wrong.

    Parameters
    ----------
    name
        Name of the cause.
    rows
        Unknowns that it adds to the table.
    range_factor, flow_factor
        Factors of the noise of ranges, and of the velocity noise of one robot.
    for_a_while
        Whether the velocity of one robot is noisier in stretches, which `noisy_stretch` finds.
    sudden
        Whether its unknown jumps, which one Gauss-Newton step does not show: it is always solved.
    log_odds
        Prior log odds against the plain model.
    """

    name: str
    rows: tuple[Unknown, ...] = ()
    range_factor: float = 1.0
    flow_factor: float = 1.0
    for_a_while: bool = False
    sudden: bool = False
    log_odds: float = RARE

    @property
    def scales_motion(self) -> bool:
        """Whether it scales measured motion, so that only a robot that moves shows it."""
        scales = (_scale_shift, _by_height)
        return any(row.motion_scale or row.motion in scales for row in self.rows)

    def owners(self, robots: int) -> tuple[int | None, ...]:
        """Return which of some robots may have the sensor; None: all ranges, or the flight."""
        every = tuple(range(robots))
        if self.flow_factor != 1.0 or self.for_a_while:
            return every
        if not self.rows:
            return (None,)
        if self.rows[0].height and robots == 2:
            return (1,)  # ranges show the difference of the heights alone
        owned = {"robot": every, "antenna": every, "clock": every[1:]}
        return owned.get(self.rows[0].owner, (None,))


@dataclass(frozen=True, slots=True)
class Candidate:
    """An error model of one robot, or of all ranges."""

    model: ErrorModel
    robot: int | None

    def apply(self, problem: Problem) -> Problem:
        """Return the flight under the model, in addition to those that it has."""
        noise, robots = problem.noise, list(problem.robots)
        if self.model.range_factor != 1.0:
            noise = replace(noise, range_std_m=noise.range_std_m * self.model.range_factor)
        if self.model.flow_factor != 1.0 and self.robot is not None:
            mine = robots[self.robot]
            robots[self.robot] = replace(mine, noise_factor=self.model.flow_factor)
        table = with_rows(problem.table, *self.model.rows)
        before = {row.name for row in problem.table}
        unused: set[Subject] = set(problem.unused)
        for row in self.model.rows:
            if self.robot is not None:
                if row.name not in before:
                    unused |= {(row.name, (k,)) for k in range(len(robots))}
                unused -= {(row.name, (self.robot,))}
        return replace(
            problem, table=table, noise=noise, robots=tuple(robots), unused=frozenset(unused)
        )


def _scale_turn(steps: "Steps") -> Array:
    """Return the effect of a scale of the yaw rate."""
    none = np.zeros(len(steps.steps_s))
    return np.column_stack([none, none, steps.motion.turn_rad])


def _turn_by_speed(steps: "Steps") -> Array:
    """Return the effect of a yaw rate that follows the forward velocity."""
    none = np.zeros(len(steps.steps_s))
    return np.column_stack([none, none, steps.motion.shift_m[:, 0]])


def _shift_only(effect: Array) -> Array:
    return np.column_stack([effect, np.zeros(len(effect))])


def _later_turn(steps: "Steps") -> Array:
    """Return the effect of a late yaw rate."""
    return np.asarray(later(steps) * [0.0, 0.0, 1.0])


def _later_flow(steps: "Steps") -> Array:
    """Return the effect of late velocities."""
    return np.asarray(later(steps) * [1.0, 1.0, 0.0])


def _scale_shift(steps: "Steps") -> Array:
    """Return the effect of a scale of the velocities that changes over time."""
    return _shift_only(steps.motion.shift_m)


def _by_height(steps: "Steps") -> Array:
    """Return the effect of a flow scale that follows the height."""
    above = steps.height_m - np.median(steps.height_m)
    return _shift_only(steps.motion.shift_m * ((above[1:] + above[:-1]) / 2)[:, None])


def _askew(steps: "Steps") -> Array:
    """Return the effect of a flow sensor that is turned about the vertical."""
    return _shift_only(steps.motion.shift_m @ QUARTER_TURN.T)


def _lever_x(steps: "Steps") -> Array:
    """Return the effect of a flow sensor ahead of the axis of rotation."""
    turned = steps.motion.turn_rad
    return _shift_only(np.column_stack([np.zeros_like(turned), turned]))


def _lever_y(steps: "Steps") -> Array:
    """Return the effect of a flow sensor to the left of the axis of rotation."""
    turned = steps.motion.turn_rad
    return _shift_only(np.column_stack([-turned, np.zeros_like(turned)]))


def _one_direction(_link: "RangeLink", sight: "Sight") -> Array:
    """Return the effect of an offset of the ranges of the first robot, less the second's."""
    return sight.sent - 0.5


def _of_first(_link: "RangeLink", sight: "Sight") -> Array:
    """Return the effect of an excess of the ranges of the first robot."""
    return sight.sent


def _of_second(_link: "RangeLink", sight: "Sight") -> Array:
    """Return the effect of an excess of the ranges of the second robot."""
    return 1.0 - sight.sent


def _earlier(link: "RangeLink", sight: "Sight") -> Array:
    """Return the effect of late ranges: the distance shown is that of before."""
    time_s, half_s = link.time_s, 0.1
    if not len(time_s):
        return np.zeros(0)
    before, after = np.maximum(time_s - half_s, time_s[0]), np.minimum(time_s + half_s, time_s[-1])
    gained = np.interp(after, time_s, sight.distance) - np.interp(before, time_s, sight.distance)
    return np.asarray(-gained / np.maximum(after - before, half_s))


def _harmonic(order: int, phase_rad: float) -> "Callable[[RangeLink, Sight], Array]":
    """Return the effect of a harmonic of the antenna pattern over the bearing."""

    def effect(_link: "RangeLink", sight: "Sight") -> Array:
        return np.asarray(sight.sent * np.cos(order * sight.bearing - phase_rad))

    return effect


def _constant(name: str, unit: str, std: float, **effect: Any) -> Unknown:
    return Unknown(name, unit, std, "robot", **effect)


def _changing(name: str, unit: str, std: float, start: float, **effect: Any) -> Unknown:
    """Return an unknown that walks, with steps that may be large."""
    return Unknown(name, unit, std, "robot", Cauchy(2.0), "jump", start_std=start, **effect)


MODELS: tuple[ErrorModel, ...] = (
    ErrorModel(
        "yaw rate bias",
        (_constant("yaw_rate_offset", "rad/s", 0.05, motion=turn),),
        log_odds=COMMON,
    ),
    ErrorModel("yaw rate bias changes", (YAW_RATE_ERROR,), log_odds=COMMON),
    ErrorModel("yaw rate scale", (_constant("yaw_rate_scale", "1", 0.1, motion=_scale_turn),)),
    ErrorModel(
        "yaw rate follows the speed",
        (_constant("yaw_rate_by_speed", "rad/m", 0.1, motion=_turn_by_speed),),
    ),
    ErrorModel("yaw rate late", (_constant("yaw_rate_delay", "s", 0.2, motion=_later_turn),)),
    ErrorModel(
        "flow scale",
        (
            _constant("flow_scale_x", "1", 0.15, motion_scale=(1.0, 0.0)),
            _constant("flow_scale_y", "1", 0.15, motion_scale=(0.0, 1.0)),
        ),
        log_odds=COMMON,
    ),
    ErrorModel(
        "flow scale of both robots",
        (Unknown("flow_scale_common", "1", 0.15, "flight", motion_scale=(1.0, 1.0)),),
        log_odds=COMMON,
    ),
    ErrorModel(
        "flow scale changes", (_changing("flow_scale_error", "1", 0.02, 0.1, motion=_scale_shift),)
    ),
    ErrorModel(
        "flow scale follows height",
        (_constant("flow_scale_by_height", "1/m", 0.5, motion=_by_height),),
    ),
    ErrorModel(
        "flow bias",
        (
            _constant("flow_bias_x", "m/s", 0.1, motion=along_x),
            _constant("flow_bias_y", "m/s", 0.1, motion=along_y),
        ),
    ),
    ErrorModel(
        "flow bias changes",
        (
            _changing("flow_error_x", "m/s", 0.015, 0.05, motion=along_x),
            _changing("flow_error_y", "m/s", 0.015, 0.05, motion=along_y),
        ),
        log_odds=COMMON,
    ),
    ErrorModel("flow mounted askew", (_constant("flow_angle", "rad", 0.2, motion=_askew),)),
    ErrorModel("flow late", (_constant("flow_delay", "s", 0.2, motion=_later_flow),)),
    ErrorModel(
        "flow follows the turning",
        (
            _constant("flow_lever_x", "m", 0.1, motion=_lever_x),
            _constant("flow_lever_y", "m", 0.1, motion=_lever_y),
        ),
    ),
    ErrorModel("flow noise", flow_factor=4.0, log_odds=COMMON),
    ErrorModel("flow noise for a while", for_a_while=True, log_odds=FOR_A_WHILE),
    ErrorModel(
        "range offset",
        (Unknown("range_offset_free", "m", 0.4, "pair", range=longer),),
        log_odds=COMMON,
    ),
    ErrorModel("range scale", (Unknown("range_scale_free", "1", 0.05, "pair", range_power=1),)),
    ErrorModel(
        "range error follows distance",
        (Unknown("range_by_distance", "1/m", 0.03, "pair", range_power=2),),
    ),
    ErrorModel("range late", (Unknown("range_delay", "s", 0.2, "pair", range=_earlier),)),
    ErrorModel(
        "range offset changes",
        (
            Unknown(
                "range_step", "m", 0.02, "pair", Cauchy(2.0), "jump", range=longer, start_std=0.1
            ),
        ),
        sudden=True,
        log_odds=COMMON,
    ),
    ErrorModel(
        "range offset of one direction",
        (Unknown("range_direction", "m", 0.3, "pair", range=_one_direction),),
    ),
    ErrorModel(
        "antenna delay by bearing",
        tuple(
            Unknown(f"antenna_{kind}{order}", "m", 0.1, "antenna", range=_harmonic(order, phase))
            for order in (1, 2)
            for kind, phase in (("cos", 0.0), ("sin", np.pi / 2))
        ),
    ),
    ErrorModel(
        "range errors fade",
        (Unknown("range_fading", "m", 0.15, "pair", Cauchy(5.0), "fading", 4.0, range=longer),),
    ),
    ErrorModel(
        "range errors of each direction fade",
        tuple(
            Unknown(f"range_fading_{k}", "m", 0.15, "pair", Cauchy(5.0), "fading", 4.0, range=one)
            for k, one in (("first", _of_first), ("second", _of_second))
        ),
    ),
    ErrorModel("range noise", range_factor=3.0, log_odds=COMMON),
    ErrorModel(
        "height offset", (_constant("height_offset_free", "m", 0.5, height=1.0),), log_odds=COMMON
    ),
    ErrorModel(
        "height changes", (_changing("height_step", "m", 0.02, 0.2, height=1.0),), log_odds=COMMON
    ),
    ErrorModel(
        "clock offset",
        (Unknown("clock_free", "s", 0.2, "clock", negated=True, motion=later),),
        log_odds=COMMON,
    ),
    ErrorModel(
        "clock changes",
        (
            Unknown(
                "clock_error",
                "s",
                0.003,
                "clock",
                Cauchy(2.0),
                "jump",
                negated=True,
                motion=later,
                start_std=0.1,
            ),
        ),
    ),
)


def list_candidates(robots: int = 2) -> Iterator[Candidate]:
    """Yield every model for each robot that it may concern."""
    for model in MODELS:
        for robot in model.owners(robots):
            yield Candidate(model, robot)
